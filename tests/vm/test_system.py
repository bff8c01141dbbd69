"""What happens to the machine while both services run: its clock, its disk, an upgrade, and a restart.

The tests follow each other on one guest, and each leaves it measuring.
"""

from __future__ import annotations

import json
from datetime import timedelta
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import pytest
from vm.guest import BOOT_TIME
from vm.installation import build_wheel, wait_for_measurements

if TYPE_CHECKING:
    from pathlib import Path

    from vm.guest import Guest

DATA = "/var/lib/tsgt"
UPGRADED = "99.0.0"


def recording(guest: Guest) -> list[dict[str, Any]]:
    """Return the records of the master's newest recording."""
    path = guest.output(f"ls -t {DATA}/master-*.jsonl | head -1")
    return [json.loads(line) for line in guest.pull(path).splitlines()]


@pytest.mark.parametrize("step", ["yesterday", "tomorrow"])
def test_clock_is_stepped(measuring: Guest, step: str) -> None:
    """An event says so; times of measurements and poses go on as if nothing had happened."""
    measuring.output(f"date --set {step}")
    wait_for_measurements(measuring, 6)
    records = recording(measuring)
    assert any(record.get("event") == "unix_clock_stepped" for record in records)
    stamps_ns = [record["stamp_ns"] for record in records if record["type"] == "beacon"]
    assert all(0 < b - a < 5e9 for a, b in pairwise(stamps_ns))


def test_full_disk(measuring: Guest) -> None:
    """Nothing is acknowledged while nothing can be written, and all measurements are recorded afterwards."""
    measuring.output(f"dd if=/dev/zero of={DATA}/filler bs=64k status=none; true")
    measuring.wait("systemctl show -P StatusText tsgt-client | grep 'disk fails'", 60)
    measuring.output(f"rm {DATA}/filler")
    measuring.wait("systemctl show -P StatusText tsgt-client | grep -v 'disk fails'", 60)
    wait_for_measurements(measuring, 6)
    records = recording(measuring)
    sequences = sorted(record["sequence"] for record in records if record["type"] == "measurement")
    assert sequences == list(range(sequences[0], sequences[-1] + 1))


def test_upgrade_while_running(measuring: Guest, tmp_path: Path) -> None:
    """Pip replaces the program below the running services, which do not mind; the new one runs from the next start."""
    wheel = build_wheel(tmp_path, version=UPGRADED)
    measuring.push(wheel, f"/root/{wheel.name}")
    measuring.output(f"/opt/tsgt/bin/pip install --quiet --no-index --no-deps /root/{wheel.name}", 120)
    wait_for_measurements(measuring)
    assert measuring.output("systemctl show -P NRestarts tsgt-client tsgt-master").split() == ["0", "0"]
    measuring.output("systemctl restart tsgt-client tsgt-master", 60)
    wait_for_measurements(measuring)
    assert recording(measuring)[0]["software"] == f"tsgt {UPGRADED}"


def test_reboot_with_a_clock_of_yesterday(measuring: Guest) -> None:
    """A Pi without a battery clock starts in the past: the services start by themselves, and no file is overwritten."""
    before = measuring.output(f"cd {DATA}; ls *.jsonl").split()
    first = {name: measuring.pull(f"{DATA}/{name}") for name in before}
    measuring.shut_down()
    measuring.start(clock=BOOT_TIME - timedelta(days=1))
    measuring.plug_adapter()
    wait_for_measurements(measuring, timeout_s=120)
    assert measuring.output("systemctl show -P NRestarts tsgt-client tsgt-master").split() == ["0", "0"]
    after = measuring.output(f"cd {DATA}; ls *.jsonl").split()
    assert len(after) == len(before) + 2
    for name, content in first.items():
        assert measuring.pull(f"{DATA}/{name}").startswith(content)
