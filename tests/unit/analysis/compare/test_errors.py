"""Errors of paired poses against values known by construction."""

from __future__ import annotations

import math

import numpy as np
import pytest
from harness.drives.paired import drive, noisy, paired
from scipy.spatial.transform import Rotation

from tsgt.analysis.compare.errors import TRAVEL_COMPONENTS, absolute, error_series, nees
from tsgt.geometry import transform_from

SIGMAS = np.array([0.003] * 3 + [0.001] * 3)
COVARIANCE = np.diag(SIGMAS**2)
TRUE = drive(4000, 10.0)


def test_reference_explains_its_own_noise() -> None:
    """An estimate that is exact, against a reference with this noise: everything is explained."""
    reference = noisy(TRUE, np.random.default_rng(1), position_m=0.003, rotation_rad=0.001)
    found = absolute(paired(TRUE, reference, covariance=COVARIANCE), aligned=False)
    assert found.explained.position_rms_mm == pytest.approx(3 * math.sqrt(3))
    assert found.errors.position_mm.rms == pytest.approx(found.explained.position_rms_mm, rel=0.03)
    assert found.errors.orientation_deg.rms == pytest.approx(found.explained.orientation_rms_deg, rel=0.03)
    assert found.position_below_resolution
    assert found.orientation_below_resolution


def test_large_error_is_above_the_resolution() -> None:
    """Twice the reference's own uncertainty is not explained by it."""
    estimated = noisy(TRUE, np.random.default_rng(1), position_m=0.006, rotation_rad=0.002)
    found = absolute(paired(estimated, TRUE, covariance=COVARIANCE), aligned=False)
    assert not found.position_below_resolution
    assert not found.orientation_below_resolution


def test_alignment_absorbs_the_common_part() -> None:
    """Of 3 mm, 2.4 mm are common to all poses: 1.8 mm remain."""
    pairs = paired(TRUE, TRUE, covariance=COVARIANCE, common=0.64 * COVARIANCE)
    whole, aligned = (absolute(pairs, aligned=each).explained for each in (False, True))
    assert whole.common_position_rms_mm == pytest.approx(2.4 * math.sqrt(3))
    assert whole.position_rms_mm == pytest.approx(3.0 * math.sqrt(3))
    assert aligned.position_rms_mm == pytest.approx(1.8 * math.sqrt(3))
    assert aligned.common_position_rms_mm == 0.0


def test_unknown_covariance_explains_nothing() -> None:
    """The figures are NaN, and nothing is called below the resolution."""
    found = absolute(paired(TRUE, TRUE), aligned=True)
    assert math.isnan(found.explained.position_rms_mm)
    assert not found.position_below_resolution


def test_errors_are_resolved_along_the_direction_of_travel() -> None:
    """An estimate that is late lies behind; yaw is about the vertical whatever the axes of the sensor are."""
    estimated = TRUE.copy()
    estimated[1:, :3, 3] = TRUE[:-1, :3, 3]  # late by 0.1 s
    estimated[:, :3, :3] = Rotation.from_euler("z", 0.01).as_matrix() @ TRUE[:, :3, :3]
    found = error_series(paired(estimated, TRUE))
    moving = found.speed_mps > 0.99
    mean = found.components.value[moving].mean(axis=0)
    assert mean[:3] == pytest.approx([-0.1, 0.0, -0.002], abs=1e-3)
    assert mean[3:] == pytest.approx([0.0, 0.0, 0.01], abs=1e-9)
    assert found.turn_rate_radps[moving][10:-10] == pytest.approx(0.05, abs=2e-3)
    assert found.path_m[-1] == pytest.approx(394.9, abs=0.2)


def test_direction_of_travel_is_kept_at_a_stop() -> None:
    """Before the first move it is the direction of that move."""
    estimated = TRUE.copy()
    estimated[:, 0, 3] -= 0.05
    value = error_series(paired(estimated, TRUE)).components.value
    assert value[0, :2] == pytest.approx([-0.05, 0.0], abs=2e-3)


def test_component_sigmas_follow_the_direction_of_travel() -> None:
    """A reference that is weak along y of ``station1`` is weak along the path where that leads along y."""
    covariance = np.diag([0.001, 0.009, 0.002, 0.0, 0.0, 0.0]) ** 2
    found = error_series(paired(TRUE, TRUE, covariance=covariance))
    row = int(np.argmin(np.abs(TRUE[:, 0, 3] - 20.0)))  # a quarter of the circle
    assert found.components.sigma[row, :3] == pytest.approx([0.009, 0.001, 0.002], rel=0.02)
    assert found.component_keys()["up_mm"]["explained_rms"] == pytest.approx(2.0)


def test_positions_alone_have_no_rotation_figures() -> None:
    """Their components of rotation are unknown."""
    pairs = paired(TRUE, TRUE, covariance=COVARIANCE, has_orientation=False)
    found, series = absolute(pairs, aligned=False), error_series(pairs)
    assert math.isnan(found.errors.orientation_deg.rms)
    assert math.isnan(found.explained.orientation_rms_deg)
    assert np.isnan(series.components.value[:, 3:]).all()
    assert list(series.component_keys()) == [
        f"{n}_{'mm' if i < 3 else 'deg'}" for i, n in enumerate(TRAVEL_COMPONENTS)
    ]


@pytest.mark.parametrize(("with_rotation", "size"), [(True, 6), (False, 3)])
def test_nees_adds_both_covariances(with_rotation: bool, size: int) -> None:  # noqa: FBT001 (a parameter)
    """Both trajectories have the noise that they state."""
    random = np.random.default_rng(5)
    estimated, reference = (noisy(TRUE, random, position_m=0.003, rotation_rad=0.001) for _ in range(2))
    pairs = paired(
        estimated,
        reference,
        covariance=COVARIANCE,
        estimate_covariance=COVARIANCE,
        has_orientation=with_rotation,
    )
    found = nees(pairs)
    assert found is not None
    assert found.degrees_of_freedom == size
    assert found.statistics.mean == pytest.approx(size, rel=0.03)
    assert found.statistics.above_95 == pytest.approx(0.05, abs=0.01)


def test_estimate_without_covariance_has_no_nees() -> None:
    """Nor has one whose covariances are all zero."""
    assert nees(paired(TRUE, TRUE, covariance=COVARIANCE)) is None
    assert nees(paired(TRUE, TRUE, estimate_covariance=np.zeros((6, 6)))) is None


def test_errors_grow_with_the_speed_in_bins() -> None:
    """A late estimate is wrong while it moves."""
    estimated = TRUE.copy()
    estimated[1:, :3, 3] = TRUE[:-1, :3, 3]
    found = error_series(paired(estimated, TRUE)).by_speed()
    assert found is not None
    assert found.mean[0] < 1e-9
    assert found.mean[-1] == pytest.approx(0.1, rel=0.01)


def test_few_poses() -> None:
    """One pose, or none, has no motion."""
    for count in (0, 1):
        pairs = paired(TRUE[:count], TRUE[:count], covariance=COVARIANCE)
        assert len(error_series(pairs).speed_mps) == count
        assert absolute(pairs, aligned=False).errors.n == count


def test_constant_frame_error_shows_in_full() -> None:
    """Nothing is aligned here."""
    off = transform_from(np.eye(3), np.array([0.3, 0.0, 0.4]))
    assert absolute(paired(off @ TRUE, TRUE), aligned=False).errors.position_mm.rms == pytest.approx(500.0)
