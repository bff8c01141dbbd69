"""Both services under systemd with the shipped units: flow of measurements, and faults of cable, bus, chip and process.

The tests follow each other on one guest, and each leaves it measuring.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from vm.guest import ADAPTER_PORT
from vm.installation import wait_for_measurements

if TYPE_CHECKING:
    from vm.guest import Guest

SERVICES = ("tsgt-client", "tsgt-master")
CLIENT_RADIO = 0

EIO = 5
ETIMEDOUT = 110


def restarts(guest: Guest) -> list[int]:
    """Return how often systemd has restarted each service."""
    return [int(guest.output(f"systemctl show -P NRestarts {name}")) for name in SERVICES]


def tell_far_ends(guest: Guest, line: str) -> None:
    """Give the simulated hardware a command."""
    guest.output(f"echo {line} > /run/far_ends")


def test_units_as_shipped_measure(measuring: Guest) -> None:
    """Measurements reach the master's recording; nothing was restarted, and the kernel gave the adapter a short delay."""
    assert measuring.output(f"systemctl is-active {' '.join(SERVICES)}").split() == ["active", "active"]
    assert restarts(measuring) == [0, 0]
    tty = measuring.output(f"basename $(readlink {ADAPTER_PORT})")
    assert measuring.output(f"cat /sys/bus/usb-serial/devices/{tty}/latency_timer") == "1"
    measuring.output("systemctl show -P StatusText tsgt-client | grep 'Hz, master'")


def test_adapter_unplugged_and_plugged_in(measuring: Guest) -> None:
    """The client says that it has no instrument, and measures again without a restart."""
    measuring.unplug_adapter()
    measuring.wait("systemctl show -P StatusText tsgt-client | grep 'no instrument'", 30)
    measuring.plug_adapter()
    wait_for_measurements(measuring)
    assert restarts(measuring) == [0, 0]


@pytest.mark.parametrize("error", [EIO, ETIMEDOUT])
def test_spi_errors(measuring: Guest, error: int) -> None:
    """The client loses its radio while transfers fail, and has it again when they work."""
    tell_far_ends(measuring, f"spi {CLIENT_RADIO} {error}")
    measuring.wait("systemctl show -P StatusText tsgt-client | grep 'no radio'", 30)
    tell_far_ends(measuring, f"spi {CLIENT_RADIO} 0")
    wait_for_measurements(measuring)
    assert restarts(measuring) == [0, 0]


def test_hung_chip(measuring: Guest) -> None:
    """A chip that no longer writes its registers is reset by its pin."""
    tell_far_ends(measuring, f"hang {CLIENT_RADIO}")
    measuring.wait("journalctl -u tsgt-client -o cat | grep radio_fault", 60)
    wait_for_measurements(measuring)
    assert restarts(measuring) == [0, 0]


def test_bus_that_never_answers(measuring: Guest) -> None:
    """Each transfer hangs in the kernel for 2 s; the client survives it, and its watchdog does not bite."""
    tell_far_ends(measuring, f"silent {CLIENT_RADIO} 1")
    measuring.wait("systemctl show -P StatusText tsgt-client | grep 'no radio'", 60)
    tell_far_ends(measuring, f"silent {CLIENT_RADIO} 0")
    wait_for_measurements(measuring)
    assert restarts(measuring) == [0, 0]


def test_stopped_processes_are_restarted(measuring: Guest) -> None:
    """The watchdog ends what no longer runs, 30 s and, as a stopped process does not abort, another 10 s later."""
    pids = [measuring.output(f"systemctl show -P MainPID {name}") for name in SERVICES]
    measuring.output(f"kill -STOP {' '.join(pids)}")
    for name in SERVICES:
        measuring.wait(f"[ $(systemctl show -P NRestarts {name}) = 1 ]", 90)
    wait_for_measurements(measuring, timeout_s=120)
    for name in SERVICES:
        measuring.output(f"journalctl -u {name} -o cat | grep 'Watchdog timeout'")
