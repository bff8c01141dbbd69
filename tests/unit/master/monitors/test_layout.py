"""The layout monitor: no alarm on good frames, real and simulated; an alarm when a tripod has moved."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.arrivals import simulated_measurements
from harness.files.records import NO_POSE, POSE, SECOND, START

from tsgt.analysis.formats import read_prisms, read_tracks
from tsgt.analysis.rts_import import point_measurements
from tsgt.config import FrameWatchConfig, ScenarioConfig, scenario_parameters
from tsgt.estimation import LiveEstimator
from tsgt.master.monitors.layout import LayoutMonitor
from tsgt.model import Parameters, StationParameters
from tsgt.recording import PoseRecord, StationShare
from tsgt.simulation.world import World

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from tsgt.model import Matrix4, Measurement
    from tsgt.recording import EventRecord
    from tsgt.recording.stream_records import Reason

PERIOD_NS = SECOND // 20


def pose(number: int, residual_mm: float, *, speed_mps: float = 0.0, reason: Reason = "") -> PoseRecord:
    """Build the pose with this number; station 2 misses by most."""
    return dataclasses.replace(
        POSE,
        stamp_ns=START + number * PERIOD_NS,
        velocity_mps=(0.0, speed_mps, 0.0),
        residual_m=residual_mm / 1e3,
        valid=not reason,
        reason=reason,
        stations=tuple(
            StationShare(id=id_, prism=id_, age_s=0.1, residual_m=residual_mm * share / 1e3, reason="")
            for id_, share in ((1, 0.5), (2, 1.2), (3, 0.7))
        ),
    )


def events(poses: Iterable[PoseRecord], **settings: float) -> list[EventRecord]:
    """Watch poses; all events."""
    watch = LayoutMonitor(FrameWatchConfig.model_validate(settings), PERIOD_NS)
    return [event for each in poses for event in watch.pose(each, each.stamp_ns + 7)]


def test_alarm_states_station_and_residual() -> None:
    """One event when three of four poses exceed the limit, with the most likely station and what is not observable."""
    (event,) = events([pose(n, 4.0) for n in range(200)] + [pose(200 + n, 9.0) for n in range(300)])
    assert (event.event, event.station) == ("layout_residual_high", 2)
    assert event.message == (
        "the prisms miss their layout by 9.0 mm, limit 6.0 mm (medians over 10 s): a tripod or a prism has moved, "
        "most likely of station 2; check with tsgt calibrate check; a movement across the plane of three prisms "
        "is not observable"
    )
    # Three quarters of a window after the step, and stamped when it was noticed.
    assert event.stamp_ns == START + 349 * PERIOD_NS + 7


def test_alarm_of_two_prisms_names_the_imu() -> None:
    """Its trajectory is what the prisms miss."""
    two = [dataclasses.replace(p, stations=p.stations[:2]) for p in (pose(n, 9.0) for n in range(300))]
    (event,) = events(two)
    assert "a tripod, a prism or the IMU has moved, most likely of station" in event.message
    assert event.message.endswith("; only what the IMU contradicts is observable")


def test_alarm_ends_below_the_hysteresis() -> None:
    """Between 0.8 and 1 times the limit nothing changes; below there is one event."""
    steps = [
        (9.0, "layout_residual_high"),
        (5.0, None),
        (3.0, "layout_residual_normal"),
        (5.0, None),
        (7.0, "layout_residual_high"),
    ]
    poses = [pose(300 * k + n, mm) for k, (mm, _) in enumerate(steps) for n in range(300)]
    assert [e.event for e in events(poses)] == [word for _, word in steps if word]


def test_alarm_needs_three_of_four_poses() -> None:
    """Interpolation distorts some poses of a moving robot, a wrong frame all of them."""
    assert events([pose(n, 1.0 if n % 5 == 0 else 9.0) for n in range(300)])
    assert not events([pose(n, 1.0 if n % 3 == 0 else 9.0) for n in range(300)])


def test_limit_grows_with_speed() -> None:
    """By default 6 mm per m/s."""
    assert not events([pose(n, 11.9, speed_mps=1.0) for n in range(300)])
    assert events([pose(n, 12.1, speed_mps=1.0) for n in range(300)])


def test_alarm_needs_a_third_of_the_window() -> None:
    """67 of 200 poses; 66 are too few."""
    assert not events([pose(n, 9.0) for n in range(66)])
    assert events([pose(n, 9.0) for n in range(67)])


def test_poses_with_gaps_raise_the_alarm() -> None:
    """Half a second of poses in every five: 67 are collected over half a minute, but not over more than two."""
    (event,) = events([pose(n + 90 * (n // 10), 9.0) for n in range(200)])
    assert event.stamp_ns == START + (66 + 90 * 6) * PERIOD_NS + 7
    assert "(medians over 30 s)" in event.message
    assert not events([pose(n + 590 * (n // 10), 9.0) for n in range(200)])


def test_old_poses_do_not_outvote_new_ones() -> None:
    """After a gap, those from before it count only until there are enough new ones."""
    bad = [pose(n, 9.0) for n in range(100)]
    assert [e.event for e in events(bad + [pose(n + 1000, 2.0) for n in range(100)])] == [
        "layout_residual_high",
        "layout_residual_normal",
    ]


def test_invalid_poses_count_for_their_residual_only() -> None:
    """A frame so wrong that no pose is valid must raise the alarm."""
    assert events([pose(n, 80.0, reason="residual") for n in range(100)])
    assert not events([pose(n, 80.0, reason="tilt") for n in range(100)])
    assert not events([NO_POSE] * 100)


def live(parameters: Parameters, measurements: Iterable[Measurement]) -> list[PoseRecord]:
    """Return the poses that the master would have published."""
    pipeline = dataclasses.replace(parameters.pipeline, estimator="linear")
    feed = LiveEstimator(dataclasses.replace(parameters, pipeline=pipeline))
    return [r for m in measurements for r in feed.measurement(m) if isinstance(r, PoseRecord)]


def driven(seed: int, *, rate_hz: float, duration_s: float) -> tuple[Parameters, list[Measurement]]:
    """Return measurements of the reference scenario at a rate."""
    plain = ScenarioConfig()
    stations = tuple(s.model_copy(update={"rate_hz": rate_hz}) for s in plain.stations)
    scenario = plain.model_copy(update={"stations": stations})
    generator = np.random.default_rng(seed)
    prisms = np.array([prism.position_m for prism in scenario.prisms])
    world = World(scenario.motion, prisms, duration_s, generator)
    return scenario_parameters(scenario), [
        *simulated_measurements(scenario, world, generator, start_ns=START)
    ]


def displaced(parameters: Parameters, station: int, by_m: tuple[float, float]) -> Parameters:
    """Move a station in plan without telling the master: its frame in force is off by as much."""

    def moved(T: Matrix4) -> Matrix4:
        x, y, z, last = T
        return ((*x[:3], x[3] + by_m[0]), (*y[:3], y[3] + by_m[1]), z, last)

    return dataclasses.replace(
        parameters,
        stations=tuple(
            dataclasses.replace(s, T_station1_station=moved(s.T_station1_station))
            if s.station == station
            else s
            for s in parameters.stations
        ),
    )


@pytest.mark.parametrize("rate_hz", [2.5, 1.4])
@pytest.mark.slow
def test_no_false_alarm_on_the_reference_scenario(rate_hz: float) -> None:
    """Five minutes at the instruments' rate and at what the paper's protocol leaves of it."""
    assert not events(live(*driven(1, rate_hz=rate_hz, duration_s=300.0)))


@pytest.mark.parametrize("segment", [".", "segment2"])
@pytest.mark.slow
def test_no_false_alarm_on_the_published_drives(field_data: Path, segment: str) -> None:
    """Both drives of 14 March 2022, with the prism layout of the authors."""
    folder = field_data / "20220314"
    tracks = read_tracks([folder / segment / f"trimble{k}.csv" for k in (1, 2, 3)])
    stations = tuple(StationParameters(station=k, prism=k) for k in (1, 2, 3))
    parameters = Parameters(stations=stations, prisms=read_prisms(folder / "sensor_positions.csv"))
    poses = live(parameters, point_measurements(tracks))
    assert sum(pose.valid for pose in poses) > 1000
    assert not events(poses)


@pytest.mark.parametrize(("station", "bearing_deg"), [(1, 0), (1, 120), (2, 90), (2, 0), (3, 200)])
@pytest.mark.slow
def test_tripod_moved_by_20_mm_raises_the_alarm(station: int, bearing_deg: int) -> None:
    """Within four minutes, in the reference scenario, for every station and direction."""
    parameters, measurements = driven(1, rate_hz=1.5, duration_s=240.0)
    bearing = np.radians(bearing_deg)
    off = displaced(parameters, station, (0.02 * float(np.cos(bearing)), 0.02 * float(np.sin(bearing))))
    assert [e.event for e in events(live(off, measurements))][:1] == ["layout_residual_high"]
