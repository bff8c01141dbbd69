"""Movement of a station: simulated movements, an independent optimiser, the stated false-alarm probability."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tsgt.analysis.calibration import StationCheck, check_repeats, check_station, same_face_points
from tsgt.analysis.formats import TargetMeasurement
from tsgt.geometry import (
    cartesian_to_polar,
    exp_so3,
    invert,
    measurement_covariance,
    transform_from,
    transform_points,
)
from tsgt.geometry.target_calibration import PointSet
from tsgt.model import TARGET_NOISE

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

TARGETS_M = np.array(
    [[18, 3, 0.4], [6, -21, -0.6], [-15, 9, 1.1], [-10, -16, 0.2], [30, 25, 2.0]], dtype=float
)
UNMOVED = np.eye(4)


def seen(points_m: FloatArray, T: FloatArray, rng: np.random.Generator | None) -> PointSet:
    """Measure targets from a station's frame; without a generator exactly."""
    points = transform_points(invert(T), points_m)
    covariances = measurement_covariance(*cartesian_to_polar(points), TARGET_NOISE)
    if rng is not None:
        noise = np.linalg.cholesky(covariances) @ rng.standard_normal((len(points), 3, 1))
        points = points + noise[:, :, 0]
    return PointSet(tuple(range(1, len(points) + 1)), points, covariances)


def checked(
    T: FloatArray,
    count: int,
    seed: int | None = None,
    *,
    limit_m: float = 0.0,
    points_m: FloatArray = TARGETS_M,
) -> StationCheck:
    """Measure targets before and after a movement."""
    rng = None if seed is None else np.random.default_rng(seed)
    return check_station(
        seen(points_m[:count], UNMOVED, rng), seen(points_m[:count], T, rng), limit_m=limit_m
    )


def moved(x: float = 0.0, y: float = 0.0, z: float = 0.0, *turns: float) -> FloatArray:
    """Return a movement of a station in m and rad, in its previous frame."""
    return transform_from(exp_so3(np.array(turns or (0.0, 0.0, 0.0))), np.array([x, y, z]))


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_stationary_station_passes(count: int) -> None:
    """In 300 simulations each: with a false-alarm probability of 1e-4, no alarm."""
    results = [checked(UNMOVED, count, seed) for seed in range(300)]
    assert all(result.ok and result.consistent for result in results)


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_movement_of_20_mm_is_detected(count: int) -> None:
    """Always, and its length within four sigma."""
    for seed in range(100):
        result = checked(moved(0.012, -0.016), count, seed)
        assert not result.ok
        assert result.consistent
        assert result.moved_m == pytest.approx(0.02, abs=4 * result.moved_sigma_m)


@pytest.mark.parametrize(("count", "levelled"), [(2, True), (5, False)])
def test_rotation_is_detected_without_translation(count: int, *, levelled: bool) -> None:
    """0.5 mrad about the plumb line shifts targets 20 m away by 10 mm; the station itself has not moved."""
    result = checked(moved(0, 0, 0, 0, 0, 0.5e-3), count)
    assert (result.ok, result.levelled) == (False, levelled)
    assert result.turned_rad == pytest.approx(0.5e-3, rel=1e-6)
    assert result.moved_m == pytest.approx(0.0, abs=1e-9)
    assert result.shifts_m[2] == pytest.approx(0.5e-3 * np.hypot(6, 21), rel=1e-3)


def test_one_target_gives_its_shift_only() -> None:
    """It cannot separate rotation and translation."""
    result = checked(moved(0, 0, 0, 0, 0, 1e-3), 1)
    assert result.turned_rad is None
    assert result.moved_m == pytest.approx(result.shifts_m[1])
    assert result.moved_m == pytest.approx(1e-3 * np.hypot(18, 3), rel=1e-3)


def test_two_close_targets_determine_no_rotation() -> None:
    """Ten centimetres apart they determine the heading to some ten milliradians only."""
    points = np.array([[20.0, 0.0, 0.0], [20.0, 0.1, 0.0]])
    assert checked(moved(0.02), 2, points_m=points).turned_rad is None


