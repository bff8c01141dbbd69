"""Findings on noise, loss of lock, targets and held-out prediction."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.files.records import PARAMETERS

from tsgt.analysis.diagnosis import Finding
from tsgt.analysis.diagnosis.held_out_finding import Part, held_out_finding
from tsgt.analysis.diagnosis.noise_factors import (
    component_noise,
    estimate_noise,
    lock_losses,
    near_gaps,
    single_outliers,
)
from tsgt.analysis.diagnosis.target_findings import calibration_findings
from tsgt.geometry.motion_calibration import LinearisedSetup
from tsgt.geometry.trajectory import Observations
from tsgt.model import SetupCovariance, TargetResidual

if TYPE_CHECKING:
    from tsgt.analysis.diagnosis.noise_factors import LockLoss
    from tsgt.model import Parameters

SIGMA_M = 0.002
GAPS = 6


def solved(seed: int = 0, count: int = 300) -> LinearisedSetup:
    """Return residuals of three stations as noise makes them; each station has a gap of 3 s every 20 s."""
    rng = np.random.default_rng(seed)
    time_s = np.sort(rng.uniform(0.0, 20.0 * GAPS, 3 * count))
    time_s = time_s[time_s % 20.0 > 3.0]
    station = np.arange(len(time_s)) % 3
    observations = Observations(
        time_s=time_s,
        time_sigma_s=np.zeros(len(time_s)),
        points_m=np.full((len(time_s), 3), 50.0),
        sigmas_m=np.full((len(time_s), 3), SIGMA_M),
        polar=np.ones(len(time_s), np.bool_),
        station=station,
        prism=station,
        frames=np.tile(np.eye(4), (3, 1, 1)),
        layout=np.eye(3),
    )
    redundancy = np.full((len(time_s), 3), 0.5)
    return LinearisedSetup(
        [],
        observations,
        rng.normal(scale=SIGMA_M * math.sqrt(0.5), size=(len(time_s), 3)),
        redundancy,
        np.ones(len(time_s)),
        np.ones(len(time_s)),
        np.zeros(len(time_s)),
        np.zeros((len(time_s), 3, 0)),
    )


def losses(linearised: LinearisedSetup) -> LockLoss | None:
    """Losses of lock with the noise of the residuals themselves."""
    return lock_losses(linearised, estimate_noise(linearised, np.ones((3, 3))).normalised)


def test_noise_factor_of_one_component() -> None:
    """Only the component whose residuals are larger gets a factor."""
    linearised = solved()
    linearised.residuals_m[linearised.observations.station == 1, 1] *= 3.0
    factors, sigmas = component_noise(linearised, 3)
    expected = np.ones((3, 3))
    expected[1, 1] = 3.0
    assert np.all(np.abs(factors - expected) < 4 * sigmas)


def test_noise_of_stated_size_is_no_loss_of_lock() -> None:
    """Measurements near gaps that are like the others are not reported."""
    assert not any(losses(solved(seed)) for seed in range(20))


def test_drifting_locks_are_found() -> None:
    """Large residuals near several gaps are a loss of lock; their size is the deviation from the others' prediction."""
    linearised = solved()
    _, gap = near_gaps(linearised.observations)
    for number in np.unique(gap[gap >= 0])[::2]:
        linearised.residuals_m[np.flatnonzero(gap == number)[0], 1] = 0.02
    found = losses(linearised)
    assert found is not None
    assert found.rms_m == pytest.approx(0.04, rel=0.1)  # half of it is in the residual


def test_no_verdict_rests_on_one_gap() -> None:
    """Any number of large residuals near a single gap is no loss of lock."""
    linearised = solved()
    _, gap = near_gaps(linearised.observations)
    linearised.residuals_m[gap == 0, 1] = 0.05
    assert losses(linearised) is None


def test_gross_errors_are_single_outliers() -> None:
    """They are named away from gaps, if the fit has lowered their weight."""
    linearised = solved()
    _, gap = near_gaps(linearised.observations)
    row = int(np.flatnonzero(gap < 0)[40])
    linearised.residuals_m[row] = 0.5
    linearised.weights[row] = 1e-3
    normalised = estimate_noise(linearised, np.ones((3, 3))).normalised
    assert single_outliers(linearised, normalised).tolist() == [row]
    assert losses(linearised) is None


def with_targets(residuals_mm: dict[int, float | None]) -> Parameters:
    """Return parameters whose station 2 has these target residuals."""
    targets = tuple(
        TargetResidual(
            target=number,
            residual_m=None if mm is None else mm / 1e3,
            leave_one_out_m=(15.0 if mm is None else 1.2 * mm) / 1e3,
        )
        for number, mm in residuals_mm.items()
    )
    first, second, third = PARAMETERS.stations
    return replace(PARAMETERS, stations=(first, replace(second, targets=targets), third))


def test_bad_targets_are_named_with_the_command() -> None:
    """A rejected target and one far beyond the others are named together."""
    usual: dict[int, float | None] = dict.fromkeys(range(1, 9), 1.5)
    (found,) = calibration_findings(with_targets({**usual, 10: 14.0, 11: None}))
    assert found.cause == "targets"
    assert found.size == pytest.approx(16.8)
    assert "--exclude 10`" in found.repair  # the other one is left out already
    assert not calibration_findings(with_targets({**usual, 10: 3.5}))


def test_corrected_index_error_is_named_with_its_sigma() -> None:
    """What the calibration found and corrected is a finding without effect."""
    first, second, third = PARAMETERS.stations
    parameters = replace(
        PARAMETERS,
        stations=(first, second, replace(third, vertical_index_rad=2e-4)),
        setup_covariance=SetupCovariance(components=("station3.vertical_index",), matrix=((1e-10,),)),
    )
    (found,) = calibration_findings(parameters)
    assert (found.cause, found.where, found.effect_mm) == ("vertical_index", "station 3", 0.0)
    assert (found.size, found.sigma) == pytest.approx((0.2, 0.01))


TURNED = Finding(
    cause="turned_tripod",
    where="station 2",
    size=0.3,
    sigma=0.01,
    unit="mrad",
    effect_mm=25.0,
    confidence=1.0,
    text="Station 2 is turned.",
    repair="Turn it back.",
)


def test_held_out_prediction_that_is_no_better_has_its_reason() -> None:
    """The parts that are no better are named, with the first cause and its repair."""
    parts = [Part("all", 400, 0.95), Part("moving", 200, 1.3), Part("standing", 200, 0.5)]
    found = held_out_finding(parts, [TURNED])
    assert found is not None
    assert "moving 1.30" in found.text
    assert "standing" not in found.text
    assert TURNED.text in found.text
    assert found.repair == TURNED.repair


def test_held_out_prediction_that_is_better_is_no_finding() -> None:
    """Nor is one of too few points."""
    assert held_out_finding([Part("all", 400, 0.6)], []) is None
    assert held_out_finding([Part("all", 5, 1.6)], []) is None
