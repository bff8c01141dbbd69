"""Interface of the checks to a machine, and its implementation for this machine."""

from __future__ import annotations

import grp
import os
import pwd
import shutil
import socket
import stat
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from tsgt.config import user_name

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.clock import Clock
    from tsgt.config import TcpAddress
    from tsgt.radio.sx127x import Hal, Wiring
    from tsgt.service import StartProgram
    from tsgt.station import ClientStatus
    from tsgt.station.serial import OpenPort

COMMAND_TIMEOUT_S = 5.0  # timedatectl may have to start a service first; no command takes longer


@dataclass(frozen=True, slots=True, kw_only=True)
class User:
    """A user with user id and group ids; user id 0 may do everything."""

    name: str
    uid: int
    groups: frozenset[int]

    def may_use(self, path: Path) -> bool:
        """Whether the mode permits this user to read and write a file or use a folder; raises OSError without one."""
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
    """A machine: everything that the checks read, call and open.

    Attributes
    ----------
    user : User that runs the checks.
    find_user : Returns a user by name, with additional groups by name; None if a name does not exist.
    group_name : Returns the name of a group by number.
    run : Runs a command and returns its output; None if it is missing or fails.
    which : Returns the path of a program; None if it is missing.
    free_bytes : Returns the free space of a folder's disk.
    port_holder : Returns the process that has a device open; None if there is none or it is unknown.
    latency_timer_ms : Returns the latency timer of a serial adapter in ms; None without one.
    start_imu, start_odometry : Start the programs that read the IMU and the wheel odometry; None: as a child process.
    open_port, open_hal : Open a serial line; bus and pins of a radio.
    client_status : Returns the status of the client behind a socket; None without one. Raises StreamError if it is stuck.
    serves : Whether a process serves a socket.
    reach : Connects to the web server of an address, without a request; returns what went wrong, or an empty string.
    """

    dev: Path = Path("/dev")
    sys: Path = Path("/sys")
    proc: Path = Path("/proc")
    etc: Path = Path("/etc")
    clock: Clock
    start_imu: StartProgram | None = None
    start_odometry: StartProgram | None = None
    user: User
    find_user: Callable[[str, Sequence[str]], User | None]
    group_name: Callable[[int], str]
    run: Callable[[Sequence[str]], str | None]
    which: Callable[[str], str | None]
    free_bytes: Callable[[Path], int]
    port_holder: Callable[[Path], str | None]
    latency_timer_ms: Callable[[Path], int | None]
    open_port: Callable[[Path | TcpAddress], OpenPort]
    open_hal: Callable[[Wiring], Hal]
    client_status: Callable[[Path], ClientStatus | None]
    serves: Callable[[Path], bool]
    reach: Callable[[str], str]

    def read(self, path: Path) -> str | None:
        """Return the content of a system file; None if it cannot be read."""
        try:
            return path.read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return None


def current_user() -> User:
    """Return the user of this process."""
    uid = os.geteuid()
    return User(name=user_name(uid), uid=uid, groups=frozenset({os.getegid(), *os.getgroups()}))


def find_user(name: str, groups: Sequence[str]) -> User | None:
    """Return a user of this machine by name, with additional groups by name; None if a name does not exist."""
    try:
        entry = pwd.getpwnam(name)
        further = [grp.getgrnam(group).gr_gid for group in groups]
    except KeyError:
        return None
    own = os.getgrouplist(name, entry.pw_gid)
    return User(name=name, uid=entry.pw_uid, groups=frozenset({*own, *further}))


def group_name(gid: int) -> str:
    """Return the name of a group of this machine; its number without one."""
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)


def run_command(arguments: Sequence[str]) -> str | None:
    """Run a command of this machine and return its output; None if that fails."""
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
    """Return the free space of a folder's disk for users in bytes; raises OSError."""
    found = os.statvfs(folder)
    return found.f_bavail * found.f_frsize


def reach_server(url: str) -> str:
    """Connect to the web server of an address, without a request; return what went wrong, or an empty string."""
    import ssl  # noqa: PLC0415 (only where it is configured)

    parts = urlsplit(url)
    host, secure = parts.hostname or "", parts.scheme == "https"
    try:
        with socket.create_connection(
            (host, parts.port or (443 if secure else 80)), COMMAND_TIMEOUT_S
        ) as connection:
            if secure:
                with ssl.create_default_context().wrap_socket(connection, server_hostname=host):
                    pass
    except ssl.SSLCertVerificationError as error:
        return f"its certificate is not accepted ({error.verify_message})"
    except (OSError, ValueError) as error:
        return f"it is not reached ({error})"
    return ""
