"""The monitor: what it counts and what it says before anything came."""

from __future__ import annotations

from dataclasses import replace

from tsgt.master.monitor import Monitor
from tsgt.model import PolarMeasurement, Status

SECOND = 1_000_000_000

MEASUREMENT = PolarMeasurement(
    station=2,
    prism=2,
    sequence=0,
    stamp_ns=10 * SECOND,
    received_ns=10 * SECOND + 100_000_000,
    horizontal_angle_rad=1.0,
    zenith_angle_rad=1.5,
    slope_distance_m=20.0,
    host_time_ns=0,
)


def test_before_the_first_measurement() -> None:
    """A silent station is reported, with nulls instead of made-up numbers."""
    status = Monitor([1, 2]).status(SECOND)
    assert [(s.id, s.measurements, s.usable, s.age_s, s.status) for s in status.stations] == [
        (1, 0, 0, None, None),
        (2, 0, 0, None, None),
    ]


def test_counts_what_came_and_what_was_usable() -> None:
    """Measurements without position count, but not as usable; the last status is reported."""
    monitor = Monitor([1, 2])
    monitor.measurement(MEASUREMENT)
    monitor.measurement(replace(MEASUREMENT, sequence=1, stamp_ns=11 * SECOND, status=Status.NO_TARGET))
    station = monitor.status(12 * SECOND).stations[1]
    assert (station.measurements, station.usable, station.status) == (2, 1, Status.NO_TARGET)
    assert station.age_s == 1.0


def test_a_station_that_nobody_asked_about_is_passed_over() -> None:
    """A foreign station does not appear in the report."""
    monitor = Monitor([1])
    monitor.measurement(MEASUREMENT)
    assert monitor.status(12 * SECOND) == Monitor([1]).status(12 * SECOND)


def test_counts_poses() -> None:
    """Valid poses are counted within all poses."""
    monitor = Monitor([1])
    for valid in (True, False, True):
        monitor.pose(valid=valid)
    status = monitor.status(SECOND)
    assert (status.stamp_ns, status.poses, status.valid_poses) == (SECOND, 3, 2)
