"""Which files a daemon may believe: those that not everybody on the computer can change.

Problem: whoever can write the configuration of a daemon can have it run any program, and whoever can write where the
stations stand moves every pose. Refusing all that a group may write would refuse what a Debian or a Raspberry Pi makes by
default: there every user has a group of his own, the umask is 002, and new files have mode 0664. Idea: refuse only what
everybody can change, the file itself or through a folder above it. Who shares a group, and whose files are in /etc, is
for the administrator to say. A key is another matter, because to read it is enough: see :mod:`tsgt.radio.key_file`.
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


def check_trust(path: Path, *, user: int | None = None) -> None:
    """Refuse a file that everybody can change; one that is not there, or out of sight, is for its reader to refuse.

    Parameters
    ----------
    path
        Of a configuration, a set-up file or a key.
    user
        Number of the user whose daemon reads it; None: who runs this program.

    Raises
    ------
    ConfigError
        Everybody may write the file or a folder above it; or a folder above it is for everybody, such as /tmp, where
        only owners may rename what they made, and what leads on from there belongs to neither root nor the user.
    """
    owners = (_ROOT, os.geteuid() if user is None else user)
    try:
        found = path.stat()
        # Both the way that the name goes and the one that links lead to.
        ways = [
            [(each, each.lstat()) for each in (way, *way.parents)]
            for way in (path.absolute(), path.resolve())
        ]
    except (OSError, ValueError, RuntimeError):
        return
    if found.st_mode & stat.S_IWOTH:
        raise ConfigError(
            f"{path}: everybody on this computer may write it (mode {stat.S_IMODE(found.st_mode):04o}); "
            f"`chmod o-w {path}`",
            path=path,
        )
    for (each, what), (folder, place) in chain.from_iterable(map(pairwise, ways)):
        if not place.st_mode & stat.S_IWOTH or stat.S_ISLNK(place.st_mode):
            continue
        if not place.st_mode & stat.S_ISVTX:
            raise ConfigError(
                f"{path}: everybody on this computer may put another file into its place, as {folder} has mode "
                f"{stat.S_IMODE(place.st_mode):04o}; `chmod o-w {folder}`",
                path=path,
            )
        if what.st_uid not in owners:
            raise ConfigError(
                f"{path}: {each} belongs to the user {_name(what.st_uid)} and lies in {folder}, where everybody may "
                "make files; use a folder of yours",
                path=path,
            )


def _name(uid: int) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)
