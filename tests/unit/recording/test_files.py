from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from tsgt.errors import InputFileError, OutputFileError, RecordingError
from tsgt.recording import new_recording_path, write_atomically

if TYPE_CHECKING:
    from pathlib import Path


def test_result_appears_at_the_end_only(tmp_path: Path) -> None:
    """Until then the old file remains."""
    path = tmp_path / "poses.tum"
    path.write_bytes(b"old")
    with write_atomically(path) as file:
        file.write(b"new")
        file.flush()
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_failure_keeps_the_old_file(tmp_path: Path) -> None:
    """The error is raised, and no other file remains."""
    path = tmp_path / "poses.tum"
    path.write_bytes(b"old")
    with pytest.raises(InputFileError), write_atomically(path) as file:  # noqa: PT012 (the block fails halfway)
        file.write(b"half")
        raise InputFileError("broken", path=tmp_path / "input.csv")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_missing_folder_is_one_line(tmp_path: Path) -> None:
    """A folder that does not exist is an error that names the result."""
    path = tmp_path / "nowhere" / "poses.tum"
    refused = pytest.raises(OutputFileError, match=rf"^{path}: cannot be written \(No such file")
    with refused as raised, write_atomically(path):
        pass
    assert raised.value.path == path


def test_full_disk_is_one_line(tmp_path: Path) -> None:
    """A write that finds no room is an error that names the result."""
    refused = pytest.raises(OutputFileError, match=r"poses.tum: cannot be written \(No space left")
    with refused, write_atomically(tmp_path / "poses.tum"):
        raise OSError(28, "No space left on device")
    assert list(tmp_path.iterdir()) == []


def test_error_of_another_file_is_not_an_output_error(tmp_path: Path) -> None:
    """Error of another file is not an output error."""
    with pytest.raises(FileNotFoundError, match=r"input\.csv"), write_atomically(tmp_path / "poses.tum"):
        (tmp_path / "input.csv").open()


def test_pipe_is_written_directly(tmp_path: Path) -> None:
    """Pipe is written directly."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reading = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        with write_atomically(pipe) as file:
            file.write(b"poses")
        assert os.read(reading, 100) == b"poses"
    finally:
        os.close(reading)
    assert pipe.is_fifo()


def test_symbolic_link_is_kept(tmp_path: Path) -> None:
    """Its target is replaced."""
    (tmp_path / "link").symlink_to(tmp_path / "target")
    with write_atomically(tmp_path / "link") as file:
        file.write(b"poses")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target").read_bytes() == b"poses"


def test_new_recording_has_a_new_name(tmp_path: Path) -> None:
    """With a number at equal times; the folder is created."""
    folder = tmp_path / "a" / "b"
    paths = [new_recording_path(folder, "station1", 1_700_000_000_999_999_999) for _ in range(3)]
    stem = "station1-20231114T221320Z"
    assert [path.name for path in paths] == [f"{stem}.jsonl", f"{stem}-2.jsonl", f"{stem}-3.jsonl"]
    assert all(path.read_bytes() == b"" for path in paths)


def test_impossible_folder_is_an_error(tmp_path: Path) -> None:
    """Impossible folder is an error."""
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match="file: no file can be created there"):
        new_recording_path(tmp_path / "file", "master", 0)
