"""What must work again after faults."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.files.records import HEADER, measurement

from tsgt.recording import encode_line
from tsgt.recording.journal import JournalRecord
from tsgt.simulation.checks.liveness import (
    contradicted_by_station,
    follows_another,
    pose_share,
    poses_due_from_s,
)
from tsgt.simulation.instrument.model import ReportedDistance
from tsgt.simulation.mission import JournalIndex, StationLog

if TYPE_CHECKING:
    from pathlib import Path


def test_poses_are_expected_unless_a_needed_imu_is_knocked_or_contradicted() -> None:
    """Three stations go on alone; fewer have nothing to go on with."""
    assert pose_share("superframe", stations=3, knocked=True, contradicted=False) == 0.5
    assert pose_share("superframe", stations=2, knocked=False, contradicted=False) == 0.5
    assert pose_share("classic", stations=1, knocked=False, contradicted=False) == 0.35
    assert pose_share("superframe", stations=2, knocked=True, contradicted=False) == 0.0
    assert pose_share("superframe", stations=2, knocked=False, contradicted=True) == 0.0
    assert pose_share("superframe", stations=3, knocked=False, contradicted=True) == 0.5


@pytest.mark.parametrize(
    ("stations", "moves_at_s", "due_s"),
    [(1, 0.0, 190.0), (1, 205.0, 210.3), (1, 218.0, 220.0), (1, 300.0, 220.0), (2, 205.0, 190.0)],
)
def test_no_pose_of_one_station_is_due_before_the_robot_has_moved(
    stations: int, moves_at_s: float, due_s: float
) -> None:
    """After a start its heading shows only in motion, here of 1 m/s."""

    def true_poses(times_s: np.ndarray) -> np.ndarray:
        poses = np.tile(np.eye(4), (len(times_s), 1, 1))
        poses[:, 0, 3] = np.maximum(times_s - moves_at_s, 0.0)
        return poses

    result: Any = SimpleNamespace(
        parameters=SimpleNamespace(stations=[None] * stations), true_poses=true_poses
    )
    assert poses_due_from_s(result, 190.0, 220.0) == pytest.approx(due_s, abs=0.11)


@pytest.mark.parametrize(("prism", "at_s", "expected"), [(2, 12.0, True), (2, 20.0, False), (1, 12.0, False)])
def test_station_on_another_prism_is_known(prism: int, at_s: float, *, expected: bool) -> None:
    """Its measurements contradict the IMU as those of a tripod that has moved."""
    reported = ReportedDistance(0, 10_000_000_000, 0.0, 1.5, 50.0, prism, 0)
    log = StationLog(station=1, folder=None, reported_distances=[reported])
    assert follows_another(log, 1, at_s, 5.0) is expected


@pytest.mark.parametrize(
    ("events", "expected"),
    [
        ([], False),
        ([("imu_setup_wrong", 50)], True),
        ([("imu_setup_wrong", 70)], False),
        ([("imu_setup_wrong", 50), ("imu_setup_confirmed", 85)], False),
        ([("imu_setup_wrong", 50), ("imu_setup_confirmed", 95)], True),
        ([("station_contradicted", 13)], True),
        ([("station_contradicted", 50)], False),
    ],
)
def test_event_that_a_station_on_another_prism_has_caused_is_known(
    events: list[tuple[str, int]], *, expected: bool
) -> None:
    """No poses of few stations are expected from 90 s on while the set-up of the IMU is not confirmed again, or after the other event."""
    reported = ReportedDistance(10_000, 10_000_000_000, 0.0, 1.5, 50.0, 2, 0)
    log = StationLog(station=1, folder=None, reported_distances=[reported])
    result: Any = SimpleNamespace(parameters=SimpleNamespace(stations=[SimpleNamespace(station=1, prism=1)]))
    master_log: Any = SimpleNamespace(
        unix_at_zero_ns=5,
        events=[SimpleNamespace(event=name, stamp_ns=5 + at_s * 1_000_000_000) for name, at_s in events],
        measurements=[],
    )
    index: Any = SimpleNamespace(station_log=log, journalled_by_start=[])
    assert contradicted_by_station(result, master_log, {1: index}, 90.0) is expected


@pytest.mark.parametrize(
    ("late_ms", "at_s", "expected"), [(8, 50, True), (8, 70, False), (3, 50, False), (-8, 50, False)]
)
def test_event_that_late_stamps_have_caused_is_known(
    tmp_path: Path, late_ms: int, at_s: int, *, expected: bool
) -> None:
    """Those of a client whose instrument slows down gradually, here by one measurement at 10 s."""
    taken = replace(measurement(0), instrument_time_ns=10_000_000_000)
    assert taken.slope_distance_m is not None
    assert taken.host_time_ns is not None
    reported = ReportedDistance(
        10_000,
        10_000_000_000,
        taken.horizontal_angle_rad,
        taken.zenith_angle_rad,
        taken.slope_distance_m,
        1,
        0,
    )
    head = JournalRecord(station=1, unix_at_zero_ns=0, boot="boot", first_sequence=0)
    (tmp_path / "1.jsonl").write_bytes(b"".join(encode_line(each) + b"\n" for each in (HEADER, head, taken)))
    stamps_ns = {taken.host_time_ns: reported.true_ns + late_ms * 1_000_000}
    result: Any = SimpleNamespace(parameters=SimpleNamespace(stations=[SimpleNamespace(station=1, prism=1)]))
    master_log: Any = SimpleNamespace(
        unix_at_zero_ns=5,
        events=[SimpleNamespace(event="imu_setup_wrong", stamp_ns=5 + at_s * 1_000_000_000)],
        measurements=[],
    )
    index = JournalIndex(StationLog(1, tmp_path, [reported], stamps_ns))
    assert contradicted_by_station(result, master_log, {1: index}, 90.0) is expected


@pytest.mark.parametrize(("prism", "at_s", "expected"), [(2, 50, True), (2, 70, False), (1, 50, False)])
def test_event_that_another_prism_number_has_caused_is_known(
    prism: int, at_s: int, *, expected: bool
) -> None:
    """The station follows its prism, and its client gives the measurements another number, at 10 s."""
    result: Any = SimpleNamespace(parameters=SimpleNamespace(stations=[SimpleNamespace(station=1, prism=1)]))
    master_log: Any = SimpleNamespace(
        unix_at_zero_ns=5,
        events=[SimpleNamespace(event="imu_setup_wrong", stamp_ns=5 + at_s * 1_000_000_000)],
        measurements=[SimpleNamespace(station=1, prism=prism, stamp_ns=10_000_000_005)],
    )
    index: Any = SimpleNamespace(station_log=StationLog(station=1, folder=None), journalled_by_start=[])
    assert contradicted_by_station(result, master_log, {1: index}, 90.0) is expected
