"""Station frames from targets: the causes of a misfit are found, and the covariance contains it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from harness.instruments.target_field import TargetField, frame_nees
from scipy.optimize import least_squares

from tsgt.errors import DegenerateGeometryError
from tsgt.geometry import exp_so3, log_so3
from tsgt.geometry.target_calibration import (
    DATA_SHEET_SIGMA,
    CauseKind,
    InstrumentError,
    NetworkCalibration,
    calibrate_network,
    checks,
    station_frames,
    unweighted_frames,
)
from tsgt.model import TARGET_NOISE

INDEX, COLLIMATION, SCALE, CONSTANT = InstrumentError
SIDEWAYS = np.array([0.009, -0.012, 0.0])


def simulated(seed: int = 1, **changes: Any) -> TargetField:
    """Make a field with its own random numbers."""
    return TargetField(rng=np.random.default_rng(seed), **changes)


def calibrated(seed: int = 1, **changes: Any) -> NetworkCalibration:
    """Calibrate a simulated field."""
    return calibrate_network(simulated(seed, **changes).measure(), TARGET_NOISE)


def sights(calibration: NetworkCalibration) -> set[tuple[int, int | None]]:
    """Rows of station and target of the rejected sights."""
    return {(c.station, c.target) for c in calibration.causes if c.kind is CauseKind.SIGHT}


def test_frames_are_the_least_squares_optimum() -> None:
    """A general optimiser with free target positions and data sheets' priors on the instruments finds the same frames."""
    field = simulated(targets=5, stations=2)
    readings = field.measure()
    solved = calibrate_network(readings, TARGET_NOISE)
    sigmas = readings.sigmas_m(TARGET_NOISE)
    sheet = np.array([DATA_SHEET_SIGMA[error] for error in InstrumentError])

    def residuals(x: np.ndarray) -> np.ndarray:
        measured = readings.points_m(sheet * x[6:14].reshape(2, 4))
        rotations = np.stack([np.eye(3), exp_so3(x[3:6]) @ field.rotation[1]])
        translations = np.stack([np.zeros(3), x[:3]])
        points = x[14:].reshape(-1, 3)[readings.target]
        moved = points - translations[readings.station]
        predicted = np.einsum("nji,nj->ni", rotations[readings.station], moved)
        misfits = np.einsum("nij,nj->ni", readings.axes(), measured - predicted) / sigmas
        return np.concatenate([misfits.ravel(), x[6:14]])

    start = np.concatenate([field.translation_m[1], np.zeros(11), field.points_m.ravel()])
    oracle = least_squares(residuals, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    np.testing.assert_allclose(solved.network.translation_m[1], oracle.x[:3], atol=1e-6)
    turn = log_so3(exp_so3(oracle.x[3:6]) @ field.rotation[1] @ solved.network.rotation[1].T)
    np.testing.assert_allclose(turn, 0, atol=1e-7)
    assert solved.overall.chi_squared == pytest.approx(2 * oracle.cost, rel=1e-4)


@pytest.mark.parametrize("seed", range(8))
def test_clean_targets_have_no_cause(seed: int) -> None:
    """No cause, no scaled sigma, all checks passed."""
    solved = calibrated(seed, targets=8 + seed % 6)
    assert solved.causes == solved.suspects == ()
    assert solved.scale == 1.0
    assert all(check.ok for check in checks(solved))


@pytest.mark.parametrize(
    ("error", "value", "both_faces"),
    [(INDEX, 2e-4, False), (COLLIMATION, -2e-4, True), (SCALE, 1e-4, False), (CONSTANT, 0.005, False)],
)
def test_instrument_error_is_estimated(error: InstrumentError, value: float, *, both_faces: bool) -> None:
    """The error of one station is found with its sigma, and the frames are as good as without it."""
    field = simulated(errors={(1, error): value}, both_faces=both_faces)
    solved = calibrate_network(field.measure(), TARGET_NOISE)
    (cause,) = solved.causes
    assert (cause.kind, cause.station, cause.error) == (CauseKind.INSTRUMENT, 1, error)
    estimate = solved.errors[1, error]
    assert abs(estimate.value - value) < 3.5 * estimate.sigma < abs(value)
    assert solved.overall.p_value > 0.01
    nees, freedom = frame_nees(solved, field)
    assert nees < 2.5 * freedom


def test_wrong_target_constant_is_found() -> None:
    """Distances of all stations 10 mm wrong are the constant of the targets, not that of the instruments."""
    solved = calibrated(errors={(row, CONSTANT): 0.01 for row in range(3)}, spread_m=60.0)
    assert [cause.kind for cause in solved.causes] == [CauseKind.TARGET_CONSTANT]
    assert solved.network.target_constant_m == pytest.approx(0.01, abs=0.002)


@pytest.mark.parametrize("station", [0, 1])
@pytest.mark.slow
def test_two_far_targets_are_found_together(station: int) -> None:
    """Two targets at 260 to 290 m, 15 mm off each in different directions, at one station."""
    displaced = {(station, 0): SIDEWAYS, (station, 1): np.array([-0.009, 0.003, 0.012])}
    solved = calibrated(1, far=2, targets=14, displaced=displaced)
    assert sights(solved) == set(displaced)
    assert not solved.unidentified


def test_target_that_moved_is_seen_wrong_by_one_station() -> None:
    """The target moved after station 1: the others agree on one place."""
    solved = calibrated(displaced={(1, 4): SIDEWAYS, (2, 4): SIDEWAYS})
    assert sights(solved) == {(0, 4)}
    (cause,) = solved.causes
    assert cause.value is not None
    np.testing.assert_allclose(cause.value, -SIDEWAYS, atol=0.005)


def test_gross_errors_do_not_spoil_the_start() -> None:
    """A wrong number of metres and a typing error of half a metre are found."""
    solved = calibrated(displaced={(1, 0): np.array([5.0, -3.0, 0.2]), (2, 3): np.array([0.0, 0.5, 0.0])})
    assert sights(solved) == {(1, 0), (2, 3)}


@pytest.mark.slow
def test_index_error_and_far_targets_are_told_apart() -> None:
    """Both are found when both are there."""
    displaced = {(1, 0): SIDEWAYS, (1, 1): np.array([-0.009, 0.003, 0.012])}
    solved = calibrated(3, far=2, targets=14, errors={(1, INDEX): 2e-4}, displaced=displaced)
    assert sights(solved) == set(displaced)
    assert any(cause.error is INDEX and cause.station == 1 for cause in solved.causes)


@pytest.mark.slow
def test_noise_larger_than_stated_scales_the_sigmas() -> None:
    """Twice the noise is no cause of its own."""
    solved = calibrated(noise=2.0, targets=14)
    assert solved.causes == ()
    assert solved.scale == pytest.approx(2.0, abs=0.3)


def test_moved_tripod_is_named() -> None:
    """A tripod that moved by 8 mm in the middle of its round fails a check."""
    moved = (1, 5, np.array([0.006, -0.004, 0.003, 2e-4]))
    solved = calibrated(2, moved_tripod=moved, targets=12)
    (cause,) = solved.causes
    assert (cause.kind, cause.station) == (CauseKind.TRIPOD, 1)
    assert "tripod_moved" in {check.name for check in checks(solved) if not check.ok}


def test_wrong_target_of_four_is_suspected_only() -> None:
    """With four targets and two stations nothing is rejected; the suspect is named and a check fails."""
    solved = calibrated(targets=4, stations=2, displaced={(1, 2): np.array([0.03, 0.04, 0.0])})
    assert sights(solved) == set()
    assert {check.name for check in checks(solved) if not check.ok} == {"noise_scale"}
    assert any(cause.kind is CauseKind.SIGHT for cause in solved.suspects)


def test_residual_limit_leaves_out_targets_and_accepts_the_rest() -> None:
    """The same with a limit of the user's own."""
    readings = simulated(targets=4, stations=2, displaced={(1, 2): np.array([0.03, 0.04, 0.0])}).measure()
    solved = calibrate_network(readings, TARGET_NOISE, max_residual_m=0.01)
    (frame,) = station_frames(solved).values()
    assert frame.consistent
    assert len(frame.used) == 3
    assert frame.max_m < 0.01
    with pytest.raises(DegenerateGeometryError, match="at least 3 targets in common"):
        calibrate_network(readings, TARGET_NOISE, max_residual_m=1e-6)


def test_checks_are_those_of_the_weighted_solution() -> None:
    """An unweighted frame rejects the same targets and keeps the verdict."""
    solved = calibrated(displaced={(1, 4): SIDEWAYS})
    weighted, (unweighted, _, _) = station_frames(solved), unweighted_frames(solved, TARGET_NOISE)
    for station, frame in weighted.items():
        assert unweighted[station].used == frame.used
        assert unweighted[station].consistent == frame.consistent
        np.testing.assert_allclose(unweighted[station].T, frame.T, atol=2e-3)


@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.slow
def test_frame_nees_is_consistent(*, weighted: bool) -> None:
    """With instrument errors within the data sheet the normalised errors of the frames average one."""
    total = freedom = 0.0
    for seed in range(12):
        field = simulated(seed, in_specification=True, targets=8)
        solved = calibrate_network(field.measure(), TARGET_NOISE)
        if weighted:
            nees, count = frame_nees(solved, field)
        else:
            frames, _, _ = unweighted_frames(solved, TARGET_NOISE)
            nees, count = 0.0, 0
            for row, frame in enumerate(frames.values(), start=1):
                error = np.concatenate(
                    [
                        field.translation_m[row] - frame.T[:3, 3],
                        log_so3(field.rotation[row] @ frame.T[:3, :3].T),
                    ]
                )
                nees += float(error @ np.linalg.solve(frame.covariance, error))
                count += 6
        total += nees
        freedom += count
    assert 0.6 < total / freedom < 1.35


def test_levelled_station_that_is_tilted_fails_a_check() -> None:
    """A tilt of 1 mrad is named, and the frame is not tilted."""
    field = simulated(targets=8)
    field.rotation[1] = exp_so3(np.array([1e-3, 0, 0])) @ exp_so3(np.array([0, 0, 0.5]))
    field.rotation[2] = exp_so3(np.array([0, 0, 2.0]))
    solved = calibrate_network(field.measure(), TARGET_NOISE, levelled=True)
    failed = {check.name: check for check in checks(solved) if not check.ok}
    assert failed["tilt_mrad"].station == 2
    assert failed["tilt_mrad"].value == pytest.approx(1.0, abs=0.1)
    np.testing.assert_array_equal(solved.network.rotation[1, 2, :2], [0.0, 0.0])


def test_noise_four_times_is_not_taken_for_many_wrong_sights() -> None:
    """The checks fail; no list of suspects that would leave out a third of the sights."""
    solved = calibrated(0, noise=4.0, targets=13)
    assert solved.causes == solved.suspects == ()
    assert any(not check.ok for check in checks(solved))
