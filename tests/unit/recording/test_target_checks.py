"""The file of target checks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tsgt.errors import OutputFileError
from tsgt.recording import read_target_checks, write_target_checks

if TYPE_CHECKING:
    from pathlib import Path


def test_checks_are_kept_by_station(tmp_path: Path) -> None:
    """A later check replaces an earlier one of its stations only; a station that has moved has none."""
    assert read_target_checks(tmp_path) == {}
    write_target_checks(tmp_path, {1: True, 2: True, 3: True}, 100)
    write_target_checks(tmp_path, {2: True, 3: False}, 200)
    assert read_target_checks(tmp_path) == {1: 100, 2: 200}


def test_damaged_file_is_no_check(tmp_path: Path) -> None:
    """The master starts without it, and the next check replaces it."""
    write_target_checks(tmp_path, {1: True}, 100)
    (file,) = tmp_path.iterdir()
    file.write_bytes(b'{"1":')
    assert read_target_checks(tmp_path) == {}
    write_target_checks(tmp_path, {2: True}, 200)
    assert read_target_checks(tmp_path) == {2: 200}


def test_missing_folder_is_an_error(tmp_path: Path) -> None:
    """The command warns."""
    with pytest.raises(OutputFileError):
        write_target_checks(tmp_path / "none", {1: True}, 100)
