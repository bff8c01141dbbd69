"""The file with the access code of the page: one line that people type in."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from tsgt.config import check_permissions
from tsgt.errors import ConfigError
from tsgt.web.access import MAX_CODE_CHARACTERS, MIN_CODE_CHARACTERS


def read_code(path: Path) -> str:
    """Read an access code.

    Raises
    ------
    ConfigError
        The file cannot be read, other users may read or replace it, or the code is too short or too long.
    """
    try:
        descriptor = os.open(
            path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC
        )  # opening a pipe must not block
        with os.fdopen(descriptor, "rb") as file:
            status = os.fstat(descriptor)
            content = file.read(4 * MAX_CODE_CHARACTERS) if stat.S_ISREG(status.st_mode) else b""
    except (OSError, ValueError) as error:  # ValueError: a path with a zero byte
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(f"{path}: the access code cannot be read ({reason})", path=path) from error
    check_permissions(path)
    # systemd protects its credentials by access control lists, which look like permissions of a group.
    credentials = os.environ.get("CREDENTIALS_DIRECTORY")
    protected = credentials is not None and path.parent == Path(credentials)
    if status.st_mode & (stat.S_IRWXG | stat.S_IRWXO) and not protected:
        raise ConfigError(
            f"{path}: its mode is {stat.S_IMODE(status.st_mode):04o}, but only its owner may have access to the code; "
            f"`chmod 600 {path}`",
            path=path,
        )
    code = content.decode(errors="replace").strip()
    if not MIN_CODE_CHARACTERS <= len(code) <= MAX_CODE_CHARACTERS or not code.isprintable():
        raise ConfigError(
            f"{path}: an access code has {MIN_CODE_CHARACTERS} to {MAX_CODE_CHARACTERS} characters in one line",
            path=path,
        )
    return code
