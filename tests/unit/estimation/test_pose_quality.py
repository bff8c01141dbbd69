"""Quality of valid poses: each cause of degradation alone."""

from __future__ import annotations

import numpy as np
import pytest

from tsgt.estimation import Degradation, Kind, PoseBatch, Reason
from tsgt.estimation.pose_quality import degradations, worst_sigma
from tsgt.model import PipelineParameters

LIMITS = PipelineParameters()
GOOD_SIGMAS = np.array([[0.01, 0.01]])


def good(kind: Kind = Kind.PREDICTED) -> PoseBatch:
    """One pose of four prisms, all measured 0.3 s ago."""
    batch = PoseBatch.blank(np.array([10**18]), (1, 2, 3, 4), kind)
    batch.age_s[:] = 0.3
    batch.residual_m[:] = 0.002
    return batch


def found(batch: PoseBatch, sigmas: np.ndarray = GOOD_SIGMAS, *, ambiguous: bool = False) -> int:
    """Return what degrades the pose."""
    return int(degradations(batch, sigmas, LIMITS, ambiguous=np.array([ambiguous]))[0])


def test_pose_with_reserve_is_good() -> None:
    """Also with one of four prisms out of sight."""
    batch = good()
    batch.prism_reason[0, 1] = Reason.OUTAGE
    assert found(batch) == 0


def test_two_prisms_are_too_few() -> None:
    """Whatever the reason."""
    batch = good()
    batch.prism_reason[0, :2] = Reason.OUTAGE, Reason.STATION_STATUS
    assert found(batch) == Degradation.PRISM_MISSING


@pytest.mark.parametrize("prisms", [1, 2])
def test_small_layout_misses_only_its_own_prisms(prisms: int) -> None:
    """Of one or two prisms, with an IMU."""
    batch = PoseBatch.blank(np.array([10**18]), tuple(range(1, prisms + 1)), Kind.PREDICTED)
    batch.age_s[:] = 0.3
    assert found(batch) == 0
    batch.prism_reason[0, 0] = Reason.OUTAGE
    assert found(batch) == Degradation.PRISM_MISSING


def test_newest_measurement_counts_for_predictions() -> None:
    """A smoothed pose has measurements on both sides."""
    for kind, expected in ((Kind.PREDICTED, Degradation.OLD_MEASUREMENTS), (Kind.SMOOTHED, 0)):
        batch = good(kind)
        batch.age_s[:] = 0.8
        assert found(batch) == expected
        batch.age_s[0, 2] = 0.7
        assert found(batch) == 0


@pytest.mark.parametrize(
    ("kind", "sigma_m", "sigma_rad"), [(Kind.PREDICTED, 0.076, 0.044), (Kind.SMOOTHED, 0.026, 0.018)]
)
def test_half_the_limit_of_a_sigma_degrades(kind: Kind, sigma_m: float, sigma_rad: float) -> None:
    """Either sigma; each kind has its own limits."""
    assert found(good(kind), np.array([[sigma_m, 0.001]])) == Degradation.UNCERTAIN
    assert found(good(kind), np.array([[0.001, sigma_rad]])) == Degradation.UNCERTAIN
    assert found(good(kind), np.array([[0.9 * sigma_m, 0.9 * sigma_rad]])) == 0


def test_several_causes_are_named() -> None:
    """In the record in words."""
    batch = good()
    batch.residual_m[:] = 0.03
    batch.degraded[:] = found(batch, ambiguous=True)
    (record,) = batch.records()
    assert (record.quality, record.degraded_by) == ("degraded", ("ambiguous", "residual"))


def test_invalid_pose_has_a_reason_instead() -> None:
    """Its quality is its validity."""
    batch = good()
    batch.reason[:] = Reason.TILT
    assert found(batch, ambiguous=True) == 0
    (record,) = batch.records()
    assert (record.quality, record.degraded_by) == ("invalid", ())


def test_worst_sigma_is_along_the_least_certain_direction() -> None:
    """NaN for what is unknown, or negative by rounding."""
    direction = np.array([1.0, 2.0, -2.0]) / 3
    covariance = 0.01 * np.eye(3) + 0.24 * np.outer(direction, direction)
    sigmas = worst_sigma(np.array([covariance, np.full((3, 3), np.nan), -np.eye(3)]))
    np.testing.assert_allclose(sigmas, [0.5, np.nan, np.nan])
