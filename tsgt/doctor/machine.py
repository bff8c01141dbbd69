"""What the checks may ask of the machine that they look at, and the machine that they run on."""

from __future__ import annotations

import grp
import os
import pwd
import shutil
import stat
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.clock import Clock
    from tsgt.radio.sx127x import Hal, Wiring
    from tsgt.station import ClientStatus
    from tsgt.station.serial import OpenPort

COMMAND_TIMEOUT_S = 5.0
"""timedatectl asks a service that may have to be started first; none of the commands takes longer than this."""


@dataclass(frozen=True, slots=True, kw_only=True)
class User:
    """A user, as far as rights go.

    Attributes
    ----------
    name
        For people.
    uid
        The user's number; 0 may do everything.
    groups
        Numbers of all groups.
    """

    name: str
    uid: int
    groups: frozenset[int]

    def may_use(self, path: Path) -> bool:
        """Whether this user may read and write a file or use a folder, by its mode; raises OSError without one."""
        found = path.stat()
        if self.uid == 0:
            return True
        if found.st_uid == self.uid:
            rights = found.st_mode >> 6
        elif found.st_gid in self.groups:
            rights = found.st_mode >> 3
        else:
            rights = found.st_mode
        wanted = 0o7 if stat.S_ISDIR(found.st_mode) else 0o6
        return rights & wanted == wanted


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """A machine: what is read, called and opened from outside.

    Paths in a configuration are taken as they are.

    Attributes
    ----------
    dev, sys, proc, etc
        The folders of these names.
    clock
        The machine's.
    user
        Who runs the checks.
    find_user
        Returns a user by name, with further groups by name; None where there is no such user or group.
    group_name
        Returns the name of a group by number.
    run
        Calls a command and returns what it prints; None where there is no such command, or it does not answer.
    which
        Returns where a program is; None where there is none.
    free_bytes
        How much room a folder's disk has for users.
    port_holder
        Returns who has a device open; None where nobody does, or it cannot be told.
    latency_timer_ms
        Returns how long a serial adapter keeps bytes back, in ms; None where it has no such setting.
    open_port
        Returns what opens a serial line.
    open_hal
        Opens bus and pins of a radio.
    client_status
        Asks the client behind a socket how it does; None where there is none. Raises StreamError where it is stuck.
    serves
        Whether somebody serves a socket.
    """

    dev: Path = Path("/dev")
    sys: Path = Path("/sys")
    proc: Path = Path("/proc")
    etc: Path = Path("/etc")
    clock: Clock
    user: User
    find_user: Callable[[str, Sequence[str]], User | None]
    group_name: Callable[[int], str]
    run: Callable[[Sequence[str]], str | None]
    which: Callable[[str], str | None]
    free_bytes: Callable[[Path], int]
    port_holder: Callable[[Path], str | None]
    latency_timer_ms: Callable[[Path], int | None]
    open_port: Callable[[Path], OpenPort]
    open_hal: Callable[[Wiring], Hal]
    client_status: Callable[[Path], ClientStatus | None]
    serves: Callable[[Path], bool]

    def read(self, path: Path) -> str | None:
        """Return what a small file of the system says; None where it cannot be read."""
        try:
            return path.read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return None


def current_user() -> User:
    """Return who runs this program."""
    uid = os.geteuid()
    try:
        name = pwd.getpwuid(uid).pw_name
    except KeyError:
        name = str(uid)
    return User(name=name, uid=uid, groups=frozenset({os.getegid(), *os.getgroups()}))


def find_user(name: str, groups: Sequence[str]) -> User | None:
    """Return a user of this machine by name, with further groups by name; None where there is no such one."""
    try:
        entry = pwd.getpwnam(name)
        further = [grp.getgrnam(group).gr_gid for group in groups]
    except KeyError:
        return None
    own = os.getgrouplist(name, entry.pw_gid)
    return User(name=name, uid=entry.pw_uid, groups=frozenset({*own, *further}))


def group_name(gid: int) -> str:
    """Return the name of a group of this machine; its number where it has none."""
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)


def run_command(arguments: Sequence[str]) -> str | None:
    """Call a command of this machine and return what it prints; None where that fails."""
    program = shutil.which(arguments[0])
    if program is None:
        return None
    try:
        done = subprocess.run(
            [program, *arguments[1:]], capture_output=True, text=True, check=False, timeout=COMMAND_TIMEOUT_S
        )
    except (OSError, subprocess.SubprocessError, ValueError):
        return None
    return done.stdout if done.returncode == 0 else None


def free_bytes(folder: Path) -> int:
    """Return how much room the disk of a folder has for users, in bytes; raises OSError."""
    found = os.statvfs(folder)
    return found.f_bavail * found.f_frsize
