"""The file with the key that all radios of a mission share: 64 hexadecimal digits in a line of text.

Nobody but its owner may read it, and its owner is the user who runs the daemon: anything else is refused, as ssh does,
because nobody would notice it otherwise. Nor may it lie where everybody could put another one into its place.
"""

from __future__ import annotations

import os
import pwd
import re
import secrets
import stat
from typing import TYPE_CHECKING

from tsgt.config import check_trust
from tsgt.errors import ConfigError, OutputFileError
from tsgt.radio.superframe.wire import KEY_BYTES
from tsgt.recording import sync_folder

if TYPE_CHECKING:
    from pathlib import Path

_DIGITS = 2 * KEY_BYTES
_MOST_BYTES = 1024


def read_key(path: Path, *, owner: int | None = None) -> bytes:
    """Read the key of a mission.

    Parameters
    ----------
    path
        Of the file that :func:`write_key` has made, or of a copy of it.
    owner
        Number of the user to whom it has to belong; None: who runs this program.

    Raises
    ------
    ConfigError
        There is no such file, somebody else may read, write or replace it, it belongs to somebody else, or it is no key.
    """
    try:
        # A pipe must not be waited for.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            check_access(path, os.fstat(descriptor), os.geteuid() if owner is None else owner)
            check_trust(path, user=owner)
            content = os.read(descriptor, _MOST_BYTES)
        finally:
            os.close(descriptor)
    except FileNotFoundError:
        raise ConfigError(
            f"{path}: no such file; copy the key of the mission to there, or make one by `tsgt radio key {path}`",
            path=path,
        ) from None
    except (OSError, ValueError) as error:  # the latter: a path with a zero byte
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(
            f"{path}: the key cannot be read ({reason}); it has to belong to the user {_user(os.geteuid())}",
            path=path,
        ) from error
    if len(content) == _MOST_BYTES or re.fullmatch(rb"\s*[0-9A-Fa-f]{%d}\s*" % _DIGITS, content) is None:
        raise ConfigError(
            f"{path}: not a key, which is one line of {_DIGITS} hexadecimal digits; copy the file of another radio "
            "of the mission again, as it is",
            path=path,
        )
    return bytes.fromhex(content.decode("ascii"))


def write_key(path: Path) -> None:
    """Write a new random key into a new file that nobody else may read.

    Parameters
    ----------
    path
        Where; the folder must exist, the file must not.

    Raises
    ------
    OutputFileError
        There is a file already, no such folder, no permission, or no room on the disk.
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except FileExistsError:
        raise OutputFileError(
            "exists already, and a key is not overwritten: give another name, or remove it if no radio uses it",
            path=path,
        ) from None
    except OSError as error:
        raise OutputFileError(f"cannot be written ({error.strerror})", path=path) from error
    try:
        with os.fdopen(descriptor, "w", encoding="ascii") as file:
            file.write(secrets.token_hex(KEY_BYTES) + "\n")
            file.flush()
            os.fsync(file.fileno())
        sync_folder(path)
    except OSError as error:
        path.unlink(missing_ok=True)  # half a key is none
        raise OutputFileError(f"cannot be written ({error.strerror})", path=path) from error


def check_access(path: Path, found: os.stat_result, owner: int) -> None:
    """Refuse a file that is not its owner's alone.

    Parameters
    ----------
    path, found
        The file, and what is known of it.
    owner
        Number of the user who uses it.

    Raises
    ------
    ConfigError
        It is no file, belongs to somebody else, or somebody else may read or write it.
    """
    if not stat.S_ISREG(found.st_mode):
        raise ConfigError(f"{path}: not a file; name the one that `tsgt radio key` made", path=path)
    if found.st_uid != owner:
        user = _user(owner)
        raise ConfigError(
            f"{path}: belongs to the user {_user(found.st_uid)}, but a key has to belong to the one who uses it, here "
            f"{user}; run this as {_user(found.st_uid)}, or `sudo chown {user} {path}`",
            path=path,
        )
    mode = stat.S_IMODE(found.st_mode)
    if mode not in (0o600, 0o400):
        raise ConfigError(
            f"{path}: its mode is {mode:04o}, but nobody else may use a key; `chmod 600 {path}`",
            path=path,
        )


def _user(uid: int) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)
