"""Shocks that may have displaced the IMU: a file beside the recordings, for a master that starts later.

With fewer than three stations nothing else tells that the mounting has changed, and what knocks the IMU may crash its computer.
The file is in force until the IMU is calibrated anew, or the operator, who has looked at the bracket, removes it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, NamedTuple

from pydantic import Field, TypeAdapter, ValidationError

from tsgt.recording.files import write_atomically

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.model import ImuParameters

IMU_SHOCKS_FILE = "imu_shocks.json"
"""Beside the recordings."""


class _ImuShocks(NamedTuple):
    shocks: Annotated[int, Field(ge=0, le=10**9)]
    position_m: tuple[float, float, float]  # These two identify the mounting
    orientation_xyzw: tuple[float, float, float, float]


_ADAPTER = TypeAdapter(_ImuShocks)


def read_imu_shocks(directory: Path, imu: ImuParameters) -> int:
    """Return the number of shocks with this mounting; 0 where there is no such file, or it is of another mounting."""
    try:
        found = _ADAPTER.validate_json((directory / IMU_SHOCKS_FILE).read_bytes())
    except (OSError, ValidationError):
        return 0
    return found.shocks if found[1:] == imu.mounting else 0


def write_imu_shocks(directory: Path, imu: ImuParameters, shocks: int) -> None:
    """Replace the number of shocks with this mounting. Raises OutputFileError if the file cannot be written."""
    with write_atomically(directory / IMU_SHOCKS_FILE) as file:
        file.write(_ADAPTER.dump_json(_ImuShocks(shocks, *imu.mounting)))
