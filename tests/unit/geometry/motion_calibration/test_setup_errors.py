"""The vector of set-up errors: its Jacobian, its correction, and what a drive says about it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.prior_motion import draw_motions, measure, sorted_by_time

from tsgt.geometry.motion_calibration.setup_errors import (
    FRAME,
    STATION_COMPONENTS,
    SetupErrors,
    drift_phase,
    linearise_setup,
)
from tsgt.geometry.trajectory import initial_guess, knot_times, linearise, nearest_knots
from tsgt.model import MotionPrior, SetupCovariance

if TYPE_CHECKING:
    from tsgt.geometry.trajectory import Observations

LAYOUT = SetupErrors((1, 2, 3), (1, 2, 3))


@pytest.fixture(scope="module")
def observations() -> Observations:
    """Half a minute of a random drive."""
    motion = draw_motions(MotionPrior(), count=1, duration_s=31.0, seed=5)[0]
    return sorted_by_time(measure(motion, until_s=30.0, seed=5))


def test_jacobian_is_that_of_the_correction(observations: Observations) -> None:
    """Correcting a small error changes the residuals as the Jacobian says, for every component of a station and a prism."""
    knots = initial_guess(observations, knot_times(observations.time_s))
    index = nearest_knots(knots.time_s, observations.time_s)
    linearised = linearise(observations, knots, index)
    jacobian = LAYOUT.jacobian(observations, linearised, drift_phase(observations.time_s))
    for row in (*LAYOUT.of_station(2, *STATION_COMPONENTS), *LAYOUT.of_prism(1)):
        errors = np.zeros(len(LAYOUT))
        errors[row] = 1e-6
        changed = LAYOUT.corrected(observations, errors)
        if np.any(changed.prism != observations.prism):
            pytest.fail("a microsecond changed the order of the measurements")
        moved = linearise(changed, knots, index).residuals_m
        numerical = (moved - linearised.residuals_m) / 1e-6
        expected = jacobian[:, :, row]
        assert numerical == pytest.approx(expected, rel=1e-3, abs=2e-3 * np.abs(expected).max())


def test_information_contains_the_planted_error(observations: Observations) -> None:
    """With nothing else wrong, the information's minimum along one component is at what was planted."""
    for name, size in (("rotation_z", 2e-4), ("vertical_index", 2e-4), ("latency", 0.01)):
        at = LAYOUT.of_station(2, name)[0]
        planted = np.zeros(len(LAYOUT))
        planted[at] = -size  # a correction by less than nothing makes the error
        wrong = LAYOUT.corrected(observations, planted)
        found = linearise_setup(LAYOUT, wrong, np.zeros(len(LAYOUT)), MotionPrior(), np.ones((3, 3)))
        information = found.information
        estimate = information.vector[at] / information.matrix[at, at]
        sigma = information.matrix[at, at] ** -0.5
        assert estimate == pytest.approx(size, abs=5 * sigma)
        assert sigma < size / 3


def test_known_covariance_replaces_the_nominal_one() -> None:
    """Components of a set-up's covariance are used as they are; the others keep the data sheets' sigmas."""
    known = SetupCovariance(
        components=("station2.x", "station2.rotation_z", "prism3.y"),
        matrix=((4e-6, 1e-9, 0.0), (1e-9, 1e-10, 0.0), (0.0, 0.0, 9e-6)),
    )
    covariance = LAYOUT.nominal_covariance(known)
    x, turn = LAYOUT.of_station(2, "x", "rotation_z")
    assert covariance[x, x] == 4e-6
    assert covariance[x, turn] == covariance[turn, x] == 1e-9
    assert covariance[LAYOUT.of_prism(3)[1], LAYOUT.of_prism(3)[1]] == 9e-6
    first = LAYOUT.of_station(1, *FRAME)
    assert not covariance[np.ix_(first, first)].any()  # it defines the frame
    others = LAYOUT.of_station(3, *STATION_COMPONENTS)
    assert (np.diag(covariance)[others] > 0).all()
