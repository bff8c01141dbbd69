"""Batch fit of a recording: segments, outliers, tuning."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.prior_motion import draw_motions, measure, sorted_by_time

from tsgt.errors import GeometryError
from tsgt.geometry.batch import fit as fitting
from tsgt.geometry.batch import fit_trajectory
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from tsgt.geometry.trajectory import Observations

PRIOR = MotionPrior()


@pytest.fixture(scope="module")
def observations() -> Observations:
    """Eighty seconds of a robot, some 600 measurements."""
    motion = draw_motions(PRIOR, count=1, duration_s=81.0, seed=21)[0]
    return sorted_by_time(measure(motion, until_s=80.0, seed=22))


def test_segments_agree_with_one_solution(
    observations: Observations, monkeypatch: pytest.MonkeyPatch
) -> None:
    """States to a hundredth of a millimetre, covariances to a thousandth of theirs."""
    whole = fit_trajectory(observations, prior=PRIOR, noise_scale=1.0)
    monkeypatch.setattr("tsgt.geometry.batch.fit.KNOTS_PER_SEGMENT", 150)
    monkeypatch.setattr("tsgt.geometry.batch.fit.OVERLAP_KNOTS", 80)
    pieces = fit_trajectory(observations, prior=PRIOR, noise_scale=1.0)
    error = pieces.trajectory.knots.local_coordinates_about(whole.trajectory.knots)
    assert np.abs(error[:, :6]).max() < 1e-5
    sigma = np.sqrt(np.diagonal(whole.trajectory.covariance, axis1=1, axis2=2))
    scale = sigma[:, :, None] * sigma[:, None, :]
    assert (np.abs(pieces.trajectory.covariance - whole.trajectory.covariance) / scale).max() < 1e-3
    cross_covariance = (
        np.abs(pieces.trajectory.cross_covariance - whole.trajectory.cross_covariance) / scale[:-1]
    ).max()
    assert cross_covariance < 1e-2
    np.testing.assert_allclose(pieces.residuals_m, whole.residuals_m, atol=1e-5)


def test_outliers_have_small_weights(observations: Observations) -> None:
    """Exactly the measurements that are half a metre off get small weights."""
    points = observations.points_m.copy()
    spoilt = np.array([50, 200, 201, 420])
    points[spoilt] += 0.5
    found = fit_trajectory(replace(observations, points_m=points), prior=PRIOR, noise_scale=1.0)
    assert set(spoilt) <= set(np.flatnonzero(found.weights < 1.0))
    assert np.all(found.weights[spoilt] < 0.01)
    assert np.count_nonzero(found.weights < 0.5) == len(spoilt)


def test_blunders_at_the_end_are_rejected_as_by_a_close_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three of the last four measurements are 0.15 to 0.35 m off, where little contradicts them."""
    motion = draw_motions(PRIOR, count=1, duration_s=41.0, seed=21)[0]
    measured = sorted_by_time(measure(motion, until_s=40.0, seed=22))
    points = measured.points_m.copy()
    points[-4:-2] += [[0.12, -0.1, 0.05], [-0.1, 0.12, 0.05]]
    points[-1] += 0.2
    spoilt = replace(measured, points_m=points)
    found = fit_trajectory(spoilt, prior=PRIOR, noise_scale=1.0).trajectory
    monkeypatch.setattr(fitting, "INITIAL_GAIN_PER_KNOT", 0.0)
    monkeypatch.setattr(fitting, "FINAL_GAIN_PER_KNOT", 0.0)
    close = fit_trajectory(spoilt, prior=PRIOR, noise_scale=1.0).trajectory
    sigma = np.sqrt(np.diagonal(close.covariance, axis1=1, axis2=2))
    error = found.knots.local_coordinates_about(close.knots) / sigma
    assert np.abs(error[:, :6]).max() < 0.05


@pytest.mark.slow
def test_prism_missing_for_a_minute(observations: Observations) -> None:
    """Without one prism the covariance is larger."""
    late = observations.select((observations.prism != 1) | (observations.time_s > 60.0))
    found = fit_trajectory(late, prior=PRIOR, noise_scale=1.0)
    _, covariance = found.trajectory.at(np.array([30.0, 70.0]))
    assert np.trace(covariance[0, 3:6, 3:6]) > 2 * np.trace(covariance[1, 3:6, 3:6])


def test_progress_goes_from_zero_to_one(observations: Observations, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shares rise to 1."""
    monkeypatch.setattr("tsgt.geometry.batch.fit.KNOTS_PER_SEGMENT", 50)
    shares: list[float] = []
    fit_trajectory(observations, prior=PRIOR, noise_scale=1.0, on_progress=shares.append)
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0.0, 1.0)
    assert len(shares) > 3


def test_noise_scale_is_tuned(observations: Observations) -> None:
    """The noise scale is recovered."""
    found = fit_trajectory(replace(observations, sigmas_m=observations.sigmas_m / 3))
    assert found.noise_scales[:3].ravel() == pytest.approx(np.full(9, 3.0), rel=0.3)
    assert found.squared_distances.mean() < 3.0


def test_no_trajectory_without_three_prisms(observations: Observations) -> None:
    """The error says how many prisms were measured."""
    with pytest.raises(GeometryError, match="3 prisms, 2 have been measured"):
        fit_trajectory(observations.select(observations.prism < 2), prior=PRIOR, noise_scale=1.0)


def test_segments_cover_all_knots_once() -> None:
    """For any number of knots."""
    for count in (1, 2, 4096, 4097, 100_000):
        kept = [piece.kept for piece in fitting._segments(count)]
        assert (kept[0].start, kept[-1].stop) == (0, count)
        assert all(a.stop == b.start for a, b in pairwise(kept))
