"""Text files of users and of other programs, and names of files in texts."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.errors import InputFileError

if TYPE_CHECKING:
    from pathlib import Path


def read_text(path: Path) -> str:
    """Return the text of a file, without the byte order mark that spreadsheets and editors of Windows write.

    Raises InputFileError if it cannot be read or is not UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputFileError(f"cannot be read: {error.strerror or error}", path=path) from error
    except UnicodeDecodeError as error:
        raise InputFileError("is not a text file", path=path) from error


def utf8_name(name: str) -> str:
    """Return the name of a file as text of another file: bytes that are not UTF-8, as of a system with Latin-1, are replaced."""
    return name.encode(errors="surrogateescape").decode(errors="replace")
