from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tsgt.analysis.evaluation import interior_mask, pose_errors
from tsgt.analysis.evaluation.metrics import aligned_statistics
from tsgt.errors import DegenerateGeometryError
from tsgt.geometry import transform_from

POINT_M = np.array([0.1, 0.2, 1.0])


def path(count: int = 50) -> np.ndarray:
    """Return poses along a climbing curve."""
    t = np.linspace(0.0, 3.0, count)
    turns = Rotation.from_euler("ZYX", np.stack([t, 0.1 * np.sin(t), 0.05 * t], axis=1)).as_matrix()
    return transform_from(turns, np.stack([10 * np.cos(t), 10 * np.sin(t), 0.3 * t**2], axis=1))


def test_rigid_alignment_hides_a_rigid_error() -> None:
    """A frame error of 2 degrees and 50 mm at the mean position is removed, and reported as hidden."""
    true = path()
    middle = true[:, :3, 3].mean(axis=0)
    turn = Rotation.from_rotvec(np.radians(2.0) * np.array([0.0, 0.6, 0.8])).as_matrix()
    shift = np.array([0.03, 0.0, 0.04])
    off = transform_from(turn, middle + shift - turn @ middle)
    found = aligned_statistics(off @ true, true, POINT_M, "rigid")
    assert found.translation_mm == pytest.approx(50.0, abs=1e-6)
    assert found.rotation_deg == pytest.approx(2.0, abs=1e-6)
    assert found.position_rms_mm == pytest.approx(0.0, abs=1e-6)
    assert found.orientation_rms_deg == pytest.approx(0.0, abs=1e-5)
    assert found.centroid.position_rms_mm == pytest.approx(0.0, abs=1e-6)
    assert found.hidden_position_mm > 50.0
    assert found.hidden_orientation_deg == pytest.approx(2.0, abs=1e-5)


def test_translation_alignment_keeps_rotations() -> None:
    """Only the common translation is removed; the other errors remain, to the third side of a right triangle."""
    true = path()
    found = true.copy()
    found[:, :3, 3] += (0.003, 0.0, 0.0)
    found[::2, 2, 3] += 0.004
    found[1::2, 2, 3] -= 0.004
    figures = aligned_statistics(found, true, POINT_M, "translation")
    assert figures.translation_mm == pytest.approx(3.0, abs=1e-9)
    assert figures.rotation_deg == 0.0
    assert figures.position_rms_mm == pytest.approx(4.0, abs=1e-9)
    assert figures.hidden_position_mm == pytest.approx(1.0, abs=1e-9)
    assert figures.hidden_orientation_deg == pytest.approx(0.0, abs=1e-9)


def test_straight_path_does_not_determine_the_rotation() -> None:
    """Any rotation about the path fits equally well."""
    straight = transform_from(
        np.broadcast_to(np.eye(3), (9, 3, 3)), np.arange(9.0)[:, None] * (1.0, 0.0, 0.0)
    )
    with pytest.raises(DegenerateGeometryError):
        aligned_statistics(straight, straight, POINT_M, "rigid")
    assert aligned_statistics(straight, straight, POINT_M, "translation").translation_mm == 0.0


def test_alignment_without_poses_is_nan() -> None:
    """Nothing was compared."""
    nothing = aligned_statistics(np.empty((0, 4, 4)), np.empty((0, 4, 4)), POINT_M, "rigid")
    assert math.isnan(nothing.translation_mm)


PRISM_POINT_M = np.array([0.0, 0.1, 1.2])


def test_truth_has_no_error() -> None:
    """A pose that is the truth has no error."""
    rotations = Rotation.random(20, random_state=1).as_matrix()
    true = transform_from(rotations, np.random.default_rng(1).normal(size=(20, 3)))
    errors = pose_errors(true, true, PRISM_POINT_M)
    np.testing.assert_allclose(errors.position_m, 0.0, atol=1e-12)
    np.testing.assert_allclose(errors.rotation_rad, 0.0, atol=1e-7)


def test_position_errors_are_those_of_their_points() -> None:
    """A rotation about the centroid moves the robot's origin, by its lever arm, but not the centroid."""
    turn = Rotation.from_euler("y", 10, degrees=True).as_matrix()
    true = np.eye(4)[None]
    estimated = transform_from(turn, PRISM_POINT_M - turn @ PRISM_POINT_M)[None]
    errors = pose_errors(estimated, true, PRISM_POINT_M)
    assert errors.centroid_m[0] == pytest.approx(0.0, abs=1e-15)
    assert errors.position_m[0] == pytest.approx(2 * np.sin(np.radians(5)) * 1.2)
    assert math.degrees(errors.rotation_rad[0]) == pytest.approx(10.0)


def test_errors_are_root_mean_squares() -> None:
    """Errors of 3 and 4 mm make sqrt(12.5) mm; the unit is millimetres."""
    true = np.tile(np.eye(4), (2, 1, 1))
    estimated = true.copy()
    estimated[0, 0, 3], estimated[1, 2, 3] = 0.003, -0.004
    errors = pose_errors(estimated, true, PRISM_POINT_M)
    assert errors.position_rms_mm == pytest.approx(math.sqrt(12.5))


def test_no_poses_give_nan() -> None:
    """Rather than zero."""
    errors = pose_errors(np.empty((0, 4, 4)), np.empty((0, 4, 4)), PRISM_POINT_M)
    assert math.isnan(errors.position_rms_mm)
    assert math.isnan(errors.orientation_rms_deg)


def test_two_seconds_at_each_end_are_excluded() -> None:
    """The limits themselves are included."""
    second = 1_000_000_000
    stamps = np.array([1.9, 2.0, 5.0, 8.0, 8.1]) * second
    inner = interior_mask(100 * second + stamps.astype(np.int64), 100 * second, 110 * second)
    assert inner.tolist() == [False, True, True, True, False]
