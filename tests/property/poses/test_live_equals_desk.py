"""Streamed, replayed and post-processed poses are equal bit for bit."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import hypothesis.strategies as st
import pytest
from harness.drives.scene import START, driving, stationary_scene
from harness.files.records import CLOCK, EVENT, HEADER, STATUS
from hypothesis import given, settings

from tsgt.config import GeofenceConfig
from tsgt.estimation import LinearEstimator, LiveEstimator
from tsgt.master.monitors.geofence import Geofence
from tsgt.master.publisher import Publisher
from tsgt.master.replay import replayed
from tsgt.master.station_events import StationEventDetector
from tsgt.master.statistics import Statistics
from tsgt.model import Status
from tsgt.recording import SetupRecord, encode_line

if TYPE_CHECKING:
    from collections.abc import Callable

    from harness.drives.scene import Scene

    from tsgt.model import Measurement, PolarMeasurement
    from tsgt.recording import ClockRecord, EventRecord, PoseRecord, StatusRecord

TRANSPORT_NS = 2_000_000_000
SCENE = stationary_scene().moving(driving)
CONTINUOUS = SCENE.with_limits(estimator="continuous", smoothed_delays_ns=(400_000_000, 1_000_000_000))

# A fourth station helps the first on its prism.
FOUR = replace(
    SCENE,
    parameters=replace(
        SCENE.parameters,
        stations=(*SCENE.parameters.stations, replace(SCENE.parameters.stations[1], station=4, prism=1)),
    ),
)

# Steps between a station's measurements: its rate with jitter, now and then a gap beyond the outage limit.
steps = st.lists(
    st.tuples(
        st.one_of(st.floats(0.02, 0.6), st.floats(0.02, 4.0)),
        st.floats(0.0, TRANSPORT_NS / 1e9 - 0.001),
        st.sampled_from([Status.OK, Status.OK, Status.OK, Status.LOW_ACCURACY, Status.NO_TARGET]),
    ),
    max_size=25,
)


@st.composite
def arrivals(draw: st.DrawFn, scene: Scene = SCENE) -> list[PolarMeasurement]:
    """Measurements of all stations in order of arrival; each station's arrive in order and in time."""
    everything = []
    for station in range(1, len(scene.parameters.stations) + 1):
        time_s, arrival_s = draw(st.floats(0.0, 1.0)), 0.0
        for step_s, delay_s, status in draw(steps):
            # Whole microseconds: their sums round to exact nanoseconds, so that order is kept.
            time_s = round(time_s + step_s, 6)
            arrival_s = max(arrival_s, round(time_s + delay_s, 6))
            everything.append(scene.measure(station, time_s, delay_s=arrival_s - time_s, status=status))
    return sorted(everything, key=lambda m: m.received_ns)


def live(
    measurements: list[PolarMeasurement], ticks_ns: list[int], end_ns: int, scene: Scene = SCENE
) -> list[bytes]:
    """Return the lines of a live run whose timer also fires at given instants."""
    feed = LiveEstimator(scene.parameters)
    calls = [(m.received_ns, m) for m in measurements] + [(tick, None) for tick in ticks_ns if tick < end_ns]
    records: list[Measurement | PoseRecord] = []
    for now_ns, measurement in sorted(calls, key=lambda call: call[0]):
        records += feed.advance(now_ns) if measurement is None else feed.measurement(measurement)
    return [encode_line(record) for record in (*records, *feed.advance(end_ns))]


def poses(lines: list[bytes]) -> list[bytes]:
    """Only the lines of poses."""
    return [line for line in lines if line.startswith(b'{"type":"pose"')]


@settings(max_examples=60)
@given(arrivals(), st.lists(st.integers(START, START + 100 * 10**9), max_size=30), st.floats(0.0, 5.0))
@pytest.mark.slow
def test_post_processing_equals_the_stream(
    measurements: list[PolarMeasurement], ticks_ns: list[int], wait_s: float
) -> None:
    """Post processing equals the stream."""
    end_ns = max((m.received_ns for m in measurements), default=START) + round(wait_s * 1e9)
    pipeline = LinearEstimator(SCENE.parameters)
    for measurement in sorted(measurements, key=lambda m: m.stamp_ns):
        pipeline.add(measurement)
    desk = [encode_line(pose) for pose in pipeline.advance(end_ns).records()]
    assert desk == poses(live(measurements, ticks_ns, end_ns))


@settings(max_examples=60)
@given(arrivals(FOUR), st.lists(st.integers(START, START + 100 * 10**9), max_size=30))
@pytest.mark.slow
def test_post_processing_equals_the_stream_with_two_stations_on_one_prism(
    measurements: list[PolarMeasurement], ticks_ns: list[int]
) -> None:
    """Both are waited for, so the order of arrival does not matter."""
    end_ns = max((m.received_ns for m in measurements), default=START)
    pipeline = LinearEstimator(FOUR.parameters)
    for measurement in sorted(measurements, key=lambda m: m.stamp_ns):
        pipeline.add(measurement)
    desk = [encode_line(pose) for pose in pipeline.advance(end_ns).records()]
    assert desk == poses(live(measurements, ticks_ns, end_ns, FOUR))


