"""Checks of the computer: user and service of the daemon, clock source, NTP, boot id."""

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

EARLIEST = datetime(2026, 1, 1, tzinfo=UTC)  # A clock with an earlier time has not been set since power-on
GOOD_CLOCK_SOURCES = {"arch_sys_counter", "tsc", "timer", "kvm-clock", "stc"}
"""Clock sources of Raspberry Pis (`arch_sys_counter`; `timer` and `stc` on the oldest), PCs and virtual machines with fine resolution and fast access."""

_HIDDEN = (Path("/home"), Path("/root"), Path("/run/user"))  # from a unit with ProtectHome=yes (systemd.exec)

_PROPERTIES = (
    "LoadState,UnitFileState,ActiveState,SubState,User,SupplementaryGroups,ExecStart,"
    "ProtectSystem,ProtectHome,StateDirectory,ReadWritePaths,"
    "PrivateNetwork,RestrictAddressFamilies,IPAddressAllow,IPAddressDeny"
)


def service_of(machine: Machine, kind: Kind) -> dict[str, str] | None:
    """Return the properties of a daemon's unit by systemd; None without systemd."""
    output = machine.run(["systemctl", "show", f"tsgt-{kind}.service", f"--property={_PROPERTIES}"])
    if output is None:
        return None
    pairs = (line.partition("=") for line in output.splitlines())
    return {key: value for key, _, value in pairs}


def is_installed(service: Mapping[str, str] | None) -> bool:
    """Whether the unit exists."""
    return service is not None and service.get("LoadState") == "loaded"


def hides(service: Mapping[str, str] | None, path: Path) -> bool:
    """Whether the sandbox of the unit hides a file or folder from it; ReadWritePaths does not bring it back."""
    if service is None or not is_installed(service) or service.get("ProtectHome") != "yes":
        return False
    return any(path.absolute().is_relative_to(folder) for folder in _HIDDEN)


def may_write(service: Mapping[str, str] | None, folder: Path) -> bool:
    """Whether the sandbox of the unit permits writing to a folder."""
    if service is None or not is_installed(service) or service.get("ProtectSystem") != "strict":
        return True
    allowed = [Path("/var/lib") / name for name in service.get("StateDirectory", "").split()]
    allowed += [Path(path.lstrip("+-")) for path in service.get("ReadWritePaths", "").split()]
    return any(folder.absolute().is_relative_to(path) for path in allowed)


def daemon_user(machine: Machine, service: Mapping[str, str] | None) -> User | None:
    """Return the user of the daemon, whose permissions count; None if the user of the unit does not exist."""
    if service is None or not is_installed(service) or not service.get("User"):
        return machine.user
    return machine.find_user(service["User"], service.get("SupplementaryGroups", "").split())


def check_user(machine: Machine, service: Mapping[str, str] | None) -> Finding:
    """Check that the user of the daemon exists."""
    user = daemon_user(machine, service)
    if user is None and service is not None:
        groups = service.get("SupplementaryGroups", "")
        return failed(
            "user",
            f"the service runs as {service['User']} with the groups {groups}, and one of these does not exist on this "
            "machine: sudo tsgt setup station, or master, makes them",
        )
    if user is None or user == machine.user:
        return ok("user", f"permissions are checked for the user {machine.user.name}, who runs this")
    return ok("user", f"permissions are checked for the user {user.name} of the service")


def check_service(kind: Kind, config: Path, service: Mapping[str, str] | None) -> Finding:
    """Check that the daemon starts at boot and stays up."""
    unit = f"tsgt-{kind}"
    if service is None:
        return skipped("service", f"systemd does not respond, so it is unknown whether {unit} starts at boot")
    if not is_installed(service):
        return note(
            "service",
            f"there is no unit {unit}.service: after a power cut {unit} must be started by hand; "
            f"sudo tsgt setup {'station' if kind == 'client' else 'master'} installs it",
        )
    if service.get("UnitFileState") != "enabled":
        return failed("service", f"{unit} does not start at boot: sudo systemctl enable {unit}")
    if service.get("ActiveState") == "failed" or service.get("SubState") == "auto-restart":
        return failed("service", f"{unit} restarts repeatedly: see journalctl -u {unit} -b -n 20")
    read = re.search(r"--config[ =]([^\s;]+)", service.get("ExecStart", ""))
    if read and Path(read[1]).resolve() != config.resolve():
        return note("service", f"{unit} reads {read[1]}, not {config}: tsgt doctor {read[1]}")
    if service.get("ActiveState") == "active":
        return ok("service", f"{unit} starts at boot and is running")
    return ok("service", f"{unit} starts at boot; it is not running now (sudo systemctl start {unit})")


def check_clock_source(machine: Machine) -> Finding:
    """Check the clock source of the kernel."""
    source = machine.read(machine.sys / "devices/system/clocksource/clocksource0/current_clocksource")
    if not source:
        return skipped("clock_source", "the kernel does not report its clock source")
    if source in GOOD_CLOCK_SOURCES:
        return ok("clock_source", f"the kernel uses {source}")
    return note(
        "clock_source",
        f"the kernel uses {source}, which is slow to read or coarse: on a PC "
        "`dmesg | grep -i clocksource` says why it does not use tsc",
    )


def check_ntp(machine: Machine, kind: Kind) -> Finding:
    """Check the Unix clock: a master needs the right time, a client a clock that NTP does not steer."""
    shown = datetime.fromtimestamp(machine.clock.realtime_ns() // 1_000_000_000, tz=UTC)
    text = f"its time is {shown:%Y-%m-%d %H:%M} UTC"
    if kind == "master" and shown < EARLIEST:
        return failed(
            "ntp",
            f"the clock is not set, {text}, and poses use its time: sudo timedatectl set-ntp false, then "
            "sudo timedatectl set-time 'YYYY-MM-DD HH:MM:SS', before tsgt-master starts",
        )
    output = machine.run(["timedatectl", "show", "--property=NTP", "--property=NTPSynchronized"])
    if output is None:
        return skipped(
            "ntp", f"timedatectl does not respond, so it is unknown whether NTP steers the clock; {text}"
        )
    steered, synchronised = "NTP=yes" in output.splitlines(), "NTPSynchronized=yes" in output.splitlines()
    if kind == "client":
        if steered:
            return note(
                "ntp",
                "NTP steers this clock when there is a network, and changes its frequency, which the master has to "
                "estimate: sudo timedatectl set-ntp false",
            )
        return ok(
            "ntp", f"NTP does not steer this clock, as a client needs it; {text}, which need not be right"
        )
    if steered and not synchronised:
        return note(
            "ntp",
            f"the clock waits for NTP; {text}. Start tsgt-master after that, or, without a network: "
            "sudo timedatectl set-ntp false, then set-time",
        )
    if steered:
        return ok("ntp", f"NTP has set the clock; {text}")
    return ok(
        "ntp",
        f"NTP does not steer this clock; {text} (if that is wrong: sudo timedatectl set-time 'YYYY-MM-DD HH:MM:SS')",
    )


def check_boot_id(machine: Machine) -> Finding:
    """Check that boots of this machine can be distinguished."""
    if machine.read(machine.proc / "sys/kernel/random/boot_id"):
        return ok("boot_id", "the boot id of this machine is readable")
    return note(
        "boot_id",
        f"{machine.proc}/sys/kernel/random/boot_id cannot be read, so journals of two boots cannot be distinguished; is "
        "/proc mounted?",
    )
