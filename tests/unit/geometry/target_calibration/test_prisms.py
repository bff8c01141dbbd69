"""Frames from points in two of them: optimum, covariance, outliers, weak axes, prisms."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tsgt.errors import DegenerateGeometryError, GeometryError
from tsgt.geometry import (
    cartesian_to_polar,
    exp_so3,
    invert,
    log_so3,
    measurement_covariance,
    transform_from,
    transform_points,
)
from tsgt.geometry.target_calibration import (
    PointPairs,
    PointSet,
    calibrate_prisms,
    fit_frame,
)
from tsgt.geometry.target_calibration.prisms import calibrate_body
from tsgt.model import ARCSECOND_RAD, InstrumentNoise

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

T_1_2 = transform_from(exp_so3(np.array([0.0, 0.0, 0.7])), np.array([2.0, -1.5, 0.1]))
AROUND = np.array(
    [[18, 3, 0.4], [6, -21, -0.6], [-15, 9, 1.1], [-10, -16, 0.2], [30, 25, 2.0], [-4, 40, 1.0]], dtype=float
)
# Much larger along the line of sight than across it, so that weights matter.
NOISE = InstrumentNoise(
    range_sigma_m=0.001, range_sigma_ppm=1.0, angle_sigma_rad=ARCSECOND_RAD, pointing_sigma_m=0.0005
)
IN_LINE = np.outer([8.0, 18.0, 29.0, 46.0], [0.8, -0.6, 0.01]) - [0.0, 0.0, 1.5]
FREE_OF = {True: [0, 1, 2, 5], False: [0, 1, 2, 3, 4, 5]}


@dataclass
class Field:
    """Two stations that measure points; station 2 is at ``T``."""

    points_m: FloatArray
    T: FloatArray
    rng: np.random.Generator

    def measure(self, bad: dict[int, float] | None = None) -> tuple[PointSet, PointSet]:
        """Points of station 2 and of station 1; ``bad`` adds to distances of station 2, by number from 1."""
        seen = transform_points(invert(self.T), self.points_m)
        return self._noisy(seen, bad or {}), self._noisy(self.points_m, {})

    def _noisy(self, points_m: FloatArray, bad: dict[int, float]) -> PointSet:
        covariances = measurement_covariance(*cartesian_to_polar(points_m), NOISE)
        noise = np.linalg.cholesky(covariances) @ self.rng.standard_normal((len(points_m), 3, 1))
        measured = points_m + noise[:, :, 0]
        for number, extra_m in bad.items():
            measured[number - 1] *= 1 + extra_m / np.linalg.norm(measured[number - 1])
        return PointSet(tuple(range(1, len(points_m) + 1)), measured, covariances)


def field(points_m: FloatArray = AROUND, T: FloatArray = T_1_2, seed: int = 1) -> Field:
    """Make a field with its own random numbers."""
    return Field(points_m, T, np.random.default_rng(seed))


def error_of(T: FloatArray, truth: FloatArray) -> FloatArray:
    """Error in the sense of the covariance: T_true = [exp(dtheta) R|t + dt]."""
    return np.concatenate([truth[:3, 3] - T[:3, 3], log_so3(truth[:3, :3] @ T[:3, :3].T)])


@pytest.mark.parametrize(("weighted", "levelled"), list(product([True, False], repeat=2)))
def test_frame_is_the_least_squares_optimum(*, weighted: bool, levelled: bool) -> None:
    """A general optimiser finds no better frame."""
    source, target = field().measure()
    fit = fit_frame(PointPairs(source, target, levelled), weighted=weighted)
    noise = T_1_2[:3, :3] @ source.covariances_m2 @ T_1_2[:3, :3].T + target.covariances_m2
    whitening = np.linalg.cholesky(np.linalg.inv(noise)) if weighted else np.tile(1e3 * np.eye(3), (6, 1, 1))

    def frame(x: FloatArray) -> FloatArray:
        rotation = Rotation.from_rotvec([0, 0, x[3]] if levelled else x[3:]).as_matrix()
        return transform_from(np.asarray(rotation), x[:3])

    def misses(x: FloatArray) -> FloatArray:
        residuals = target.points_m - transform_points(frame(x), source.points_m)
        return np.ravel(residuals[:, None, :] @ whitening)

    start = np.array([0.0, 0.0, 0.0, 0.5]) if levelled else np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5])
    oracle = least_squares(misses, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    np.testing.assert_allclose(
        transform_from(fit.rotation, fit.translation_m), frame(np.asarray(oracle.x)), atol=2e-6
    )


@pytest.mark.parametrize(("weighted", "levelled"), list(product([True, False], repeat=2)))
def test_nees_is_consistent(*, weighted: bool, levelled: bool) -> None:
    """Over many simulated campaigns mean NEES equals the degrees of freedom."""
    simulated, free, nees = field(), FREE_OF[levelled], []
    for _ in range(400):
        fit = fit_frame(PointPairs(*simulated.measure(), levelled), weighted=weighted)
        error = error_of(transform_from(fit.rotation, fit.translation_m), T_1_2)[free]
        nees.append(error @ np.linalg.solve(fit.covariance[np.ix_(free, free)], error) / len(free))
    # Three sigma of a mean of 400 chi squared variables over their degrees of freedom.
    assert np.mean(nees) == pytest.approx(1.0, abs=3 * np.sqrt(2 / len(free) / 400))


def test_weights_reduce_errors() -> None:
    """With the noise model's weights position errors are smaller on average."""
    simulated = field()
    errors: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(200):
        pairs = PointPairs(*simulated.measure(), levelled=False)
        for weighted in (True, False):
            fit = fit_frame(pairs, weighted=weighted)
            errors[weighted].append(float(np.sum((fit.translation_m - T_1_2[:3, 3]) ** 2)))
    assert np.mean(errors[True]) < 0.9 * np.mean(errors[False])