@pytest.mark.parametrize("count", [2, 4])
def test_agrees_with_an_independent_optimiser(count: int) -> None:
    """Translation and rotation, from a general least-squares solver with its own rotation parameters."""
    T = moved(0.03, 0.01, -0.005, *((0, 0, 2e-3) if count == 2 else (1e-3, -0.5e-3, 2e-3)))
    rng = np.random.default_rng(5)
    reference, current = seen(TARGETS_M[:count], UNMOVED, rng), seen(TARGETS_M[:count], T, rng)
    whitening = np.linalg.cholesky(np.linalg.inv(reference.covariances_m2 + current.covariances_m2))

    def residuals(x: FloatArray) -> FloatArray:
        rotation = Rotation.from_rotvec([0, 0, x[3]] if count == 2 else x[3:]).as_matrix()
        residuals = reference.points_m - current.points_m @ np.asarray(rotation).T - x[:3]
        return np.ravel(residuals[:, None, :] @ whitening)

    oracle = least_squares(residuals, np.zeros(4 if count == 2 else 6), xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    result = check_station(reference, current)
    assert result.moved_m == pytest.approx(float(np.linalg.norm(oracle[:3])), abs=1e-5)
    assert result.turned_rad == pytest.approx(float(np.linalg.norm(oracle[3:])), abs=1e-6)


def test_limit_accepts_shifts_beyond_noise() -> None:
    """Up to the largest shift of a target."""
    assert not checked(moved(0.015), 3).ok
    assert not checked(moved(0.015), 3, limit_m=0.014).ok
    assert checked(moved(0.015), 3, limit_m=0.016).ok


def test_moved_target_is_inconsistent() -> None:
    """No single movement explains the shifts."""
    reference, current = seen(TARGETS_M, UNMOVED, None), seen(TARGETS_M, UNMOVED, None)
    current.points_m[3] += [0.0, 0.0, 0.05]
    result = check_station(reference, current)
    assert (result.ok, result.consistent) == (False, False)


def test_only_current_targets_count() -> None:
    """Reference targets that were not measured again are ignored."""
    result = check_station(seen(TARGETS_M, UNMOVED, None), seen(TARGETS_M, moved(0.02), None).select((2, 5)))
    assert set(result.shifts_m) == {2, 5}
    assert result.moved_m == pytest.approx(0.02, abs=1e-6)


def sights(
    points_m: FloatArray, face: int, error_rad: float, rng: np.random.Generator
) -> dict[int, list[TargetMeasurement]]:
    """Measure targets in a face, with an index error and a collimation of ``error_rad``."""
    result = {}
    for target, point in enumerate(points_m, start=1):
        noise = np.linalg.cholesky(measurement_covariance(*cartesian_to_polar(point), TARGET_NOISE))
        h, z, d = map(float, cartesian_to_polar(point + noise @ rng.standard_normal(3)))
        sign = 1.0 if face == 1 else -1.0
        h -= sign * error_rad / np.sin(z)
        result[target] = [
            TargetMeasurement(
                horizontal_angle_rad=(h + (0.0 if face == 1 else np.pi)) % (2 * np.pi),
                zenith_angle_rad=(z if face == 1 else 2 * np.pi - z) + error_rad,
                slope_distance_m=d,
                line=1,
            )
        ]
    return result


@pytest.mark.parametrize("face", [1, 2])
def test_targets_in_two_faces_are_compared_in_the_same_face(face: int) -> None:
    """Index error and collimation of 0.3 mrad, 30 mm at 100 m, are no movement of the station, and no bad repeat."""
    far_m = 100.0 * TARGETS_M / np.linalg.norm(TARGETS_M, axis=1)[:, None]
    for seed in range(100):
        rng = np.random.default_rng(seed)
        faces = [sights(far_m, each, 3e-4, rng) for each in (1, 2)]
        before = {target: [*faces[0][target], *faces[1][target]] for target in faces[0]}
        check_repeats(Path("f"), before, 0.0, "{}")
        points = same_face_points(Path("f"), before, sights(far_m, face, 3e-4, rng), 0.0, "{}")
        result = check_station(*points)
        assert (result.ok, result.consistent) == (True, True)
