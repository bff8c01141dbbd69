"""Files that are there as a whole or not at all, and names for new ones."""

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
    """Write a result so that it is there as a whole or not at all; an existing file is replaced on success.

    A pipe, a terminal or ``/dev/null`` is written directly, there is nothing to replace.

    Parameters
    ----------
    path
        The result; the folder must exist.

    Yields
    ------
    BinaryIO
        Takes the bytes. It becomes ``path`` when the block ends without an exception.

    Raises
    ------
    OutputFileError
        No room on the disk, no such folder, no permission.
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
        # A failed write names no file; one that names another is not about this result.
        if error.filename not in (None, str(path), str(part)) or isinstance(error, TsgtError):
            raise
        raise OutputFileError(f"cannot be written ({error.strerror})", path=path) from error


def new_recording_path(directory: Path, name: str, unix_ns: int) -> Path:
    """Make an empty file for a new recording, with a name that no file there has.

    Parameters
    ----------
    directory
        Where; it is made if need be.
    name
        What the name begins with.
    unix_ns
        The time that it is named after, in ns. A computer without a battery clock may see the same time at each
        start; the name then gets a number.

    Returns
    -------
    Path
        For example ``name-20261121T055100Z.jsonl``, or ``name-20261121T055100Z-2.jsonl``.

    Raises
    ------
    RecordingError
        The folder or the file cannot be made.
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
            f"no file can be made there ({error.strerror}); check the folder and its permissions",
            path=directory,
        ) from error
    return path


def sync_folder(path: Path) -> None:
    """Make the name of a new file survive a power cut."""
    with suppress(OSError):  # some file systems refuse; the file itself is unharmed
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
