"""Live estimation: the order of records on stream and recording."""

from __future__ import annotations

from harness.drives.scene import START, stationary_scene

from tsgt.estimation import LiveEstimator
from tsgt.model import PolarMeasurement
from tsgt.recording import PoseRecord


def test_measurement_precedes_the_poses_that_it_completes() -> None:
    """Measurement precedes the poses that it completes."""
    scene = stationary_scene()
    feed = LiveEstimator(scene.parameters)
    records = [
        r
        for time_s in (0.0, 0.1)
        for station in (1, 2, 3)
        for r in feed.measurement(scene.measure(station, time_s))
    ]
    measured = [i for i, r in enumerate(records) if isinstance(r, PolarMeasurement)]
    poses = [i for i, r in enumerate(records) if isinstance(r, PoseRecord)]
    assert len(measured) == 6
    assert poses[-2:] == [measured[-1] + 1, measured[-1] + 2]


def test_overdue_pose_precedes_the_measurement() -> None:
    """Overdue pose precedes the measurement."""
    scene = stationary_scene()
    feed = LiveEstimator(scene.parameters)
    feed.measurement(scene.measure(1, 0.0))
    late = feed.measurement(scene.measure(1, 10.0))
    assert isinstance(late[0], PoseRecord)
    assert isinstance(late[-1], PolarMeasurement)


def test_received_time_is_not_before_an_earlier_call() -> None:
    """A replay passes on the measurement at the same point."""
    scene = stationary_scene()
    feed = LiveEstimator(scene.parameters)
    feed.advance(START + 5_000_000_000)
    records = feed.measurement(scene.measure(1, 0.0))
    assert isinstance(records[0], PolarMeasurement)
    assert records[0].received_ns == START + 5_000_000_000
    assert records[0].stamp_ns == START


def test_deadline_is_the_estimators() -> None:
    """Deadline is the estimators."""
    scene = stationary_scene()
    feed = LiveEstimator(scene.parameters)
    assert feed.next_deadline_ns() is None
    feed.measurement(scene.measure(1, 0.0))
    assert feed.next_deadline_ns() == START + 2_000_000_001
