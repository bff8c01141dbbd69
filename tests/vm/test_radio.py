"""Two radios through the kernel: spidev and gpiod as they are, with interrupts, and both ways to wire a chip select."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from vm.guest import Guest

COUNT = 4
PING = "/opt/tsgt/bin/tsgt radio ping --frequency-mhz 905 --json"
WIRINGS = {"pin": "--nss-pin 25", "ce0": "--nss-pin -1"}


@pytest.mark.parametrize("wiring", ["pin", "ce0", "pin again"])
def test_ping(guest: Guest, wiring: str) -> None:
    """The kernel keeps what the wiring before has set, so that each is followed by the other."""
    wiring, *_ = wiring.split()
    guest.output(f"echo wiring {wiring} > /run/far_ends")
    options = WIRINGS[wiring]
    out = guest.output(
        f"{PING} {options} --spi-bus 1 --gpio-chip /dev/gpiochip1 --answer --count {COUNT} > /run/answer.json & "
        f"sleep 4; {PING} {options} --count {COUNT}; wait",
        60,
    )
    result = json.loads(out)
    assert result["received"] == COUNT
    assert result["lost_edges"] == 0
    # From TxDone here to RxDone there is the air time of the reply, and what a Python program takes to answer.
    assert result["airtime_ms"] < result["round_trip_ms"]["median"] < result["airtime_ms"] + 60
    assert json.loads(guest.output("cat /run/answer.json"))["answered"] == COUNT
    guest.output("echo state > /run/far_ends; sleep 0.2")
    states = json.loads(guest.pull("/run/far_ends.json"))[:2]
    assert [state["warnings"] for state in states] == [[], []]
    assert [state["unselected"] for state in states] == [0, 0]


def test_missing_line(guest: Guest) -> None:
    """A GPIO chip raises another class of error for each mistake; each is one line that says what is wrong."""
    result = guest.run(f"{PING} --nss-pin 25 --dio0-pin 60 --count 1", 30)
    assert result.code == 1
    assert "BCM 60 (DIO0) is not available" in result.out
    assert "Traceback" not in result.out
