from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from harness.drives.scene import LAYOUT, SECOND, START, Scene, at_rest, driving, stationary_scene

from tsgt.analysis.evaluation import InterPrismDistances, inter_prism
from tsgt.analysis.evaluation.inter_prism import stationary_intervals
from tsgt.estimation import Track, build_tracks
from tsgt.geometry import exp_so3
from tsgt.geometry.rest import MARGIN_S

REFERENCES_MM = [987.0, 681.0, 815.0]


def track(times_s: list[float], x_m: list[float]) -> Track:
    """Return a track along the x axis."""
    n = len(times_s)
    points = np.column_stack([x_m, np.zeros(n), np.zeros(n)])
    times_ns = np.array([START + round(time_s * SECOND) for time_s in times_s])
    nothing = np.zeros(n, dtype=np.int64)
    return Track(times_ns, points, np.zeros((n, 3, 3)), nothing, nothing)


def stop_and_go(time_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a robot that is stationary for 10 s, moves along x at 1 m/s for 10 s, and is stationary for 10 s."""
    return exp_so3(np.zeros(3)), np.array([30.0 + np.clip(time_s - 10.0, 0.0, 10.0), 20.0, 0.0])


def found_in(scene: Scene, *, duration_s: float, without: tuple[int, ...] = ()) -> InterPrismDistances:
    """Measure at 2.5 Hz with phases, without some steps of station 2, and compute the inter-prism distances."""
    measurements = [
        scene.measure(station, 0.4 * step + 0.11 * station)
        for step in range(int(duration_s / 0.4))
        for station in (1, 2, 3)
        if station != 2 or step not in without
    ]
    return inter_prism(scene.parameters, build_tracks(scene.parameters, measurements))


def test_stationary_robot_has_the_distances_of_its_layout() -> None:
    """Exact measurements give exact distances, interpolated and raw."""
    found = found_in(stationary_scene(), duration_s=8.0)
    for pairs in (found.dynamic, found.static):
        assert [pair.name for pair in pairs] == ["1-2", "1-3", "2-3"]
        for pair, reference in zip(pairs, REFERENCES_MM, strict=True):
            figures = pair.statistics()
            assert figures.reference == pytest.approx(reference, abs=0.1)
            assert figures.mean == pytest.approx(figures.reference, abs=1e-6)
            assert figures.p95 == pytest.approx(0.0, abs=1e-6)
    assert found.stationary_s == pytest.approx(7.6 + 0.33 - 0.11 - 2 * MARGIN_S)


def test_gap_is_counted_as_invalid() -> None:
    """Epochs without all three tracks enter no mean."""
    # Station 2 measures at 0.22 + 0.4 step: without steps 5 to 7 there is a gap from 1.82 to 3.42 s.
    found = found_in(stationary_scene(), duration_s=8.0, without=(5, 6, 7))
    assert found.invalid_epochs == len(range(1850, 3420, 50))
    assert all(pair.invalid == found.invalid_epochs for pair in found.dynamic)
    assert all(len(pair.distances_m) == found.epochs - found.invalid_epochs for pair in found.dynamic)


def test_epochs_span_the_time_of_all_tracks() -> None:
    """From the first whole 50 ms that all tracks have reached to the last before one of them ends."""
    found = found_in(stationary_scene(), duration_s=8.0)
    assert found.epochs == len(range(350, 7600 + 110 + 1, 50))  # the last station starts at 0.33 s


def test_statistics_equal_plain_numpy() -> None:
    """Mean and deviation of the distance, mean and 95th percentile of its error."""
    pair = found_in(stationary_scene().moving(driving), duration_s=8.0).dynamic[1]
    figures = pair.statistics()
    mm = pair.distances_m * 1e3
    error = np.sort(np.abs(mm - figures.reference))
    assert figures.mean == pytest.approx(np.sum(mm) / len(mm))
    assert figures.std == pytest.approx(np.sqrt(np.sum((mm - np.sum(mm) / len(mm)) ** 2) / len(mm)))
    assert figures.mean_abs_error == pytest.approx(np.sum(error) / len(mm))
    assert error[int(0.94 * len(mm))] <= figures.p95 <= error[int(0.96 * len(mm))]


def test_no_distances_give_nan() -> None:
    """A robot that is never stationary has no static distances."""
    found = found_in(stationary_scene().moving(stop_and_go), duration_s=40.0)
    assert len(found.static[0].distances_m) > 0
    moving = found_in(stationary_scene().moving(lambda t: stop_and_go(t % 5 + 11)), duration_s=4.0)
    assert moving.stationary_s == 0.0
    figures = moving.static[0].statistics()
    assert np.isnan([figures.mean, figures.std, figures.mean_abs_error, figures.p95]).all()
    assert figures.valid == 0


def test_static_pairs_are_from_stationary_intervals_only() -> None:
    """Prisms measured at different instants while moving would distort the distance."""
    found = found_in(stationary_scene().moving(stop_and_go), duration_s=30.0)
    assert 17.5 < found.stationary_s < 20.0
    for pair in found.static:
        np.testing.assert_allclose(pair.distances_m, pair.reference_m, atol=1e-9)


def test_creeping_robot_is_not_stationary() -> None:
    """At 5 mm/s it is not; the short window of a stop is too short to tell."""
    times = [0.4 * step for step in range(40)]
    assert stationary_intervals([track(times, [0.005 * t for t in times])]) == []
    x = [max(0.0, 2.0 - t) - max(0.0, t - 3.5) for t in times]
    assert stationary_intervals([track(times, x)]) == []


def test_station_out_does_not_hide_a_stop() -> None:
    """A prism that is not measured for 18 s says nothing; the others stand still."""
    times = [0.4 * step for step in range(60)]
    seen = [t for t in times if not 3.0 < t < 21.0]
    tracks = [track(times, [0.0] * 60), track(seen, [1.0] * len(seen)), track(times, [2.0] * 60)]
    ((start, end),) = stationary_intervals(tracks)
    assert start < START + SECOND
    assert end > START + 22 * SECOND


def test_outage_is_not_stationary() -> None:
    """The motion during an outage is unknown."""
    times = [0.4 * step for step in range(11)] + [9.0 + 0.4 * step for step in range(11)]
    intervals = stationary_intervals([track(times, [5.0] * 22)])
    margin_ns = round(MARGIN_S * SECOND)
    expected = [(START, START + 4 * SECOND), (START + 9 * SECOND, START + 13 * SECOND)]
    assert intervals == [(start + margin_ns, end - margin_ns) for start, end in expected]


def test_noise_of_a_fast_instrument_is_not_motion() -> None:
    """At 20 Hz a few millimetres of noise look fast from one position to the next."""
    rng = np.random.default_rng(1)
    times = [0.05 * step for step in range(200)]
    x = rng.normal(0.0, 0.002, 200).tolist()
    assert max(abs(b - a) for a, b in pairwise(x)) / 0.05 > 0.05
    ((start, end),) = stationary_intervals([track(times, x)])
    assert end - start > 9.0 * SECOND


def test_all_tracks_must_be_stationary() -> None:
    """One moving prism is motion of the robot."""
    times = [0.4 * step for step in range(20)]
    stationary_track = track(times, [0.0] * 20)
    assert stationary_intervals([stationary_track, track(times, [0.5 * t for t in times])]) == []


def test_reference_is_the_layout() -> None:
    """The reference distances are those of the prism layout in the parameters."""
    found = found_in(stationary_scene().moving(at_rest), duration_s=4.0)
    for pair in found.dynamic:
        a, b = pair.prisms
        assert pair.reference_m == pytest.approx(float(np.linalg.norm(LAYOUT[a - 1] - LAYOUT[b - 1])))
