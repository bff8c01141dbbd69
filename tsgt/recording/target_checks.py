"""When each station was last found where it was calibrated: a file beside the recordings, for the master's status.

``tsgt calibrate check`` has the radio while the master is stopped, so the two meet in this file only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import TypeAdapter, ValidationError

from tsgt.recording.files import write_atomically

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

_FILE_NAME = "target_checks.json"

_ADAPTER = TypeAdapter(dict[int, int])


def read_target_checks(directory: Path) -> dict[int, int]:
    """Return the Unix time in ns of each station's check, by station number; none where there is no such file."""
    try:
        return _ADAPTER.validate_json((directory / _FILE_NAME).read_bytes())
    except (OSError, ValidationError):
        return {}


def write_target_checks(directory: Path, unmoved: Mapping[int, bool], unix_ns: int) -> None:
    """Record a check of some stations: whether each was found unmoved. Of one that was not, no check remains.

    Raises OutputFileError if the file cannot be written.
    """
    others = {
        station: at_ns for station, at_ns in read_target_checks(directory).items() if station not in unmoved
    }
    found = {station: unix_ns for station, ok in unmoved.items() if ok}
    with write_atomically(directory / _FILE_NAME) as file:
        file.write(_ADAPTER.dump_json(others | found))
