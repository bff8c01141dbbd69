from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.scene import SECOND, START, stationary_scene

from tsgt.analysis.report.log import Log, read_log
from tsgt.analysis.report.stations import station_records, station_statistics
from tsgt.model import Status

if TYPE_CHECKING:
    from pathlib import Path


def test_station_statistics() -> None:
    """Rate, gaps, statuses and delays are those of its measurements; one sent twice counts once."""
    scene = stationary_scene()
    times_s = [0.0, 0.5, 1.0, 1.5, 4.0, 4.5, 5.0]
    measurements = [scene.measure(1, t) for t in times_s]
    measurements += [measurements[0], scene.measure(1, 2.0, status=Status.NO_TARGET)]
    records = station_records(measurements, [1, 2])
    assert [record.station for record in records] == [1, 2]
    found = station_statistics(records[0], start_ns=START, end_ns=START + 5 * SECOND, outage_limit_ns=SECOND)
    assert (found.measurements, found.usable) == (8, 7)
    assert found.rate_hz == pytest.approx(6 / 5)
    assert found.longest_gap_s == pytest.approx(2.5)
    assert found.gaps == 1
    assert found.in_gaps == pytest.approx(0.5)
    assert found.statuses == {"ok": 7, "no_target": 1}
    assert found.delay_median_s == pytest.approx(0.1)
    assert np.isnan(found.bound_max_ms)


def test_merged_measurements_have_no_delay() -> None:
    """They arrived by no radio: a merge sets the time of arrival to that of the measurement."""
    scene = stationary_scene()
    made = [scene.measure(1, t) for t in (0.0, 0.5, 1.0, 1.5, 2.0)]
    merged = [replace(each, received_ns=each.stamp_ns) for each in made[2:]]
    (record,) = station_records([*made[:2], *merged], [1])
    found = station_statistics(record, start_ns=START, end_ns=START + 5 * SECOND, outage_limit_ns=SECOND)
    assert (found.delay_median_s, found.delay_p95_s) == pytest.approx((0.1, 0.1))
    (record,) = station_records(merged, [1])
    found = station_statistics(record, start_ns=START, end_ns=START + 5 * SECOND, outage_limit_ns=SECOND)
    assert np.isnan(found.delay_median_s)


def test_station_without_measurements_is_one_gap() -> None:
    """It has an entry nevertheless."""
    (record,) = station_records([], [3])
    found = station_statistics(record, start_ns=START, end_ns=START + 5 * SECOND, outage_limit_ns=SECOND)
    assert found.usable == 0
    assert (found.gaps, found.in_gaps, found.longest_gap_s) == (1, 1.0, 5.0)
    assert np.isnan(found.rate_hz)


@pytest.mark.parametrize(
    "record",
    [
        {"type": "clock", "stamp_ns": 5},
        {"type": "clock", "stamp_ns": 5, "station": [], "offset_ns": 1, "bound_ns": 1, "restarted": False},
        {"type": "clock", "stamp_ns": 5, "station": 2, "offset_ns": None, "bound_ns": 1, "restarted": False},
        {"type": "clock", "stamp_ns": 5, "station": 2, "offset_ns": 2**63, "bound_ns": 1, "restarted": False},
        {"type": "event", "message": "x"},
        {"type": "event", "stamp_ns": 2**64, "message": "x"},
        {"type": "status", "stamp_ns": 5, "stations": [{"rssi_dbm": -60.0}]},
        {"type": "status", "stamp_ns": 5, "stations": [{"id": 2, "rssi_dbm": "loud"}]},
        {"type": "status", "stamp_ns": 5, "stations": 3},
        {"type": ["status"], "stamp_ns": 5},
    ],
)
def test_log_record_with_missing_or_wrong_fields_is_skipped(
    tmp_path: Path, record: dict[str, object]
) -> None:
    """The report is not lost for an illustration."""
    path = tmp_path / "recording.jsonl"
    event = {"type": "event", "stamp_ns": 6, "message": "station 2 is lost"}
    path.write_text(f"{json.dumps(record)}\n{json.dumps(event)}\n", encoding="utf-8")
    assert read_log(path) == Log({}, {}, ((6, "station 2 is lost"),), None, None)


def test_radio_clocks_and_events_are_read(tmp_path: Path) -> None:
    """Unknown values are NaN; unreadable lines are skipped."""
    path = tmp_path / "recording.jsonl"
    station = {"id": 2, "rssi_dbm": -60.5, "snr_db": None, "loss": 0.25}
    clock = {"type": "clock", "stamp_ns": 5, "station": 2, "offset_ns": -7, "bound_ns": 9, "restarted": True}
    status = {
        "type": "status",
        "stamp_ns": 4,
        "stations": [station],
        "protocol": "classic",
        "authenticated": False,
    }
    event = {"type": "event", "stamp_ns": 6, "message": "station 2 is lost"}
    lines = [json.dumps(record) for record in (status, clock, event)]
    path.write_text("\n".join([*lines, '{"type":"status", torn']), encoding="utf-8")
    log = read_log(path)
    assert log.radio[2].rssi_dbm.tolist() == [-60.5]
    assert np.isnan(log.radio[2].snr_db).all()
    assert log.radio[2].loss.tolist() == [0.25]
    assert log.clocks[2].offset_ns.tolist() == [-7]
    assert log.events == ((6, "station 2 is lost"),)
    assert (log.protocol, log.authenticated) == ("classic", False)
