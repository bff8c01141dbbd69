"""The steps of the setup: each looks at the system, and returns what is right already and what has to be changed."""

from __future__ import annotations

import re
import stat
from dataclasses import dataclass, replace
from importlib.resources import files
from itertools import count
from typing import TYPE_CHECKING, Final, Literal

from tsgt.setup.configuration import State, compare_configuration
from tsgt.setup.system import Change, RemoveFile, RunCommand, Step, WriteFile

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.setup.system import System

MIN_PYTHON: Final = (3, 11)
MIN_DEBIAN: Final = 12
GROUPS: Final = ("spi", "gpio", "dialout")
USER: Final = "tsgt"
KEY: Final = "/etc/tsgt/radio.key"

_RELEASES: Final = ("/etc/os-release", "/usr/lib/os-release")
_BOOT_CONFIGS: Final = ("/boot/firmware/config.txt", "/boot/config.txt")
_FOLDERS: Final = {
    "systemd": ("/etc/systemd/system", "/usr/lib/systemd/system", "/lib/systemd/system"),
    "udev": ("/etc/udev/rules.d", "/usr/lib/udev/rules.d", "/lib/udev/rules.d"),
    "sysusers": ("/etc/sysusers.d", "/usr/lib/sysusers.d"),
    "journald": ("/etc/systemd/journald.conf.d", "/usr/lib/systemd/journald.conf.d"),
}
"""Folders in which a file of a kind is in force, first where setup writes it; the others are the Debian package's."""


@dataclass(frozen=True, slots=True)
class Role:
    """What a machine is set up as."""

    word: Literal["station", "master"]
    kind: Literal["client", "master"]

    @property
    def unit(self) -> str:
        """Name of its systemd unit."""
        return f"tsgt-{self.kind}.service"

    @property
    def config(self) -> str:
        """Name of its configuration."""
        return f"/etc/tsgt/{self.kind}.toml"

    @property
    def restart_due(self) -> str:
        """Name of the file that exists while the service runs with something older than what is installed.

        It outlives an interrupted setup, and is gone after a boot, which starts the service anew.
        """
        return f"/run/tsgt-{self.kind}.restart-due"


CLIENT: Final = Role("station", "client")
MASTER: Final = Role("master", "master")


def system_step(system: System, role: Role, *, dry_run: bool = False) -> Step:
    """Check operating system, Python and the user who runs this."""
    release = dict(re.findall(r'^(\w+)="?([^"\n]*)"?$', system.read("/etc/os-release") or "", re.MULTILINE))
    name = release.get("PRETTY_NAME", "an unknown operating system")
    python = ".".join(map(str, system.python))
    version = release.get("VERSION_ID", "")
    if not system.live and not any(system.path(each).exists() for each in _RELEASES):
        return _problem("system", f"there is no root file system in {system.root}: is the card mounted?")
    old = release.get("ID") in ("debian", "raspbian") and version.isdigit() and int(version) < MIN_DEBIAN
    if old:
        return _problem(
            "system",
            f"{name} is too old: Raspberry Pi OS {MIN_DEBIAN} (bookworm) or newer is needed; write it to the SD card anew",
        )
    if system.python < MIN_PYTHON:
        return _problem("system", f"Python {python} is too old, {'.'.join(map(str, MIN_PYTHON))} is needed")
    if system.uid != 0 and system.live and not dry_run:
        return _problem("system", f"the setup changes the system: sudo tsgt setup {role.word}")
    return Step(name="system", detail=f"{name}, Python {python}" if system.live else f"image of {name}")


def spi_devices(system: System) -> list[str]:
    """Return the names of the SPI devices, such as ``spidev0.0``."""
    return sorted(path.name for path in system.path("/dev").glob("spidev*"))


def spi_step(system: System) -> Step:
    """Enable SPI in the configuration of the boot loader, and at once if the machine can."""
    name = next((each for each in _BOOT_CONFIGS if system.read(each) is not None), None)
    devices = spi_devices(system)
    if name is None:
        if devices:
            return Step(name="spi", detail=f"/dev/{devices[0]} exists")
        if not system.live:
            return Step(
                name="spi", detail=f"this image has no {_BOOT_CONFIGS[0]}: enable SPI on the machine itself"
            )
        return _problem(
            "spi",
            f"there is no /dev/spidev* and no {_BOOT_CONFIGS[0]}: this is no Raspberry Pi; enable SPI as its maker says",
        )
    before = system.read(name) or ""
    after = enable_spi(before)
    at_once = RunCommand(("dtparam", "spi=on"), live=True, required=False)
    if after != before:
        return Step(
            name="spi",
            detail=f"dtparam=spi=on in {name}",
            changes=(WriteFile(name=name, text=after, mode=None), *(() if devices else (at_once,))),
        )
    if not devices and system.live:
        return Step(name="spi", detail=f"dtparam=spi=on is in {name}", changes=(at_once,))
    return Step(name="spi", detail=f"/dev/{devices[0]} exists" if devices else f"dtparam=spi=on is in {name}")


