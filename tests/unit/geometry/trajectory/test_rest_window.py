"""Rest online: smoothed states of a robot that stands still, and what stays as it is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.prior_motion import CENTRE_M
from harness.drives.slow_motion import LINE_OF_SIGHT, creeping, measure_along

from tsgt.geometry.trajectory import FixedLagSmoother, LinearisedMeasurements, Observations
from tsgt.geometry.trajectory.rest_window import HISTORY_S
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.geometry import FloatArray
    from tsgt.geometry.trajectory import SetupJacobian

LAG_S = 3.0
DELAY_S = 1.0


def start_at(speed_mps: float, at_s: float) -> Callable[[FloatArray], FloatArray]:
    """Displacement of a robot that stands until it starts."""
    return lambda time_s: speed_mps * np.maximum(time_s - at_s, 0.0)


def followed(
    observations: Observations, *, setup: SetupJacobian | None = None
) -> tuple[FixedLagSmoother, list[tuple[float, float, float]]]:
    """Return a smoother after all measurements; time and along-track position with and without rest, a delay behind each."""
    window = FixedLagSmoother(MotionPrior(), setup)
    found = []
    for row in range(len(observations)):
        window.update(observations.select(slice(row, row + 1)))
        time_s = float(observations.time_s[row]) - DELAY_S
        if window.converged and time_s > 5.0:
            states = [
                each.at(np.array([time_s]))[0] for each in (window.smoothed_trajectory(), window.trajectory())
            ]
            rest, plain = ((each.position[0] - CENTRE_M)[:2] @ LINE_OF_SIGHT for each in states)
            found.append((time_s, float(rest), float(plain)))
        window.marginalise_before(float(observations.time_s[row]) - LAG_S)
    return window, found


def sigma_m(window: FixedLagSmoother, at_s: float, *, rest: bool) -> float:
    """One sigma of the position along the line of sight."""
    trajectory = window.smoothed_trajectory() if rest else window.trajectory()
    covariance = trajectory.at(np.array([at_s]), dim=6)[1][0]
    return float(np.sqrt(LINE_OF_SIGHT @ covariance[:2, :2] @ LINE_OF_SIGHT))


@pytest.mark.slow
def test_measurements_of_a_stop_determine_one_pose() -> None:
    """Errors and stated sigmas fall to less than half."""
    window, found = followed(measure_along(creeping(0.0), until_s=11.0, seed=1))
    rest, plain = (np.sqrt(np.mean(np.square(each))) for each in np.array(found).T[1:])
    assert rest < 0.5 * plain
    assert sigma_m(window, 9.5, rest=True) < 0.5 * sigma_m(window, 9.5, rest=False)


@pytest.mark.parametrize("speed_mps", [0.02, 0.1, 0.5])
def test_robot_that_drives_off_is_followed(speed_mps: float) -> None:
    """Rest ends with the first measurements that contradict it."""
    along_m = start_at(speed_mps, 7.0)
    _, found = followed(measure_along(along_m, until_s=11.0, seed=2))
    time_s, rest_m, plain_m = np.array(found).T
    moving = time_s > 7.0
    true_m = along_m(time_s)
    assert moving.sum() > 15
    assert np.abs(rest_m - true_m)[moving].max() < np.abs(plain_m - true_m)[moving].max() + 0.001


def test_moving_robot_has_no_rest() -> None:
    """Nothing is changed, to the last bit."""
    window, found = followed(measure_along(creeping(0.05), until_s=9.0, seed=3))
    assert found
    assert all(rest == plain for _, rest, plain in found)
    assert window.smoothed_trajectory() is window.trajectory()


def test_predictions_keep_the_motion_prior() -> None:
    """A robot at rest may drive off: asking for smoothed states changes no prediction, to the last bit."""
    observations = measure_along(creeping(0.0), until_s=9.0, seed=4)
    window, _ = followed(observations)
    unasked = FixedLagSmoother(MotionPrior())
    for row in range(len(observations)):
        unasked.update(observations.select(slice(row, row + 1)))
        unasked.marginalise_before(float(observations.time_s[row]) - LAG_S)
    assert window.smoothed_trajectory() is not window.trajectory()
    at_s = float(observations.time_s[-1]) + 0.4
    (state, covariance), (expected, expected_covariance) = window.predict(at_s), unasked.predict(at_s)
    np.testing.assert_array_equal(state.position, expected.position)
    np.testing.assert_array_equal(covariance, expected_covariance)


@pytest.mark.slow
def test_stop_is_known_from_measurements_before_the_window() -> None:
    """A second of it in the window suffices; the history has an end."""
    observations = measure_along(start_at(0.5, 12.0), until_s=14.0, seed=5)
    window, _ = followed(observations)
    assert window.horizon_s < 11.2
    assert sigma_m(window, 11.3, rest=True) < 0.7 * sigma_m(window, 11.3, rest=False)
    newest = window._rest._newest
    assert newest is not None
    assert newest.time_s[-1] - newest.time_s[0] <= HISTORY_S


def test_setup_displaces_a_stop_as_it_displaces_the_measurements() -> None:
    """An error of all ranges of 1 mm, which rest does not average away, stays in the common covariance."""

    def ranges(observations: Observations, _: LinearisedMeasurements) -> FloatArray:
        by_setup = np.zeros((len(observations), 3, 1))
        by_setup[:, 0, 0] = 0.001
        return by_setup

    window, _ = followed(measure_along(creeping(0.0), until_s=12.0, seed=6), setup=ranges)
    assert window.smoothed_trajectory() is not window.trajectory()
    for trajectory in (window.smoothed_trajectory(), window.trajectory()):
        common = trajectory.common_at(np.array([10.5]), dim=6)
        assert common is not None
        sigma = np.sqrt(LINE_OF_SIGHT @ common[0, :2, :2] @ LINE_OF_SIGHT)
        assert sigma == pytest.approx(0.001, rel=0.05)
