"""How a robot moves, found from its measurements: gradient, what comes back of what was put in, what cannot be told."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.prior_motion import draw_motions, measure, sorted_by_time

from tsgt.errors import GeometryError
from tsgt.geometry.trajectory import hyperparameters, scale_noise, tune
from tsgt.geometry.trajectory.hyperparameters import MIN_MEASUREMENTS
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from tsgt.geometry import Observations

PRIOR = MotionPrior(
    acceleration_sigma_mps2=(0.5, 0.5, 0.2),
    acceleration_correlation_time_s=0.8,
    angular_acceleration_sigma_radps2=(0.2, 0.2, 0.4),
    angular_acceleration_correlation_time_s=0.5,
)


@pytest.fixture(scope="module")
def observations() -> Observations:
    """Measure a minute and a half of a robot that moves as :data:`PRIOR` says."""
    motion = draw_motions(PRIOR, count=1, duration_s=91.0, seed=11)[0]
    return sorted_by_time(measure(motion, until_s=90.0, seed=12))


def test_the_gradient_is_that_of_the_evidence(observations: Observations) -> None:
    """Central differences of the evidence are the oracle; the noise's scale is a little off where stamps are uncertain."""
    exact = replace(observations, time_sigma_s=np.zeros(len(observations)))
    segment = hyperparameters._Segment(exact.select(slice(0, 150)))
    at = np.log([0.3, 0.15, 0.5, 0.12, 0.2, 0.4, 1.2])
    hyperparameters._evidence(segment, at)
    _, gradient = hyperparameters._evidence(segment, at)
    step = 1e-3
    for i in range(len(at)):
        aside = step * np.eye(len(at))[i]
        up, down = (hyperparameters._evidence(segment, at + sign * aside)[0] for sign in (1, -1))
        assert gradient[i] == pytest.approx((up - down) / (2 * step), rel=0.05, abs=0.5)


def test_the_motion_that_made_the_measurements_is_found(observations: Observations) -> None:
    """Sizes of accelerations come back to 30 %, the noise to 15 %: a minute and a half does not tell them better."""
    found = tune(scale_noise(observations, 0.5))
    np.testing.assert_allclose(found.prior.acceleration_sigma_mps2, PRIOR.acceleration_sigma_mps2, rtol=0.3)
    np.testing.assert_allclose(
        found.prior.angular_acceleration_sigma_radps2, PRIOR.angular_acceleration_sigma_radps2, rtol=0.3
    )
    assert found.prior.acceleration_correlation_time_s == pytest.approx(
        PRIOR.acceleration_correlation_time_s, rel=0.5
    )
    assert found.prior.angular_acceleration_correlation_time_s == pytest.approx(
        PRIOR.angular_acceleration_correlation_time_s, rel=0.5
    )
    assert found.noise_scale == pytest.approx(2.0, rel=0.15)


def test_where_the_search_begins_matters_little(observations: Observations) -> None:
    """From ten times calmer and from ten times wilder robots the same is found."""
    calm = MotionPrior(acceleration_sigma_mps2=(0.05, 0.05, 0.02), acceleration_correlation_time_s=3.0)
    wild = MotionPrior(acceleration_sigma_mps2=(5.0, 5.0, 2.0), acceleration_correlation_time_s=0.1)
    found = [tune(observations, start=start) for start in (calm, wild)]
    assert found[0].log_evidence == pytest.approx(found[1].log_evidence, abs=2.0)
    np.testing.assert_allclose(
        found[0].prior.acceleration_sigma_mps2, found[1].prior.acceleration_sigma_mps2, rtol=0.1
    )


def test_what_is_given_stays(observations: Observations) -> None:
    """A prior that is fixed is not touched, nor is a noise that is given."""
    few = observations.select(slice(0, 200))
    kept = tune(few, start=PRIOR, noise_only=True)
    np.testing.assert_allclose(kept.prior.acceleration_sigma_mps2, PRIOR.acceleration_sigma_mps2)
    assert kept.prior.acceleration_correlation_time_s == pytest.approx(PRIOR.acceleration_correlation_time_s)
    assert tune(few, noise_scale=1.5).noise_scale == pytest.approx(1.5)


def test_a_wrong_lock_does_not_pass_for_noise(observations: Observations) -> None:
    """One measurement in thirty that is half a metre off, 400 sigmas, does not even double the noise."""
    points = observations.points_m.copy()
    points[::30] += 0.5
    found = tune(replace(observations, points_m=points))
    assert found.noise_scale < 2.0
    np.testing.assert_allclose(found.prior.acceleration_sigma_mps2, PRIOR.acceleration_sigma_mps2, rtol=0.5)


def test_a_robot_that_stands_still_is_no_trouble() -> None:
    """Its accelerations come out small, its noise right."""
    still = MotionPrior(
        acceleration_sigma_mps2=(1e-6, 1e-6, 1e-6), angular_acceleration_sigma_radps2=(1e-6, 1e-6, 1e-6)
    )
    motion = draw_motions(still, count=1, duration_s=41.0, seed=5)[0]
    rest = replace(
        motion,
        position=np.tile(motion.position[:1], (len(motion), 1)),
        rotation=np.tile(motion.rotation[:1], (len(motion), 1, 1)),
        velocity=np.zeros_like(motion.velocity),
        angular_velocity=np.zeros_like(motion.angular_velocity),
    )
    found = tune(sorted_by_time(measure(rest, until_s=40.0, seed=6)))
    assert max(found.prior.acceleration_sigma_mps2) < 0.02
    assert found.noise_scale == pytest.approx(1.0, rel=0.15)


def test_too_little_to_tell(observations: Observations) -> None:
    """Some seconds, or two prisms, tell nothing; the message says what is missing."""
    with pytest.raises(GeometryError, match="too few measurements to tell how the robot moves"):
        tune(observations.select(slice(0, MIN_MEASUREMENTS - 1)))
    with pytest.raises(GeometryError, match="of at least 3 prisms"):
        tune(observations.select(observations.prism < 2))
