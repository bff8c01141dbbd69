"""Errors against the truth."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tsgt.analysis.evaluation import interior_mask, pose_errors
from tsgt.geometry import transform_from

POINT = np.array([0.0, 0.1, 1.2])


def test_no_error_for_the_truth_itself() -> None:
    """A pose that is the truth has no error."""
    rotations = Rotation.random(20, random_state=1).as_matrix()
    true = transform_from(rotations, np.random.default_rng(1).normal(size=(20, 3)))
    errors = pose_errors(true, true, POINT)
    np.testing.assert_allclose(errors.position_m, 0.0, atol=1e-12)
    np.testing.assert_allclose(errors.rotation_rad, 0.0, atol=1e-7)


def test_position_error_is_that_of_the_point() -> None:
    """A rotation about the chosen point moves the robot's origin, but is no position error."""
    turn = Rotation.from_euler("y", 10, degrees=True).as_matrix()
    true = np.eye(4)[None]
    estimated = transform_from(turn, POINT - turn @ POINT)[None]
    errors = pose_errors(estimated, true, POINT)
    assert errors.position_m[0] == pytest.approx(0.0, abs=1e-15)
    assert math.degrees(errors.rotation_rad[0]) == pytest.approx(10.0)


def test_figures_are_root_mean_squares() -> None:
    """Errors of 3 and 4 mm make sqrt(12.5) mm; the unit is millimetres."""
    true = np.tile(np.eye(4), (2, 1, 1))
    estimated = true.copy()
    estimated[0, 0, 3], estimated[1, 2, 3] = 0.003, -0.004
    errors = pose_errors(estimated, true, POINT)
    assert errors.position_rms_mm == pytest.approx(math.sqrt(12.5))


def test_no_poses_have_no_figure() -> None:
    """Without a pose the figures are not a number, rather than perfect."""
    errors = pose_errors(np.empty((0, 4, 4)), np.empty((0, 4, 4)), POINT)
    assert math.isnan(errors.position_rms_mm)
    assert math.isnan(errors.orientation_rms_deg)


def test_two_seconds_at_each_end_do_not_count() -> None:
    """Figures start 2 s after the start and end 2 s before the end, both included."""
    second = 1_000_000_000
    stamps = np.array([1.9, 2.0, 5.0, 8.0, 8.1]) * second
    inner = interior_mask(100 * second + stamps.astype(np.int64), 100 * second, 110 * second)
    assert inner.tolist() == [False, True, True, True, False]