def test_leave_one_out_equals_calibration_without_the_point() -> None:
    """Each leave-one-out figure is the prediction error of a calibration without that point."""
    source, target = field().measure()
    solved = calibrate_body(source, target)
    others = [1, 2, 4, 5, 6]
    without = calibrate_body(source.select(others), target.select(others))
    miss = target.points_m[2] - transform_points(without.T, source.points_m[2])
    assert solved.leave_one_out_m[2] == pytest.approx(np.linalg.norm(miss))


@pytest.mark.slow
def test_good_points_are_not_rejected() -> None:
    """In a hundred clean campaigns no point is rejected and none is inconsistent."""
    simulated = field()
    solved = [calibrate_body(*simulated.measure()) for _ in range(100)]
    assert all(frame.consistent and not frame.rejected for frame in solved)


@pytest.mark.parametrize("number", range(1, 7))
@pytest.mark.parametrize("extra_m", [0.05, -0.05])
def test_single_outlier_is_rejected(number: int, extra_m: float) -> None:
    """A distance that is 50 mm wrong is rejected, and the frame is that of the other points."""
    solved = calibrate_body(*field().measure({number: extra_m}))
    assert [point.name for point in solved.rejected] == [number]
    assert solved.rejected[0].prediction_error_m == pytest.approx(0.05, abs=0.006)
    assert number not in solved.used
    assert solved.rms_m < 0.003
    assert solved.consistent


def test_two_outliers_are_rejected() -> None:
    """Two outliers of eight are found one after the other."""
    points = np.vstack([AROUND, [[22, -12, 0.5], [-25, -3, 0.8]]])
    solved = calibrate_body(*field(points).measure({1: 0.05, 4: -0.08}))
    assert {point.name for point in solved.rejected} == {1, 4}


def test_outlier_of_four_points_is_inconsistent() -> None:
    """With four points the outlier cannot be identified: nothing is rejected, the set is inconsistent."""
    solved = calibrate_body(*field(AROUND[:4]).measure({2: 0.05}))
    assert solved.rejected == ()
    assert not solved.consistent


def test_three_inconsistent_points_are_detected() -> None:
    """Three points determine a frame, but their distances are still checked."""
    assert calibrate_body(*field(AROUND[:3]).measure()).consistent
    assert not calibrate_body(*field(AROUND[:3]).measure({2: 0.1})).consistent


def test_too_many_outliers_are_inconsistent() -> None:
    """Where half of the points are outliers nothing is rejected."""
    solved = calibrate_body(*field().measure({1: 0.05, 3: -0.08, 5: 0.3}))
    assert solved.rejected == ()
    assert not solved.consistent


def test_error_below_the_blunder_limit_is_kept() -> None:
    """A point 2 mm off is kept at any stated noise, one 5 mm off is rejected."""
    covariances = np.tile(1e-8 * np.eye(3), (len(AROUND), 1, 1))
    target = PointSet((1, 2, 3, 4, 5, 6), AROUND, covariances)
    for off_m, names in ((0.002, []), (0.005, [3])):
        off = np.outer([0, 0, 1, 0, 0, 0], [0, 0, off_m])
        solved = calibrate_body(PointSet(target.names, AROUND + off, covariances), target)
        assert [point.name for point in solved.rejected] == names


def test_points_all_around_are_not_weak() -> None:
    """A good set of points has no weak axis."""
    assert calibrate_body(*field().measure()).weak == ()


@pytest.mark.parametrize("aside_m", [0.0, 0.01, 0.1])
def test_nearly_collinear_points_are_weak_about_their_line(aside_m: float) -> None:
    """The weak axis is the line through the points, towards them; its sigma is about noise over offset."""
    points = IN_LINE + np.outer([0, aside_m, 0, 0], [0.6, 0.8, 0.0])
    solved = calibrate_body(*field(points).measure())
    (weak,) = solved.weak
    line = points[3] - points[0]
    assert weak.axis @ line / np.linalg.norm(line) > np.cos(np.radians(1.5))
    assert weak.sigma_rad > 0.005
    if aside_m >= 0.01:
        assert 0.3e-3 < weak.sigma_rad * aside_m < 3e-3


