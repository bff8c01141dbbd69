"""The file with a key, which all radios of a mission share, or a relay and its readers: one line of 64 hexadecimal digits.

Only its owner, the user who runs the daemon, may have access to it or be able to replace it; otherwise it is rejected,
as ssh rejects private keys.
"""

from __future__ import annotations

import itertools
import os
import re
import secrets
import stat
from typing import TYPE_CHECKING

from tsgt.config import check_permissions, user_name
from tsgt.errors import ConfigError, OutputFileError
from tsgt.radio.superframe.wire import KEY_BYTES
from tsgt.recording import sync_folder

if TYPE_CHECKING:
    from pathlib import Path

_DIGITS = 2 * KEY_BYTES
_MAX_FILE_BYTES = 1024


MAKE_KEY = "tsgt radio key"


def read_key(path: Path, *, owner: int | None = None, make_key: str = MAKE_KEY) -> bytes:
    """Read a key.

    ``path``: a file made by :func:`write_key`, or a copy of it. ``owner``: required user id; None: that of this
    process. ``make_key``: the command that makes such a file, for errors. Raises ConfigError if there is no such file, another user
    owns it or may read, write or replace it, or its content is no key that a random generator can have made.
    """
    try:
        # Opening a pipe must not block.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            check_access(path, os.fstat(descriptor), os.geteuid() if owner is None else owner, make_key)
            check_permissions(path, user=owner)
            content = os.read(descriptor, _MAX_FILE_BYTES)
        finally:
            os.close(descriptor)
    except FileNotFoundError:
        raise ConfigError(
            f"{path}: no such file; copy the key there, or create one with `{make_key} {path}`",
            path=path,
        ) from None
    except (OSError, ValueError) as error:  # ValueError: a path with a zero byte
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(
            f"{path}: the key cannot be read ({reason}); it must belong to the user {user_name(os.geteuid())}",
            path=path,
        ) from error
    if len(content) == _MAX_FILE_BYTES or re.fullmatch(rb"\s*[0-9A-Fa-f]{%d}\s*" % _DIGITS, content) is None:
        raise ConfigError(
            f"{path}: not a key, which is one line of {_DIGITS} hexadecimal digits; copy the unchanged file of "
            "another computer that has it",
            path=path,
        )
    key = bytes.fromhex(content.decode("ascii"))
    if not _random(key):
        raise ConfigError(
            f"{path}: its digits follow a pattern, which anybody can guess; make a random key with `{make_key}`, and copy it to "
            "all computers",
            path=path,
        )
    return key


def _random(key: bytes) -> bool:
    """Return whether a random generator can have made it; of its keys, fewer than one in 10^12 is taken for none."""
    steps = {(later - earlier) % 256 for earlier, later in itertools.pairwise(key)}
    repeats = any(key == (key[:period] * KEY_BYTES)[:KEY_BYTES] for period in range(1, KEY_BYTES // 2 + 1))
    text = all(32 <= byte < 127 for byte in key)  # Of a sentence
    return len(set(key)) > KEY_BYTES // 2 and len(steps) > 2 and not repeats and not text


def write_key(path: Path) -> None:
    """Write a random key into a new file that only its owner may read; raises OutputFileError on failure."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except FileExistsError:
        raise OutputFileError(
            "exists already, and a key is never overwritten: choose another name, or delete it if no radio uses it",
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
        path.unlink(missing_ok=True)  # no partial key
        raise OutputFileError(f"cannot be written ({error.strerror})", path=path) from error


def check_access(path: Path, status: os.stat_result, owner: int, make_key: str = MAKE_KEY) -> None:
    """Check that a key file belongs to the user id ``owner`` alone.

    Raises ConfigError if it is no regular file, belongs to another user, or another user may read or write it.
    """
    if not stat.S_ISREG(status.st_mode):
        raise ConfigError(f"{path}: not a file; name one made with `{make_key}`", path=path)
    if status.st_uid != owner:
        user = user_name(owner)
        raise ConfigError(
            f"{path}: belongs to the user {user_name(status.st_uid)}, but a key must belong to the user of the program, here "
            f"{user}; run this as {user_name(status.st_uid)}, or `sudo chown {user} {path}`",
            path=path,
        )
    mode = stat.S_IMODE(status.st_mode)
    if mode not in (0o600, 0o400):
        raise ConfigError(
            f"{path}: its mode is {mode:04o}, but only the owner may have access to a key; `chmod 600 {path}`",
            path=path,
        )
