"""Appends to a recording so that a killed program, a full disk or a power cut lose as little as possible."""

from __future__ import annotations

import fcntl
import os
import stat
import threading
from contextlib import suppress
from typing import TYPE_CHECKING, BinaryIO, Self

from tsgt.errors import RecordingError
from tsgt.recording.files import sync_folder
from tsgt.recording.format import (
    HEADER_START,
    MAX_LINE_BYTES,
    NO_HEADER,
    Typed,
    check_header,
    decode,
    encode_line,
)

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

_COPY_BYTES = 1_000_000


class RecordingWriter:
    """Appends lines to a recording, each completely or not at all.

    A line is in the kernel when :meth:`write` returns, and on the disk after the next :meth:`sync`. The file is locked:
    it has one writer at a time. The caller writes the header and the parameters that begin every run of the master. ``path``: a
    new file, or a recording to continue. ``write`` passes bytes to the kernel, and ``sync`` brings them to the disk:
    :func:`os.write` and :func:`os.fsync`, except in simulations. ``size``: length of the file in bytes. ``cut_bytes``: length of the torn line that was cut off the end of the file; 0 when it was
    complete. Raises RecordingError if the file cannot be opened, is not a recording, or another program is writing it.
    Raises RecordingVersionError if it is a recording of another version.
    """

    def __init__(
        self,
        path: Path,
        *,
        write: Callable[[int, memoryview], int] | None = None,
        sync: Callable[[int], None] | None = None,
    ) -> None:
        self._path = path
        self._write_bytes = write
        self._sync_file = sync
        self._sync_lock = threading.Lock()  # a sync may be running in a thread when the owner closes
        self._unsynced = True
        try:
            self._fd = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise RecordingError(f"cannot be opened for writing ({error.strerror})", path=path) from error
        try:
            self._lock()
            self._torn_at: int | None = None
            self.cut_bytes = self._repair()
            self.size = os.fstat(self._fd).st_size
            self._synced_size = self.size  # what was there before belongs to another run
            self._sync_failed = False
        except OSError as error:
            os.close(self._fd)
            raise RecordingError(f"cannot be continued ({error.strerror})", path=path) from error
        except BaseException:
            os.close(self._fd)
            raise
        sync_folder(path)

    def _lock(self) -> None:
        if not stat.S_ISREG(os.fstat(self._fd).st_mode):
            raise RecordingError("is not a regular file; choose another", path=self._path)
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RecordingError(
                "another program is writing it; stop that one or choose another file", path=self._path
            ) from error

    def _repair(self) -> int:
        """Cut the file off at the end of a line; return the length of a torn one."""
        with open(self._fd, "rb", closefd=False) as file:
            whole_bytes, size = _whole_lines(file)
            file.seek(0)
            first = file.readline(MAX_LINE_BYTES)
            file.seek(whole_bytes)
            tail = file.read(MAX_LINE_BYTES).rstrip(b"\0")  # A power cut leaves zero bytes
        if size == 0:
            return 0
        only_newline_missing = _is_record(tail)
        if whole_bytes or only_newline_missing:
            try:
                check_header(first, self._path, 1)
            except ValueError as error:
                raise RecordingError(NO_HEADER, path=self._path) from error
        elif tail[: len(HEADER_START)] != HEADER_START[: len(tail)]:
            raise RecordingError(NO_HEADER, path=self._path)
        keep_bytes = whole_bytes + len(tail) if only_newline_missing else whole_bytes
        os.ftruncate(self._fd, keep_bytes)
        if only_newline_missing:
            self._append(b"\n")
        return size - keep_bytes

    def write(self, record: object) -> None:
        """Append a record as one line. Raises RecordingError if no part of it could be written; later ones may be."""
        self.write_line(encode_line(record))

    def write_line(self, line: bytes) -> None:
        """Append an encoded line without its line end; raises as :meth:`write`."""
        try:
            self._append(line + b"\n")
        except OSError as error:
            raise RecordingError(
                f"a line was not written ({error.strerror}); free or check the disk, "
                "writing continues when it works again",
                path=self._path,
            ) from error

    def _append(self, data: bytes) -> None:
        self._cut_torn_line()
        size = os.fstat(self._fd).st_size
        rest = memoryview(data)
        try:
            # One iteration, unless the disk fills up within the line: then the second one raises.
            write = self._write_bytes or os.write
            while rest:
                rest = rest[write(self._fd, rest) :]
        except OSError:
            self._torn_at = size
            with suppress(OSError):  # may fail too; the next line tries again
                self._cut_torn_line()
            raise
        self.size = size + len(data)
        self._unsynced = True  # after the write, so that a concurrent sync does not count it as synced

    def _cut_torn_line(self) -> None:
        if self._torn_at is not None:
            os.ftruncate(self._fd, self._torn_at)
            self._torn_at = None

    def sync(self) -> None:
        """Bring all lines to the disk, in any thread. Raises RecordingError: those since the last sync may be lost."""
        with self._sync_lock:
            if not self._unsynced:
                return
            self._unsynced = False
            size = self.size  # lines that are written meanwhile are in the next sync
            try:
                if self._sync_failed:
                    self._write_again(size)
                (self._sync_file or os.fsync)(self._fd)
                self._synced_size, self._sync_failed = size, False
            except OSError as error:
                self._unsynced = self._sync_failed = True
                raise RecordingError(
                    f"cannot be brought to the disk ({error.strerror}); check the disk", path=self._path
                ) from error

    def _write_again(self, size: int) -> None:
        """Give the kernel the bytes since the last sync once more.

        Linux reports a failed write to the disk once, and takes the bytes for written from then on; it still has them in memory.
        """
        fd = os.open(self._path, os.O_WRONLY | os.O_CLOEXEC)  # O_APPEND would append them
        try:
            at = self._synced_size
            while data := os.pread(self._fd, min(size - at, _COPY_BYTES), at):
                at += os.pwrite(fd, data, at)
        finally:
            os.close(fd)

    def close(self) -> None:
        """Sync and close the file; a second call does nothing."""
        if self._fd < 0:
            return
        try:
            self.sync()
        finally:
            with self._sync_lock:
                os.close(self._fd)
                self._fd = -1
                self._unsynced = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _is_record(data: bytes) -> bool:
    try:
        decode(Typed, data)
    except ValueError:
        return False
    return True


def _whole_lines(file: BinaryIO) -> tuple[int, int]:
    """Return the number of bytes up to the last line end, and in all."""
    size = file.seek(0, os.SEEK_END)
    end = size
    while end > 0:
        start = max(0, end - MAX_LINE_BYTES)
        file.seek(start)
        newline = file.read(end - start).rfind(b"\n")
        if newline >= 0:
            return start + newline + 1, size
        end = start
    return 0, size
