from __future__ import annotations

import numpy as np
import pytest
from harness.drives.scene import SECOND, START, Scene, driving, stationary_scene

from tsgt.analysis.evaluation import BINS, binned, distances_at_epochs, gridded, inter_prism
from tsgt.analysis.report.motion import distance_error_series
from tsgt.estimation import Track, build_tracks


def tracks_of(scene: Scene, *, duration_s: float = 8.0) -> dict[int, Track]:
    """Return tracks of exact measurements at 2.5 Hz, each station with its own phase."""
    return build_tracks(
        scene.parameters,
        [
            scene.measure(station, 0.4 * step + 0.11 * station)
            for step in range(int(duration_s / 0.4))
            for station in (1, 2, 3)
        ],
    )


def test_stationary_robot_has_no_errors_and_one_interval() -> None:
    """Exact measurements give the distances of the layout at each epoch."""
    scene = stationary_scene()
    tracks = tracks_of(scene)
    found = distance_error_series(scene.parameters, distances_at_epochs(scene.parameters, tracks), None)
    assert list(found.error_m) == ["1-2", "1-3", "2-3"]
    for error_m in found.error_m.values():
        np.testing.assert_allclose(error_m, 0.0, atol=1e-9)
    assert len(inter_prism(scene.parameters, tracks).stationary_ns) == 1
    assert np.isnan(found.motion.speed_mps).all()


def test_interpolation_causes_errors_in_curves() -> None:
    """A moving robot has no stationary interval."""
    scene = stationary_scene().moving(driving)
    tracks = tracks_of(scene)
    found = distance_error_series(scene.parameters, distances_at_epochs(scene.parameters, tracks), None)
    assert max(np.abs(error_m).max() for error_m in found.error_m.values()) > 1e-4
    assert inter_prism(scene.parameters, tracks).stationary_ns == ()


def test_static_distances_are_from_the_given_intervals() -> None:
    """Stationary intervals from another source; measurements outside do not count."""
    scene = stationary_scene()
    found = inter_prism(scene.parameters, tracks_of(scene), [(START + SECOND, START + 3 * SECOND)])
    assert found.stationary_s == 2.0
    assert [pair.name for pair in found.static] == ["1-2", "1-3", "2-3"]
    for pair in found.static:
        assert len(pair.distances_m) == 5
        np.testing.assert_allclose(pair.distances_m, pair.reference_m, atol=1e-9)


def test_given_intervals_are_clipped_to_the_recording() -> None:
    """Odometry may cover more time than the measurements; of another day nothing remains."""
    scene = stationary_scene()
    tracks = tracks_of(scene)
    hour = 3600 * SECOND
    last_s = 0.4 * 19 + 0.33
    found = inter_prism(scene.parameters, tracks, [(START - hour, START + hour)])
    assert found.stationary_s == pytest.approx(last_s - 0.11)
    other_day = inter_prism(scene.parameters, tracks, [(START - 2 * hour, START - hour)])
    assert other_day.stationary_ns == ()
    assert all(not len(pair.distances_m) for pair in other_day.static)


def test_binned_errors() -> None:
    """Each bin has the statistics of its own errors; with too few errors they are NaN."""
    quantity = np.repeat(np.linspace(0.05, 0.75, BINS), 100)
    error_m = np.where(np.arange(len(quantity)) % 2, 1.0, -1.0) * quantity
    error_m[:90] = np.nan
    found = binned(error_m[None], quantity)
    assert found is not None
    assert found.counts.tolist() == [10, *[100] * (BINS - 1)]
    assert np.isnan(found.median[0])
    np.testing.assert_allclose(found.median[1:], np.linspace(0.05, 0.75, BINS)[1:])
    np.testing.assert_allclose(found.p95[1:], found.mean[1:])


def test_signed_quantity_has_symmetric_bins() -> None:
    """Braking differs from accelerating."""
    quantity = np.linspace(-2.0, 1.0, 500)
    found = binned(np.ones((1, 500)), quantity)
    assert found is not None
    assert found.edges[0] == -found.edges[-1] < 0.0


@pytest.mark.parametrize("quantity", [np.full(100, np.nan), np.zeros(100), np.ones(5)])
def test_unknown_or_constant_quantity_has_no_bins(quantity: np.ndarray) -> None:
    """In one dimension or in two."""
    errors = np.ones((1, len(quantity)))
    assert binned(errors, quantity) is None
    assert gridded(errors, quantity, quantity) is None


def test_grid_contains_the_mean_of_each_cell() -> None:
    """Rows are the second quantity, columns the first."""
    x, y = np.repeat([0.1, 0.9], 200), np.tile([0.1, 0.9], 200)
    found = gridded((x + 10 * y)[None], x, y)
    assert found is not None
    assert found.counts.sum() == 400
    assert found.mean[0, -1] == pytest.approx(0.9 + 1.0)
    assert found.mean[-1, 0] == pytest.approx(0.1 + 9.0)
    assert np.isnan(found.mean[0, 1])