def enable_spi(text: str) -> str:
    """Return a ``config.txt`` with ``dtparam=spi=on`` in force for every model; the same text if it is already."""
    section, lines, on = "all", text.splitlines(), False
    for number, line in enumerate(lines):
        if found := re.fullmatch(r"\s*\[(\S+)\]\s*", line):
            section = found[1]
        elif section == "all" and (found := re.fullmatch(r"(\s*dtparam=(?:.*,)?spi=)(\w+)(.*)", line)):
            lines[number] = f"{found[1]}on{found[3]}"
            on = True
    if not on:
        lines += [] if section == "all" else ["", "[all]"]
        lines += ["# for the radio of tsgt", "dtparam=spi=on"]
    return text if lines == text.splitlines() else "\n".join(lines) + "\n"


def user_step(system: System) -> Step:
    """Make the user of the services, the groups of the devices, and let the operator use them."""
    changes: list[Change] = []
    install = _installed(system, "sysusers", "tsgt.conf")
    members = {group: system.group_members(group) for group in (*GROUPS, USER)}
    complete = system.user_id(USER) is not None and all(
        found is not None and (group == USER or USER in found) for group, found in members.items()
    )
    if install or not complete:
        changes += install
        changes.append(_sysusers(system, "tsgt.conf"))
    if system.operator is not None:
        missing = [group for group, found in members.items() if system.operator not in (found or set())]
        changes += [_sysusers(system, "--inline", f"m {system.operator} {group}") for group in missing]
    detail = f"the user {USER} with the groups {', '.join(GROUPS)}"
    if system.operator is not None:
        detail += f"; {system.operator} may use the devices and read poses after the next login"
    return Step(name="user", detail=detail, changes=tuple(changes))


def _sysusers(system: System, *arguments: str) -> RunCommand:
    where = () if system.live else (f"--root={system.root}",)
    return RunCommand(("systemd-sysusers", *where, *arguments))


def key_step(system: System, key: bytes | None, *, replace: bool = False) -> Step:
    """Install the mission's key, or keep the one that is there.

    ``key``: None: the one that is there is expected. ``replace``: whether another key may be replaced.
    """
    before = (system.read(KEY) or "").strip().lower()
    if before and (key is None or before == key.hex()) and not _only_for_user(system):
        write = WriteFile(name=KEY, text=f"{before}\n", mode=0o600, owner=USER)
        return Step(name="key", detail=f"{KEY}, which again only {USER} can read", changes=(write,))
    if key is None:
        if before:
            return Step(name="key", detail=f"{KEY} is there and stays")
        return _problem(
            "key",
            f"{KEY} is missing: install the mission's key there; `tsgt radio key` makes a new one, and says how",
        )
    if before == key.hex():
        return Step(name="key", detail=f"{KEY} is the key of this mission")
    if before and not replace:
        return _problem(
            "key",
            f"{KEY} is the key of another mission, and stays; to take part in this one: --replace-key",
        )
    write = WriteFile(name=KEY, text=f"{key.hex()}\n", mode=0o600, owner=USER)
    return Step(name="key", detail=f"{KEY}, which only {USER} can read", changes=(write,))


def _only_for_user(system: System) -> bool:
    """Whether the key has the owner and mode that the daemon accepts."""
    status, user = system.path(KEY).stat(), system.user_id(USER)
    # In an image that is not prepared by root, no file can be given to another user.
    owned = system.uid != 0 or user is None or status.st_uid == user[0]
    return owned and stat.S_IMODE(status.st_mode) in (0o600, 0o400)


def configuration_step(system: System, role: Role, new: str, *, replace: bool) -> Step:
    """Write the configuration; an edited one only if ``replace``."""
    compared = compare_configuration(system.read(role.config), new, role.config)
    match compared.state:
        case State.SAME:
            return Step(name="configuration", detail=f"{role.config} is as asked for")
        case State.EDITED if not replace:
            return Step(
                name="configuration",
                detail=f"{role.config} was edited and stays; setup would write other lines (--replace-config writes them)",
            )
    changes: list[Change] = [WriteFile(name=role.config, text=new)]
    before = system.read(role.config)
    if before is not None and compared.state is State.EDITED:
        kept = f"{role.config}.before-setup"
        names = (kept if number == 1 else f"{kept}-{number}" for number in count(1))
        free = next(name for name in names if not system.path(name).exists())
        changes.insert(0, WriteFile(name=free, text=before))
    return Step(name="configuration", detail=role.config, changes=tuple(changes))


