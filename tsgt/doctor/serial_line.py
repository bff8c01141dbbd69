"""Checks of the serial line to the instrument: cable, permissions, other users, and the adapter's latency."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.doctor.finding import failed, note, ok, skipped

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.doctor.finding import Finding
    from tsgt.doctor.machine import Machine, User

SLOW_TIMER_MS = 2  # A longer latency timer takes too much of the 50 ms of a measurement at 20 Hz
RULES = "udev/rules.d/60-tsgt.rules"
INSTALL_RULES = "sudo tsgt setup station, or master, installs the udev rules"


def check_serial_port(machine: Machine, port: Path, user: User) -> Finding:
    """Check that the device exists, has a persistent name, and may be used."""
    names = _stable_names(machine)
    if not port.exists():
        if port.is_symlink():
            return failed("serial_port", f"{port} is a dangling link: unplug the cable and plug it in again")
        existing = ", ".join(str(name) for name in names) or "no adapter"
        return failed(
            "serial_port",
            f"{port} does not exist: is the cable plugged in? Found: {existing}. To use it, write its name into "
            'the configuration: port = "..."',
        )
    device = port.resolve()
    if not user.may_use(device):
        return failed("serial_port", access_hint(machine, device, user))
    if port.is_symlink():  # made by udev, or by hand
        return ok("serial_port", f"{port} exists, and the user {user.name} may use it")
    same = [name for name in names if name.resolve() == device]
    if same:
        return note(
            "serial_port",
            f'{port} exists, but may have another name when it is plugged in again: port = "{same[0]}"',
        )
    return ok("serial_port", f"{port} exists, and the user {user.name} may use it")


def check_serial_port_free(machine: Machine, port: Path, *, daemon: bool) -> Finding:
    """Check that no other process has the line open."""
    if not port.exists():
        return skipped("serial_port_free", "the device does not exist")
    holder = line_holder(machine, port)
    if daemon:
        return ok("serial_port_free", f"the running client has it open{f' ({holder})' if holder else ''}")
    if holder:
        return failed(
            "serial_port_free",
            f"{port} is open in {holder}, and two programs corrupt each other's data: end it",
        )
    if _service_active(machine, "ModemManager") and not any(
        (folder / RULES).exists() for folder in (machine.etc, machine.etc.parent / "usr/lib")
    ):
        return note(
            "serial_port_free",
            f"free, but ModemManager is running and opens each line that is plugged in: {INSTALL_RULES}",
        )
    return ok(
        "serial_port_free",
        "no other process has it open" + ("" if machine.user.uid == 0 else ", as far as this user can see"),
    )


def check_latency_timer(machine: Machine, port: Path) -> Finding:
    """Check the latency timer of the adapter."""
    if not port.exists():
        return skipped("latency_timer", "the device does not exist")
    timer_ms = machine.latency_timer_ms(port)
    if timer_ms is None:
        return ok("latency_timer", "this line has none: only FTDI adapters do")
    if timer_ms <= SLOW_TIMER_MS:
        return ok("latency_timer", f"the adapter delivers bytes after {timer_ms} ms")
    device = port.resolve().name
    return failed(
        "latency_timer",
        f"the adapter buffers bytes for {timer_ms} ms, which delays timestamps: "
        f"echo 1 | sudo tee /sys/bus/usb-serial/devices/{device}/latency_timer; permanently: {INSTALL_RULES}",
    )


def line_holder(machine: Machine, port: Path) -> str | None:
    """Return the process that has a line open; None if there is none or it is unknown."""
    device = port.resolve()
    # A simulated instrument has both ends of its pseudo-terminal open; a second user finds it locked.
    return None if device.parent.name == "pts" else machine.port_holder(device)


def _stable_names(machine: Machine) -> list[Path]:
    return sorted((machine.dev / "serial" / "by-id").glob("*"))


def _service_active(machine: Machine, unit: str) -> bool:
    return machine.run(["systemctl", "is-active", f"{unit}.service"]) is not None


def access_hint(machine: Machine, device: Path, user: User) -> str:
    """Return what a user without permission for a device has to do."""
    found = device.stat()
    group = machine.group_name(found.st_gid)
    if found.st_gid == 0 or found.st_mode & 0o060 != 0o060:
        return (
            f"the user {user.name} may not use {device}, which belongs to root: {INSTALL_RULES} (for SPI and GPIO; another "
            "kind of serial port needs its own rule)"
        )
    return f"the user {user.name} may not use {device}: sudo usermod -aG {group} {user.name}, then log in again, or restart the daemon"