@settings(max_examples=30)
@given(arrivals(), st.lists(st.integers(START, START + 100 * 10**9), max_size=30))
@pytest.mark.slow
def test_timer_does_not_change_the_stream(measurements: list[PolarMeasurement], ticks_ns: list[int]) -> None:
    """Timer does not change the stream."""
    end_ns = max((m.received_ns for m in measurements), default=START)
    assert live(measurements, ticks_ns, end_ns) == live(measurements, [], end_ns)


@settings(max_examples=10)
@given(arrivals(CONTINUOUS), st.lists(st.integers(START, START + 10 * 10**9), max_size=30))
@pytest.mark.slow
def test_timer_does_not_change_predictions(measurements: list[PolarMeasurement], ticks_ns: list[int]) -> None:
    """Timer does not change predictions."""
    end_ns = START + 10 * 10**9
    early = [m for m in measurements if m.received_ns < end_ns]
    assert live(early, ticks_ns, end_ns, CONTINUOUS) == live(early, [], end_ns, CONTINUOUS)


@settings(max_examples=30)
@given(arrivals())
def test_stamps_of_poses_increase_by_one_period(measurements: list[PolarMeasurement]) -> None:
    """Stamps of poses increase by one period."""
    pipeline = LinearEstimator(SCENE.parameters)
    stamps: list[int] = []
    for measurement in measurements:
        pipeline.add(measurement)
        stamps += pipeline.advance(measurement.received_ns).stamp_ns.tolist()
    period = SCENE.parameters.pipeline.period_ns
    assert stamps == list(range(stamps[0], stamps[-1] + 1, period)) if stamps else True


@settings(max_examples=60)
@given(st.one_of(arrivals(), arrivals(FOUR)))
def test_next_pose_is_due_at_the_deadline(measurements: list[PolarMeasurement]) -> None:
    """And not one nanosecond before."""
    pipeline = LinearEstimator(
        FOUR.parameters if any(m.station == 4 for m in measurements) else SCENE.parameters
    )
    for measurement in measurements:
        pipeline.add(measurement)
        pipeline.advance(measurement.received_ns)
    deadline_ns = pipeline.next_deadline_ns()
    if deadline_ns is not None:
        assert len(pipeline.advance(deadline_ns - 1)) == 0
        assert len(pipeline.advance(deadline_ns)) > 0


@settings(max_examples=30)
@given(
    arrivals(),
    st.lists(
        st.tuples(st.integers(START, START + 40 * 10**9), st.sampled_from([CLOCK, EVENT, STATUS])),
        max_size=20,
    ),
    st.lists(st.integers(START, START + 40 * 10**9), max_size=20),
)
@pytest.mark.slow
def test_replay_equals_the_stream(
    measurements: list[PolarMeasurement],
    others: list[tuple[int, ClockRecord | EventRecord | StatusRecord]],
    ticks_ns: list[int],
) -> None:
    """Clock, status and event records and a geofence's events keep their places."""
    _replayed_again(SCENE, measurements, others, ticks_ns)


@settings(max_examples=10)
@given(
    arrivals(CONTINUOUS),
    st.lists(
        st.tuples(st.integers(START, START + 10 * 10**9), st.sampled_from([CLOCK, EVENT, STATUS])),
        max_size=5,
    ),
    st.lists(st.integers(START, START + 10 * 10**9), max_size=20),
)
@pytest.mark.slow
def test_replay_equals_the_stream_with_predictions(
    measurements: list[PolarMeasurement],
    others: list[tuple[int, ClockRecord | EventRecord | StatusRecord]],
    ticks_ns: list[int],
) -> None:
    """Replay equals the stream with predictions."""
    early = [m for m in measurements if m.received_ns < START + 10 * 10**9]
    _replayed_again(CONTINUOUS, early, others, ticks_ns)


def _replayed_again(
    scene: Scene,
    measurements: list[PolarMeasurement],
    others: list[tuple[int, ClockRecord | EventRecord | StatusRecord]],
    ticks_ns: list[int],
) -> None:
    geofence = Geofence(GeofenceConfig(name="yard", polygon_m=((29, 0), (30, 0), (30, 40), (29, 40))))
    lines: list[bytes] = []
    publisher = Publisher(
        scene.parameters,
        Statistics([1, 2, 3]),
        StationEventDetector([1, 2, 3], START),
        [geofence],
        lambda _record, line: lines.append(line),
        lambda: START,
    )
    calls: list[tuple[int, Callable[[], None]]] = [
        *((m.received_ns, partial(publisher.measurement, m)) for m in measurements),
        *((at_ns, partial(publisher.put, replace(record, stamp_ns=at_ns))) for at_ns, record in others),
        *((at_ns, partial(publisher.advance, at_ns)) for at_ns in ticks_ns),
    ]
    publisher.put(SetupRecord.of(scene.parameters, START))
    for _, call in sorted(calls, key=lambda each: each[0]):
        call()
    with TemporaryDirectory() as folder:
        path = Path(folder) / "run.jsonl"
        path.write_bytes(
            b"".join(line + b"\n" for line in (*map(encode_line, (HEADER, scene.parameters)), *lines))
        )
        assert [line for _, some in replayed(path) for line in some] == lines
