"""The file of the IMU's shocks."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from harness.files.records import IMU_PARAMETERS

from tsgt.errors import OutputFileError
from tsgt.recording import IMU_SHOCKS_FILE, read_imu_shocks, write_imu_shocks

if TYPE_CHECKING:
    from pathlib import Path

OTHER = replace(IMU_PARAMETERS, position_m=(0.3, 0.1, 0.2))


def test_shocks_are_those_of_a_mounting(tmp_path: Path) -> None:
    """Of one that was calibrated anew there are none, nor after the operator has removed the file."""
    assert read_imu_shocks(tmp_path, IMU_PARAMETERS) == 0
    write_imu_shocks(tmp_path, IMU_PARAMETERS, 1)
    write_imu_shocks(tmp_path, IMU_PARAMETERS, 3)
    assert read_imu_shocks(tmp_path, IMU_PARAMETERS) == 3
    assert read_imu_shocks(tmp_path, OTHER) == 0
    (tmp_path / IMU_SHOCKS_FILE).unlink()
    assert read_imu_shocks(tmp_path, IMU_PARAMETERS) == 0


@pytest.mark.parametrize("damage", [b'{"shocks":', b"[1, 2]", b"\xff"])
def test_damaged_file_tells_of_no_shock(tmp_path: Path, damage: bytes) -> None:
    """The master starts without it."""
    (tmp_path / IMU_SHOCKS_FILE).write_bytes(damage)
    assert read_imu_shocks(tmp_path, IMU_PARAMETERS) == 0


def test_impossible_number_tells_of_no_shock(tmp_path: Path) -> None:
    """It would be refused as a parameter."""
    write_imu_shocks(tmp_path, IMU_PARAMETERS, -3)
    assert read_imu_shocks(tmp_path, IMU_PARAMETERS) == 0


def test_missing_folder_is_an_error(tmp_path: Path) -> None:
    """The master tries again."""
    with pytest.raises(OutputFileError):
        write_imu_shocks(tmp_path / "none", IMU_PARAMETERS, 1)