def services_step(system: System, role: Role, *, network: bool | None = None) -> Step:
    """Install unit and udev rules, and let the service start at boot.

    ``network``: whether its instrument is in the network, which it may use then; None leaves that as it is.
    """
    unit: list[Change] = [*_installed(system, "systemd", role.unit)]
    text = _content("systemd", "network-instrument.conf")
    name = f"/etc/systemd/system/{role.unit}.d/network-instrument.conf"
    found = system.read(name)
    if network and found is None:
        unit.append(WriteFile(name=name, text=text))
    elif found == text and network is False:
        unit.append(RemoveFile(name=name))
    rules = _installed(system, "udev", "60-tsgt.rules")
    changes: list[Change] = [*unit, *rules]
    if unit or _restart_is_due(system, role):  # an interrupted setup may have left a unit that is not loaded
        changes.append(RunCommand(("systemctl", "daemon-reload"), live=True))
    if rules:
        changes.append(RunCommand(("udevadm", "control", "--reload"), live=True))
        changes.append(RunCommand(("udevadm", "trigger"), live=True, required=False))
    wanted = system.path(f"/etc/systemd/system/multi-user.target.wants/{role.unit}")
    if not wanted.is_symlink():
        where = () if system.live else (f"--root={system.root}",)
        changes.append(RunCommand(("systemctl", *where, "enable", role.unit)))
    return Step(
        name="services",
        detail=f"{role.unit} starts at boot; udev rules for serial adapters",
        changes=tuple(changes),
    )


def journal_step(system: System) -> Step:
    """Keep the system's log over power cuts."""
    install = _installed(system, "journald", "tsgt.conf")
    changes: tuple[Change, ...] = tuple(install)
    if install:
        changes += (RunCommand(("systemctl", "restart", "systemd-journald"), live=True, required=False),)
    return Step(
        name="journal", detail="the log is kept on disk, and synchronised every 10 s", changes=changes
    )


def clock_step(system: System, role: Role) -> Step:
    """Keep NTP from steering the clock of a station; the master's is the operator's decision."""
    if role is MASTER:
        return Step(name="clock", detail="NTP is left as it is; poses use the time of this clock")
    if not system.live:
        return Step(name="clock", detail="NTP is switched off when setup runs on the machine itself")
    ran = system.run(("timedatectl", "show", "--property=NTP"))
    if ran.code != 0 or "NTP=yes" not in ran.output:
        return Step(name="clock", detail="NTP does not steer this clock, as a station needs it")
    change = RunCommand(("timedatectl", "set-ntp", "false"), required=False)
    return Step(
        name="clock", detail="NTP does not steer this clock, as a station needs it", changes=(change,)
    )


def before_restart(system: System, role: Role, step: Step) -> Step:
    """Return a step after whose changes the service has to be started again, if not by this setup, by the next."""
    if not (system.live and step.ok and step.changes) or _restart_is_due(system, role):
        return step
    return replace(step, changes=(WriteFile(name=role.restart_due, text=""), *step.changes))


def _restart_is_due(system: System, role: Role) -> bool:
    return system.live and system.path(role.restart_due).exists()


def start_step(system: System, role: Role) -> Step:
    """Start the service; start it again if this or an interrupted setup has changed something."""
    if not system.live:
        return Step(name="service", detail=f"{role.unit} starts when this system is booted")
    active = system.run(("systemctl", "is-active", role.unit)).code == 0
    due = _restart_is_due(system, role)
    if active and not due:
        return Step(name="service", detail=f"{role.unit} is running")
    failure = f"{role.unit} does not start: journalctl -u {role.unit} -b -n 20"
    return Step(
        name="service",
        detail=f"{role.unit} is running",
        changes=(
            RunCommand(("systemctl", "restart", role.unit), failure=failure),
            *([RemoveFile(name=role.restart_due)] if due else []),
        ),
    )


def _installed(system: System, kind: str, name: str) -> Sequence[Change]:
    """Return the change that installs a file of ours; nothing if it is in force already."""
    text = _content(kind, name)
    folders = _FOLDERS[kind]
    found = next(
        (there for folder in folders if (there := system.read(f"{folder}/{name}")) is not None), None
    )
    return [] if found == text else [WriteFile(name=f"{folders[0]}/{name}", text=text)]


def _content(kind: str, name: str) -> str:
    return (files("tsgt.setup") / "files" / kind / name).read_text(encoding="utf-8")


def _problem(name: str, detail: str) -> Step:
    return Step(name=name, ok=False, detail=detail)
