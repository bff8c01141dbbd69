from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.prior_motion import as_cartesian, draw_motions, measure, sorted_by_time

from tsgt.analysis.evaluation import outliers, residual_statistics
from tsgt.geometry.batch import fit_trajectory
from tsgt.model import MotionPrior, PolarMeasurement

if TYPE_CHECKING:
    from tsgt.geometry.batch import TrajectoryFit
    from tsgt.geometry.trajectory import Observations

PRIOR = MotionPrior()


@pytest.fixture(scope="module")
def observations() -> Observations:
    """Measure a robot that moves according to the prior for a minute, with the stated noise."""
    (motion,) = draw_motions(PRIOR, count=1, duration_s=61.0, seed=4)
    return sorted_by_time(measure(motion, until_s=60.0, seed=5))


def fitted(observations: Observations) -> TrajectoryFit:
    """Fit with the true hyperparameters."""
    return fit_trajectory(observations, prior=PRIOR, noise_scale=1.0)


def sources(observations: Observations) -> list[PolarMeasurement]:
    """Return a measurement for each observation, with one station per prism."""
    return [
        PolarMeasurement(
            station=10 + prism,
            prism=prism + 1,
            sequence=row,
            stamp_ns=row,
            received_ns=row,
            horizontal_angle_rad=0.0,
            zenith_angle_rad=1.5,
            slope_distance_m=10.0,
            host_time_ns=row,
        )
        for row, prism in enumerate(observations.prism.tolist())
    ]


def test_normalised_residuals_are_standard_normal(observations: Observations) -> None:
    """With correct prior and noise the mean is 0 and the standard deviation 1."""
    found = residual_statistics(fitted(observations), sources(observations))
    assert list(found) == [10, 11, 12]
    for axes in found.values():
        assert list(axes) == ["range", "horizontal_angle", "zenith_angle"]
        for figures in axes.values():
            assert figures.n == pytest.approx(150, abs=3)
            assert figures.mean == pytest.approx(0.0, abs=0.3)
            assert figures.std == pytest.approx(1.0, abs=0.2)
            assert figures.beyond_3_sigma < 0.03


def test_noisy_axis_is_detected(observations: Observations) -> None:
    """Ranges of one station with four times the stated noise have a standard deviation of about four."""
    along = np.random.default_rng(6).normal(size=len(observations)) * 0.01
    worse = np.where(observations.prism == 1, along, 0.0)[:, None]
    distance_m = np.linalg.norm(observations.points_m, axis=1)[:, None]
    spoilt = replace(observations, points_m=observations.points_m * (1 + worse / distance_m))
    found = residual_statistics(fitted(spoilt), sources(spoilt))
    assert found[11]["range"].std > 2.3
    assert found[11]["horizontal_angle"].std < 1.5
    assert found[10]["range"].std < 1.7


def test_cartesian_points_have_their_own_axes(observations: Observations) -> None:
    """Their line of sight is unknown."""
    found = residual_statistics(fitted(as_cartesian(observations)), sources(observations))
    assert list(found[10]) == ["x", "y", "z"]


def test_outliers_are_reported(observations: Observations) -> None:
    """A measurement with an error of half a metre is found with its size; good measurements are not."""
    assert len(outliers(fitted(observations), sources(observations))) <= 2
    points = observations.points_m.copy()
    points[200] += (0.3, 0.0, 0.4)
    rejected = outliers(fitted(replace(observations, points_m=points)), sources(observations))
    worst = rejected[0]
    assert (worst.stamp_ns, worst.prism) == (200, int(observations.prism[200]) + 1)
    assert worst.station == worst.prism + 9
    assert worst.missed_mm == pytest.approx(500.0, abs=15.0)
    assert worst.sigmas > 100
    assert all(outlier.sigmas < 6 for outlier in rejected[1:])
