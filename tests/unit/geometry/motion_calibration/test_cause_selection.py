"""Selection of causes by evidence."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from tsgt.geometry.motion_calibration import CauseSelection, SetupCause, SetupErrors, cause_hypotheses
from tsgt.geometry.motion_calibration.information import Information

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

LAYOUT = SetupErrors((1, 2, 3), (1, 2, 3))
CANDIDATES = cause_hypotheses(LAYOUT)
NOMINAL = LAYOUT.nominal_covariance(None)


def information_of(errors: FloatArray, sigma_of: FloatArray) -> Information:
    """Return information of errors that were measured directly, without noise."""
    matrix = np.diag(sigma_of**-2.0)
    return Information(matrix, matrix @ errors)


def precise() -> FloatArray:
    """Sigmas of a drive that determines every component to a tenth of its nominal sigma."""
    return 0.1 * np.sqrt(np.maximum(np.diag(NOMINAL), 1e-12))


def test_evidence_is_the_ratio_of_densities() -> None:
    """For directly measured errors it is the log ratio of two normal densities."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(4, 4))
    prior = np.asarray(root @ root.T, np.float64)
    noise = np.asarray(np.diag(rng.uniform(0.5, 2.0, 4)), np.float64)
    measured = rng.normal(size=4)
    information = Information(
        np.asarray(np.linalg.inv(noise), np.float64), np.asarray(np.linalg.solve(noise, measured), np.float64)
    )
    expected = multivariate_normal(cov=prior + noise).logpdf(measured) - multivariate_normal(
        cov=noise
    ).logpdf(measured)
    factor = np.asarray(np.linalg.cholesky(prior), np.float64)
    assert information.evidence(factor) == pytest.approx(expected)
    mean, covariance = information.posterior(factor)
    assert mean == pytest.approx(prior @ np.linalg.solve(prior + noise, measured))
    assert covariance == pytest.approx(np.linalg.inv(np.linalg.inv(prior) + np.linalg.inv(noise)))


@pytest.mark.parametrize(
    ("cause", "number", "component", "size"),
    [
        (SetupCause.TURNED, 2, "rotation_z", 1e-3),
        (SetupCause.TURNED, 1, "rotation_z", -3e-4),
        (SetupCause.VERTICAL_INDEX, 3, "vertical_index", 2e-4),
        (SetupCause.LATENCY, 1, "latency", 0.01),
        (SetupCause.SINKING, 2, "drift_z", 0.01),
        (SetupCause.RANGE_SCALE, 2, "range_scale", 4e-5),
    ],
)
def test_one_error_is_named(cause: SetupCause, number: int, component: str, size: float) -> None:
    """A single error selects its own cause, with its size."""
    errors = np.zeros(len(LAYOUT))
    errors[LAYOUT.of_station(number, component)[0]] = size
    selection = CauseSelection(information_of(errors, precise()), NOMINAL, CANDIDATES)
    (found,) = selection.summarise(selection.search())
    assert found.hypothesis.key == (cause, number)
    assert found.estimate == pytest.approx([size], rel=0.05)
    assert not found.alternatives


def test_nothing_is_named_within_the_nominal_uncertainty() -> None:
    """Errors as large as a correct set-up has them select nothing."""
    for seed in range(20):
        errors = np.random.default_rng(seed).multivariate_normal(np.zeros(len(LAYOUT)), NOMINAL)
        selection = CauseSelection(information_of(errors, precise()), NOMINAL, CANDIDATES)
        assert not selection.search()


def test_a_pair_is_named() -> None:
    """Two errors at different places select two causes."""
    errors = np.zeros(len(LAYOUT))
    errors[LAYOUT.of_station(2, "rotation_z")[0]] = 5e-4
    errors[LAYOUT.of_prism(1)] = [0.008, 0.006, 0.0]
    selection = CauseSelection(information_of(errors, precise()), NOMINAL, CANDIDATES)
    found = {each.hypothesis.key for each in selection.summarise(selection.search())}
    assert found == {(SetupCause.TURNED, 2), (SetupCause.PRISM, 1)}


def test_what_cannot_be_told_apart_is_listed() -> None:
    """Data that see only the sum of two errors name one, and the other as alternative."""
    latency = LAYOUT.of_station(2, "latency")[0]
    constant = LAYOUT.of_station(2, "prism_constant")[0]
    direction = np.zeros(len(LAYOUT))
    direction[latency], direction[constant] = 1.0, 2.0  # both move the same way
    matrix = np.outer(direction, direction) / 1e-4**2
    selection = CauseSelection(Information(matrix, matrix[:, latency] * 0.008), NOMINAL, CANDIDATES)
    (found,) = selection.summarise(selection.search())
    named = {found.hypothesis.cause, *(each.cause for each, _ in found.alternatives)}
    assert named == {SetupCause.LATENCY, SetupCause.RANGE_CONSTANT}


def test_prior_has_the_order_of_the_candidates() -> None:
    """The order of a set differs from run to run, and with it the last digits of what follows."""
    selection = CauseSelection(information_of(np.zeros(len(NOMINAL)), precise()), NOMINAL, CANDIDATES)
    width = selection.prior(frozenset()).shape[1]
    alone = [selection.prior(frozenset({each}))[:, width:] for each in CANDIDATES]
    together = selection.prior(frozenset(CANDIDATES))[:, width:]
    np.testing.assert_array_equal(together, np.concatenate(alone, axis=1))
