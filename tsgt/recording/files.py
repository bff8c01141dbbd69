"""Atomic output files, and names of new recordings."""

from __future__ import annotations

import os
import secrets
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from itertools import count
from typing import TYPE_CHECKING, BinaryIO

from tsgt.errors import OutputFileError, RecordingError, TsgtError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@contextmanager
def write_atomically(path: Path) -> Iterator[BinaryIO]:
    """Yield a file that becomes ``path`` when the block ends without an exception; an existing file is replaced.

    A pipe, a terminal or ``/dev/null`` is written directly. The folder must exist. Raises OutputFileError if the
    disk is full, or there is no such folder or no permission.
    """
    target = path.resolve()
    part = target.with_name(f".{secrets.token_hex(8)}.part")
    try:
        if path.exists() and not path.is_file():
            with path.open("wb") as file:
                yield file
            return
        try:
            with part.open("xb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)
        sync_folder(target)
    except BrokenPipeError:
        raise
    except OSError as error:
        # A failed write has no file name; an error with another name does not concern this file.
        if error.filename not in (None, str(path), str(part)) or isinstance(error, TsgtError):
            raise
        raise OutputFileError(f"cannot be written ({error.strerror})", path=path) from error


def new_recording_path(directory: Path, name: str, unix_ns: int) -> Path:
    """Create an empty file with a new name in a directory, which is created if needed.

    ``unix_ns``: Unix time in ns that follows ``name`` in the file name: ``name-20261121T055100Z.jsonl``. A computer
    without a battery clock may have the same time at each start; then a number follows:
    ``name-20261121T055100Z-2.jsonl``. Raises RecordingError if the directory or the file cannot be created.
    """
    stem = f"{name}-{datetime.fromtimestamp(unix_ns // 1_000_000_000, UTC):%Y%m%dT%H%M%SZ}"
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for number in count(1):
            path = directory / f"{stem}{'' if number == 1 else f'-{number}'}.jsonl"
            with suppress(FileExistsError):
                path.open("xb").close()
                break
    except OSError as error:
        raise RecordingError(
            f"no file can be created there ({error.strerror}); check the folder and its permissions",
            path=directory,
        ) from error
    return path


def sync_folder(path: Path) -> None:
    """Bring the directory entry of a new file to the disk."""
    with suppress(OSError):  # not supported by some file systems
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
