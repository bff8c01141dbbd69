"""Checks of the serial line to the instrument: cable, rights, who has it, and the adapter's delay."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.doctor.finding import failed, note, ok, skipped

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.doctor.finding import Finding
    from tsgt.doctor.machine import Machine, User

SLOW_TIMER_MS = 2
"""A longer latency timer costs too much of the 50 ms that a measurement has at 20 Hz."""

RULES = "udev/rules.d/60-tsgt.rules"
INSTALL_RULES = (
    f"sudo install -m 644 configs/udev/60-tsgt.rules /etc/{RULES}, then "
    "sudo udevadm control --reload && sudo udevadm trigger"
)


def check_serial_port(machine: Machine, port: Path, user: User) -> Finding:
    """Tell whether the line is there, has a name that stays, and may be used."""
    names = _stable_names(machine)
    if not port.exists():
        if port.is_symlink():
            return failed("serial_port", f"{port} points to nothing: pull the cable out and put it in again")
        there = ", ".join(str(name) for name in names) or "no adapter at all"
        return failed(
            "serial_port",
            f"{port} is not there: is the cable in? There is: {there}. Where that is the right one, put its name into "
            'the configuration: port = "..."',
        )
    device = port.resolve()
    if not user.may_use(device):
        return failed("serial_port", no_right(machine, device, user))
    if port.is_symlink():  # one of udev's, or a person's
        return ok("serial_port", f"{port} is there, and the user {user.name} may use it")
    same = [name for name in names if name.resolve() == device]
    if same:
        return note(
            "serial_port",
            f'{port} is there, but may have another name when it is plugged in again: port = "{same[0]}"',
        )
    return ok("serial_port", f"{port} is there, and the user {user.name} may use it")


def check_serial_port_free(machine: Machine, port: Path, *, daemon: bool) -> Finding:
    """Tell who has the line open."""
    if not port.exists():
        return skipped("serial_port_free", "there is no line")
    holder = line_holder(machine, port)
    if daemon:
        return ok("serial_port_free", f"the client that runs here has it{f' ({holder})' if holder else ''}")
    if holder:
        return failed(
            "serial_port_free", f"{port} is open in {holder}, and two programs garble it: end that one"
        )
    if _service_active(machine, "ModemManager") and not (machine.etc / RULES).exists():
        return note(
            "serial_port_free",
            f"nobody has it, but ModemManager runs and talks to each line that is plugged in: {INSTALL_RULES}",
        )
    return ok(
        "serial_port_free",
        "nobody else has it" + ("" if machine.user.uid == 0 else ", as far as you may see"),
    )


def check_latency_timer(machine: Machine, port: Path) -> Finding:
    """Tell how long the adapter keeps received bytes to itself."""
    if not port.exists():
        return skipped("latency_timer", "there is no line")
    timer_ms = machine.latency_timer_ms(port)
    if timer_ms is None:
        return ok("latency_timer", "this line has none: only FTDI adapters keep bytes back")
    if timer_ms <= SLOW_TIMER_MS:
        return ok("latency_timer", f"the adapter hands bytes over after {timer_ms} ms")
    device = port.resolve().name
    return failed(
        "latency_timer",
        f"the adapter keeps bytes back for {timer_ms} ms, which makes stamps late: "
        f"echo 1 | sudo tee /sys/bus/usb-serial/devices/{device}/latency_timer; for good: {INSTALL_RULES}",
    )


def line_holder(machine: Machine, port: Path) -> str | None:
    """Return who has a line open; None where nobody does, or it cannot be told."""
    device = port.resolve()
    # Whoever plays an instrument on a pseudo-terminal has both of its ends; a second user finds it locked.
    return None if device.parent.name == "pts" else machine.port_holder(device)


def _stable_names(machine: Machine) -> list[Path]:
    return sorted((machine.dev / "serial" / "by-id").glob("*"))


def _service_active(machine: Machine, unit: str) -> bool:
    return machine.run(["systemctl", "is-active", f"{unit}.service"]) is not None


def no_right(machine: Machine, device: Path, user: User) -> str:
    """Say what to do for a user who may not use a device: join its group, where that helps."""
    found = device.stat()
    group = machine.group_name(found.st_gid)
    if found.st_gid == 0 or found.st_mode & 0o060 != 0o060:
        return (
            f"the user {user.name} may not use {device}, which is left to root: {INSTALL_RULES} (for SPI and GPIO; a serial "
            "port of another kind needs a rule of its own)"
        )
    return f"the user {user.name} may not use {device}: sudo usermod -aG {group} {user.name}, then log in or start it again"