def test_unpredictable_point_is_not_suspected() -> None:
    """Of four points, the one off a line of three cannot be predicted."""
    points = IN_LINE + np.outer([0, 2.0, 0, 0], [0.6, 0.8, 0.0])
    solved = [calibrate_body(*field(points, seed=seed).measure()) for seed in range(20)]
    assert all(frame.consistent for frame in solved)
    assert all(np.isnan(frame.leave_one_out_m[1]) for frame in solved)


def test_fewer_than_three_common_points_are_rejected() -> None:
    """The error says how many there are and which."""
    source, target = field().measure()
    with pytest.raises(DegenerateGeometryError, match=r"at least 3 .* got 2 \(1, 4\)"):
        calibrate_body(source.select([1, 4, 5]), target.select([1, 2, 4]))


def exact(points_m: FloatArray) -> tuple[PointSet, PointSet]:
    """Points without noise in two equal frames."""
    covariances = np.tile(1e-6 * np.eye(3), (len(points_m), 1, 1))
    points = PointSet(tuple(range(len(points_m))), points_m, covariances)
    return points, points


def test_collinear_points_are_rejected() -> None:
    """The rotation about the line is undetermined."""
    with pytest.raises(DegenerateGeometryError, match="in a line"):
        calibrate_body(*exact(IN_LINE))


def test_vertically_aligned_points_are_rejected_when_levelled() -> None:
    """The heading is undetermined."""
    pairs = PointPairs(*exact(np.array([[5.0, 5.0, 0.0], [5.0, 5.0, 1.0], [5.0, 5.0, 3.0]])), levelled=True)
    with pytest.raises(DegenerateGeometryError, match="horizontal spread"):
        fit_frame(pairs, weighted=True)


@pytest.mark.parametrize(
    ("names", "points_m", "covariances_m2", "message"),
    [
        ((1, 1, 2), np.zeros((3, 3)), np.zeros((3, 3, 3)), "different names"),
        ((1, 2, 3), np.zeros((3, 2)), np.zeros((3, 3, 3)), "expected points"),
        ((1, 2, 3), np.full((3, 3), np.nan), np.zeros((3, 3, 3)), "NaN"),
    ],
)
def test_malformed_point_sets_are_rejected(
    names: tuple[int, ...], points_m: FloatArray, covariances_m2: FloatArray, message: str
) -> None:
    """Repeated names, wrong shapes and NaN raise an error."""
    with pytest.raises(GeometryError, match=message):
        PointSet(names, points_m, covariances_m2)


def test_points_without_noise_are_rejected() -> None:
    """A singular covariance cannot be a weight."""
    points, _ = exact(AROUND)
    noiseless = PointSet(points.names, points.points_m, np.zeros((6, 3, 3)))
    with pytest.raises(GeometryError, match="singular"):
        calibrate_body(noiseless, points)


BODY = np.array([[0.6, 0.3, 0.4], [0.6, -0.3, 0.4], [-0.5, 0.3, 0.4], [-0.2, 0.0, 1.0], [-0.5, -0.3, 0.5]])
PRISMS = np.array([[-0.46, -0.18, 1.12], [0.48, -0.18, 1.42], [-0.03, 0.35, 1.07]])
T_STATION_ROBOT = transform_from(exp_so3(np.array([0.01, -0.02, 2.4])), np.array([6.2, -3.1, -1.4]))


def measured_robot(rng: np.random.Generator, bad_m: float = 0.0) -> tuple[PointSet, PointSet, PointSet]:
    """Body points as measured (the second one off by ``bad_m``), the same from CAD, and the prisms as measured."""
    cad_noise = np.tile(1e-6 * np.eye(3), (len(BODY), 1, 1))
    sets = []
    for points in (BODY + 1e-3 * rng.standard_normal(BODY.shape), PRISMS):
        seen = transform_points(T_STATION_ROBOT, points)
        covariances = measurement_covariance(*cartesian_to_polar(seen), NOISE)
        noise = (np.linalg.cholesky(covariances) @ rng.standard_normal((len(points), 3, 1)))[:, :, 0]
        sets.append(PointSet(tuple(range(len(points))), seen + noise, covariances))
    sets[0].points_m[1] *= 1 + bad_m / np.linalg.norm(sets[0].points_m[1])
    return sets[0], PointSet(sets[0].names, BODY, cad_noise), sets[1]


@pytest.mark.slow
def test_prism_nees_is_consistent() -> None:
    """The normalised squared errors of the prisms average their three degrees of freedom."""
    rng = np.random.default_rng(1)
    nees = []
    for _ in range(60):
        prisms = calibrate_prisms(*measured_robot(rng)).prisms
        error = (prisms.points_m - PRISMS)[:, :, None]
        nees.append(np.sum(error * np.linalg.solve(prisms.covariances_m2, error)) / 9)
    assert np.mean(nees) == pytest.approx(1.0, abs=0.25)


def test_wrong_body_point_is_rejected() -> None:
    """A body point 20 mm off is rejected and the prisms are unaffected."""
    solved = calibrate_prisms(*measured_robot(np.random.default_rng(1), bad_m=0.02))
    assert [point.name for point in solved.body.rejected] == [1]
    np.testing.assert_allclose(solved.prisms.points_m, PRISMS, atol=0.006)
