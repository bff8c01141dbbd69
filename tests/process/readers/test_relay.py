"""The relay between two computers: network namespaces of this machine."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import pytest
from harness.readers.cable_cut import cut_cable
from harness.readers.network import FOLLOW, ROBOT_ADDRESS, TSGT, Master, missing, network

from tsgt.radio.key_file import write_key

if TYPE_CHECKING:
    from pathlib import Path

REASON = missing()
pytestmark = pytest.mark.skipif(bool(REASON), reason=REASON)


def test_cut_cable_loses_nothing(tmp_path: Path) -> None:
    """The reader goes on after the last line that it had; a pose that waited says how old it is."""
    outcome = cut_cable(tmp_path, cut_s=8, hold_s=60)
    assert outcome.outage_s > 7
    assert (outcome.repeated, outcome.out_of_order, outcome.gaps) == (0, 0, 0)
    assert outcome.received == outcome.sent
    assert outcome.stale_shown_fresh == 0


def test_lines_that_are_no_longer_held_are_told(tmp_path: Path) -> None:
    """The gap has the exact number of lines."""
    outcome = cut_cable(tmp_path, cut_s=8, hold_s=2)
    assert (outcome.repeated, outcome.out_of_order, outcome.gaps) == (0, 0, 1)
    assert outcome.told_missing > 40
    assert outcome.received + outcome.told_missing == outcome.sent
    assert outcome.stale_shown_fresh == 0


def test_wrong_key_gets_nothing(tmp_path: Path) -> None:
    """Not even the greeting, and the program ends with a word on the reason."""
    write_key(tmp_path / "relay.key")
    write_key(tmp_path / "other.key")
    socket = tmp_path / "poses.sock"
    relay = [
        *TSGT, "relay", "--socket", str(socket), "--key", str(tmp_path / "relay.key"), "--listen", ROBOT_ADDRESS,
    ]  # fmt: skip
    reader = [sys.executable, "-c", FOLLOW, f"relay://{ROBOT_ADDRESS}", str(tmp_path / "other.key")]
    with (
        network() as pair,
        Master(socket).running(),
        pair.start(pair.robot, relay, tmp_path, "relay") as serving,
    ):
        serving.wait_for("relay_source_connected")
        with pair.start(pair.reader, reader, tmp_path, "reader") as reading:
            reading.ended()
    assert reading.output.read_text() == ""
    assert "the relay has another key" in reading.log.read_text()
