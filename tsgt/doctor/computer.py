"""Checks of the computer itself: who runs the daemon, whether it starts by itself, and what its clock does."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tsgt.doctor.finding import failed, note, ok, skipped

if TYPE_CHECKING:
    from collections.abc import Mapping

    from tsgt.doctor.finding import Finding
    from tsgt.doctor.machine import Machine, User

Kind = Literal["client", "master"]

EARLIEST = datetime(2026, 1, 1, tzinfo=UTC)
"""A clock that shows less has not been set since the machine was switched on."""

GOOD_CLOCK_SOURCES = {"arch_sys_counter", "tsc", "timer", "kvm-clock", "stc"}
"""Of Pis (`arch_sys_counter`; `timer` and `stc` on the oldest), PCs and virtual machines: fine and quick to read."""

_PROPERTIES = (
    "LoadState,UnitFileState,ActiveState,SubState,User,SupplementaryGroups,ExecStart,"
    "ProtectSystem,StateDirectory,ReadWritePaths"
)


def service_of(machine: Machine, kind: Kind) -> dict[str, str] | None:
    """Return what systemd knows of a daemon's unit, by property; None where no systemd answers."""
    said = machine.run(["systemctl", "show", f"tsgt-{kind}.service", f"--property={_PROPERTIES}"])
    if said is None:
        return None
    pairs = (line.partition("=") for line in said.splitlines())
    return {key: value for key, _, value in pairs}


def is_installed(service: Mapping[str, str] | None) -> bool:
    """Whether there is a unit."""
    return service is not None and service.get("LoadState") == "loaded"


def may_write(service: Mapping[str, str] | None, folder: Path) -> bool:
    """Whether the unit lets its daemon write to a folder, whatever the folder's own rights are."""
    if service is None or not is_installed(service) or service.get("ProtectSystem") != "strict":
        return True
    allowed = [Path("/var/lib") / name for name in service.get("StateDirectory", "").split()]
    allowed += [Path(path.lstrip("+-")) for path in service.get("ReadWritePaths", "").split()]
    return any(folder.absolute().is_relative_to(path) for path in allowed)


def daemon_user(machine: Machine, service: Mapping[str, str] | None) -> User | None:
    """Return the user that the daemon runs as, who needs the rights; None where the unit names one who is not there."""
    if service is None or not is_installed(service) or not service.get("User"):
        return machine.user
    return machine.find_user(service["User"], service.get("SupplementaryGroups", "").split())


def check_user(machine: Machine, service: Mapping[str, str] | None) -> Finding:
    """Tell whose rights are judged, and whether that user exists."""
    user = daemon_user(machine, service)
    if user is None and service is not None:
        groups = service.get("SupplementaryGroups", "")
        return failed(
            "user",
            f"the service is to run as {service['User']} with the groups {groups}, and one of these is not on this "
            "machine: docs/how-to/install-for-the-field.md, step 1",
        )
    if user is None or user == machine.user:
        return ok("user", f"rights are judged for the user {machine.user.name}, who runs this")
    return ok("user", f"rights are judged for the user {user.name}, who runs the service")


def check_service(kind: Kind, config: Path, service: Mapping[str, str] | None) -> Finding:
    """Tell whether the daemon starts with the machine, and stays up."""
    unit = f"tsgt-{kind}"
    if service is None:
        return skipped(
            "service", f"no systemd answers here, so that nobody knows whether {unit} starts by itself"
        )
    if not is_installed(service):
        return note(
            "service",
            f"there is no unit {unit}.service: after a power cut somebody has to start {unit}; "
            "docs/how-to/install-for-the-field.md, step 4",
        )
    if service.get("UnitFileState") != "enabled":
        return failed("service", f"{unit} does not start with the machine: sudo systemctl enable {unit}")
    if service.get("ActiveState") == "failed" or service.get("SubState") == "auto-restart":
        return failed(
            "service", f"{unit} starts and ends again and again: journalctl -u {unit} -b -n 20 tells why"
        )
    read = re.search(r"--config[ =]([^\s;]+)", service.get("ExecStart", ""))
    if read and Path(read[1]).resolve() != config.resolve():
        return note("service", f"{unit} reads {read[1]}, not {config}: tsgt doctor {read[1]}")
    if service.get("ActiveState") == "active":
        return ok("service", f"{unit} starts with the machine, and runs")
    return ok("service", f"{unit} starts with the machine; it does not run now (sudo systemctl start {unit})")


def check_clock_source(machine: Machine) -> Finding:
    """Tell what the kernel counts time with."""
    source = machine.read(machine.sys / "devices/system/clocksource/clocksource0/current_clocksource")
    if not source:
        return skipped("clock_source", "the kernel does not say what it counts time with")
    if source in GOOD_CLOCK_SOURCES:
        return ok("clock_source", f"the kernel counts time with {source}")
    return note(
        "clock_source",
        f"the kernel counts time with {source}, which is slow to read or coarse: on a PC look into "
        "`dmesg | grep -i clocksource` for why it does not use tsc",
    )


def check_ntp(machine: Machine, kind: Kind) -> Finding:
    """Tell what the clock shows and who corrects it; a master needs it right, a client needs it left alone."""
    shown = datetime.fromtimestamp(machine.clock.realtime_ns() // 1_000_000_000, tz=UTC)
    text = f"it shows {shown:%Y-%m-%d %H:%M} UTC"
    if kind == "master" and shown < EARLIEST:
        return failed(
            "ntp",
            f"the clock is not set, {text}, and poses are in its time: sudo timedatectl set-ntp false, then "
            "sudo timedatectl set-time 'YYYY-MM-DD HH:MM:SS', before tsgt-master starts",
        )
    said = machine.run(["timedatectl", "show", "--property=NTP", "--property=NTPSynchronized"])
    if said is None:
        return skipped(
            "ntp", f"no timedatectl answers here, so that nobody knows who corrects the clock; {text}"
        )
    steered, settled = "NTP=yes" in said.splitlines(), "NTPSynchronized=yes" in said.splitlines()
    if kind == "client":
        if steered:
            return note(
                "ntp",
                "NTP corrects this clock where there is a network, and makes it run fast or slow meanwhile, which the "
                "master has to follow: sudo timedatectl set-ntp false",
            )
        return ok(
            "ntp", f"nobody corrects this clock, which is right for a client; {text}, which need not be right"
        )
    if steered and not settled:
        return note(
            "ntp",
            f"the clock waits to be corrected by NTP; {text}. Start tsgt-master after that, or, without a network: "
            "sudo timedatectl set-ntp false, then set-time",
        )
    if steered:
        return ok("ntp", f"NTP has set the clock; {text}")
    return ok(
        "ntp", f"nobody corrects this clock; {text} (if not: sudo timedatectl set-time 'YYYY-MM-DD HH:MM:SS')"
    )


def check_boot_id(machine: Machine) -> Finding:
    """Tell whether starts of this machine can be told apart."""
    if machine.read(machine.proc / "sys/kernel/random/boot_id"):
        return ok("boot_id", "each start of this machine has a name of its own")
    return note(
        "boot_id",
        f"{machine.proc}/sys/kernel/random/boot_id cannot be read: journals of two starts cannot be told apart; is "
        "/proc mounted?",
    )
