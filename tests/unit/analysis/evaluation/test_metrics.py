from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tsgt.analysis.evaluation.metrics import aligned_statistics
from tsgt.errors import DegenerateGeometryError
from tsgt.geometry import transform_from, transform_points

POINT_M = np.array([0.1, 0.2, 1.0])


def way(count: int = 50) -> np.ndarray:
    """Poses along a bend that climbs."""
    t = np.linspace(0.0, 3.0, count)
    turns = Rotation.from_euler("ZYX", np.stack([t, 0.1 * np.sin(t), 0.05 * t], axis=1)).as_matrix()
    return transform_from(turns, np.stack([10 * np.cos(t), 10 * np.sin(t), 0.3 * t**2], axis=1))


def test_a_rigid_error_is_hidden_altogether() -> None:
    """A frame that is off by 2 degrees and 50 mm in the middle of the way: that is removed, and told."""
    true = way()
    middle = transform_points(true, POINT_M).mean(axis=0)
    turn = Rotation.from_rotvec(np.radians(2.0) * np.array([0.0, 0.6, 0.8])).as_matrix()
    shift = np.array([0.03, 0.0, 0.04])
    off = transform_from(turn, middle + shift - turn @ middle)
    found = aligned_statistics(off @ true, true, POINT_M, "rigid")
    assert found.translation_mm == pytest.approx(50.0, abs=1e-6)
    assert found.rotation_deg == pytest.approx(2.0, abs=1e-6)
    assert found.position_rms_mm == pytest.approx(0.0, abs=1e-6)
    assert found.orientation_rms_deg == pytest.approx(0.0, abs=1e-5)
    assert found.hidden_position_mm > 50.0
    assert found.hidden_orientation_deg == pytest.approx(2.0, abs=1e-5)


def test_a_shift_leaves_rotations_alone() -> None:
    """Only what all positions have in common goes; errors about it stay, to the third side of a right triangle."""
    true = way()
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


def test_a_straight_way_does_not_say_how_to_turn() -> None:
    """About the way itself any rotation fits as well."""
    straight = transform_from(
        np.broadcast_to(np.eye(3), (9, 3, 3)), np.arange(9.0)[:, None] * (1.0, 0.0, 0.0)
    )
    with pytest.raises(DegenerateGeometryError):
        aligned_statistics(straight, straight, POINT_M, "rigid")
    assert aligned_statistics(straight, straight, POINT_M, "translation").translation_mm == 0.0


def test_without_poses_there_are_no_figures() -> None:
    """Nothing was compared, so nothing is told."""
    nothing = aligned_statistics(np.empty((0, 4, 4)), np.empty((0, 4, 4)), POINT_M, "rigid")
    assert math.isnan(nothing.translation_mm)
