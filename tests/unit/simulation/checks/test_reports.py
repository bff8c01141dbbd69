"""Checks of what the status says of stations and disk, and of the published set-up, on small made-up logs."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from harness.files.records import PARAMETERS, START

from tsgt.recording.setup_record import SetupRecord
from tsgt.simulation.checks.setup_lines import beacon_failures, setup_failures
from tsgt.simulation.checks.station_reports import report_failures

SECOND = 1_000_000_000


def _result(*, drain_hz: float = -1.0, battery: int = 85, at_end: int = 85, bytes_per_s: int = 0) -> Any:
    """Return a mission of 20 s in which one station gets one more outstanding measurement each second."""
    statuses = [
        SimpleNamespace(
            stamp_ns=START + at_s * SECOND,
            stations=[
                SimpleNamespace(
                    id=1,
                    joined=True,
                    outstanding=at_s,
                    drain_rate_hz=drain_hz if at_s >= 10 else None,
                    battery_percent=battery,
                )
            ],
            recording=SimpleNamespace(bytes=bytes_per_s * at_s, waiting_lines=0),
        )
        for at_s in range(20)
    ]
    full = SimpleNamespace(event="disk_full", stamp_ns=START + 5 * SECOND)
    log = SimpleNamespace(statuses=statuses, events=[full], unix_at_zero_ns=START)
    before, newer, last = (SimpleNamespace(battery_percent=percent) for percent in (60, 85, at_end))
    station_log = SimpleNamespace(statuses=[before, last], reportable_status=newer)
    return SimpleNamespace(master_logs=[log], station_logs={1: station_log})


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({}, ""),
        ({"drain_hz": 1.0}, "drains"),
        ({"battery": 100}, "battery"),
        ({"battery": 60}, "battery"),  # of before
        ({"at_end": 95}, ""),  # read too late to arrive
        ({"bytes_per_s": 100}, "is written"),
    ],
)
def test_wrong_report_is_detected(change: dict[str, Any], what: str) -> None:
    """A drain rate with the wrong sign, another battery or an old one, a disk that is full no longer."""
    found = list(report_failures(_result(**change)))
    assert len(found) == bool(what)
    assert all(what in each for each in found)


def test_setup_with_another_frame_is_detected() -> None:
    """A station's position in the published set-up."""
    setup = SetupRecord.of(PARAMETERS, START)
    moved = replace(setup.stations[0], position_m=(1.0, 2.0, 3.0))
    wrong = replace(setup, stations=(moved, *setup.stations[1:]))
    result: Any = SimpleNamespace(parameters=PARAMETERS)
    for each, count in ((setup, 0), (wrong, 1)):
        log: Any = SimpleNamespace(setups=[each], parameters=None)
        assert len(list(setup_failures(log, result))) == count


@pytest.mark.parametrize(("shift", "count"), [(0, 0), (1, 1)])
def test_beacon_with_another_number_is_detected(shift: int, count: int) -> None:
    """Frames differ in duration, so the number of the next beacon tells another time."""
    sent_us = {(7, counter): 350_000 * counter + 20_000 * (counter % 3) for counter in range(30)}
    beacons_ns = {
        (7, counter + shift): START + 1000 * us for (_, counter), us in sent_us.items() if counter < 29
    }
    log: Any = SimpleNamespace(beacons_ns=beacons_ns, unix_at_zero_ns=START)
    index: Any = SimpleNamespace(sent_us=sent_us)
    assert len(list(beacon_failures(log, {1: index}))) == count
