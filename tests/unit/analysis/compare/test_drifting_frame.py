import numpy as np
import pytest
from harness.drives.compared_drive import START_NS, reference, robot

from tsgt.analysis.compare import Estimate
from tsgt.analysis.compare.alignment.drifting_frame import (
    NAMES,
    Linearised,
    Rows,
    Unknowns,
    linearise,
    rows_of,
    start_states,
)
from tsgt.analysis.compare.interpolation import ReferenceTrajectory
from tsgt.geometry import FloatArray, exp_so3, quaternion_from_rotation

STEP = 1e-4


def system() -> tuple[ReferenceTrajectory, Rows, Unknowns]:
    """Return a fit of five seconds whose residuals are zero, with lever arm, scale, skew and a turned sensor."""
    trajectory = ReferenceTrajectory(reference(8.0, 0.02))
    time_s = np.arange(1.0, 6.0, 0.1)
    T = robot(time_s)
    R = exp_so3(np.array([0.3, -0.2, 1.0]))
    arm_m = np.array([0.4, 0.2, 0.7])
    estimate = Estimate(
        "exact",
        START_NS + np.rint(time_s * 1e9).astype(np.int64),
        (T[:, :3, 3] + T[:, :3, :3] @ arm_m) / 2.0,
        quaternion_from_rotation(T[:, :3, :3] @ R),
        None,
    )
    rows = rows_of(estimate, np.ones(len(time_s), dtype=np.bool_), 0.04)
    begun = Unknowns(0.0, 0.0, 2.0, arm_m, R, np.zeros((0, 3, 3)), np.zeros((0, 3)))
    return trajectory, rows, start_states(trajectory, rows, begun, np.eye(3))


def stacked(linear: Linearised) -> FloatArray:
    """Return all residuals."""
    return np.concatenate([linear.pose.ravel(), linear.walk.ravel()])


def slope(
    trajectory: ReferenceTrajectory, rows: Rows, at: Unknowns, border: FloatArray, state: FloatArray
) -> FloatArray:
    """Return the central difference of all residuals along a direction."""
    after, before = (
        stacked(linearise(trajectory, rows, at.moved(sign * STEP * border, sign * STEP * state)))
        for sign in (1, -1)
    )
    return np.asarray((after - before) / (2 * STEP))


@pytest.mark.parametrize("name", NAMES)
def test_derivative_by_an_unknown_is_the_central_difference(name: str) -> None:
    """Of poses and of steps of drift, at the true values."""
    trajectory, rows, at = system()
    linear = linearise(trajectory, rows, at)
    index = NAMES.index(name)
    expected = slope(trajectory, rows, at, np.eye(len(NAMES))[index], np.zeros((len(rows.knot), 6)))
    found = np.concatenate(
        [linear.pose_by_border[..., index].ravel(), linear.walk_by_border[..., index].ravel()]
    )
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_derivative_by_the_drifting_frame_is_the_central_difference() -> None:
    """All knots move at once, each in a direction of its own."""
    trajectory, rows, at = system()
    linear = linearise(trajectory, rows, at)
    direction = np.random.default_rng(5).normal(size=(len(rows.knot), 6))
    expected = slope(trajectory, rows, at, np.zeros(len(NAMES)), direction)
    pairs = np.concatenate([direction[:-1], direction[1:]], axis=1)
    pose = np.einsum("nij,nj->ni", linear.pose_by_state, pairs[rows.interval])
    walk = np.einsum("kij,kj->ki", linear.walk_by_state, pairs)
    np.testing.assert_allclose(np.concatenate([pose.ravel(), walk.ravel()]), expected, atol=2e-5)
