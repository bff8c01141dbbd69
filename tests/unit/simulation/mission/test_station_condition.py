"""Battery, atmosphere and state of an instrument, from the instrument to the operator's eyes."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from harness.files.records import START
from harness.missions.missions import SUPERFRAME, run_mission
from harness.readers.web import feed, mission, pose

from tsgt.cli.live.status_text import master_text
from tsgt.recording import EventRecord, StatusRecord, decode, read_lines

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.simulation.mission import Mission


async def low_battery_and_other_air(mission: Mission) -> None:
    """Set what the instruments report."""
    mission.instruments[2].battery_percent = 12.0
    mission.instruments[3].settings.atmospheric_ppm = 41.3


@pytest.mark.slow
def test_condition_reaches_status_event_terminal_and_page(tmp_path: Path) -> None:
    """Through driver, client, radio and master; a low battery is one event."""
    run_mission(tmp_path, duration_s=8.0, script=low_battery_and_other_air, protocol=SUPERFRAME)
    (recording,) = tmp_path.glob("master0/*.jsonl")
    lines = list(read_lines(recording))
    *_, status = (decode(StatusRecord, line.data) for line in lines if line.type == "status")
    events = [decode(EventRecord, line.data) for line in lines if line.type == "event"]
    assert [
        (each.battery_percent, each.atmospheric_ppm, each.activity, each.problem) for each in status.stations
    ] == [(85, 0.0, "tracking", ""), (12, 0.0, "tracking", "change its battery"), (85, 41.5, "tracking", "")]
    assert [(event.event, event.station) for event in events] == [("battery_low", 2)]

    text, ok = master_text(status)
    assert all(
        any(words in line for line in text)
        for words in ("battery 12 %", "change its battery", "atm. +41.5 ppm")
    )
    assert not ok

    state = mission()
    feed(state, replace(status, stamp_ns=START), pose(0.0), now_s=0.0)
    view = state.view(0.1)
    assert [(each["battery_percent"], each["air_ppm"], each["note"]) for each in view["stations"]] == [
        (85, 0.0, ""),
        (12, 0.0, "change its battery"),
        (85, 41.5, ""),
    ]
    assert (view["verdict"]["words"], view["verdict"]["cause"]) == ("CARE", "station 2: change its battery")
