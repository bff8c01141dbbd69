"""Permissions of the files that daemons read: write access to them means running any program as the daemon, or moving every pose.

Files that everybody can change, directly or through a parent folder, are rejected; group-writable ones are not: on Debian
each user has a group of their own and the umask is 002. Keys: see :mod:`tsgt.radio.key_file`.
"""

from __future__ import annotations

import os
import pwd
import stat
from itertools import chain, pairwise
from typing import TYPE_CHECKING

from tsgt.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path

_ROOT = 0


def check_permissions(path: Path, *, user: int | None = None) -> None:
    """Reject a file that everybody can change; a missing or inaccessible file is left to its reader.

    ``user``: id of the daemon's user, by default of this process. Raises ConfigError if the file or a parent folder is
    world-writable; in one with the sticky bit, such as /tmp: the path below it belongs to neither root nor the user.
    """
    owners = (_ROOT, os.geteuid() if user is None else user)
    try:
        found = path.stat()
        # The path as given, and with links resolved.
        ways = [
            [(each, each.lstat()) for each in (way, *way.parents)]
            for way in (path.absolute(), path.resolve())
        ]
    except (OSError, ValueError, RuntimeError):
        return
    if found.st_mode & stat.S_IWOTH:
        raise ConfigError(
            f"{path}: everybody on this computer can write it (mode {stat.S_IMODE(found.st_mode):04o}); "
            f"`chmod o-w {path}`",
            path=path,
        )
    for (each, what), (folder, place) in chain.from_iterable(map(pairwise, ways)):
        if not place.st_mode & stat.S_IWOTH or stat.S_ISLNK(place.st_mode):
            continue
        if not place.st_mode & stat.S_ISVTX:
            raise ConfigError(
                f"{path}: everybody on this computer can replace it, as {folder} has mode "
                f"{stat.S_IMODE(place.st_mode):04o}; `chmod o-w {folder}`",
                path=path,
            )
        if what.st_uid not in owners:
            raise ConfigError(
                f"{path}: {each} belongs to the user {user_name(what.st_uid)} and lies in {folder}, where everybody can "
                "create files; use a folder of your own",
                path=path,
            )


def user_name(uid: int) -> str:
    """Return the name of a user of this machine; the id without one."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)
