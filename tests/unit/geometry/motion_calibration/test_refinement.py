"""Refinement of a set-up: what is planted into a synthetic drive is found, and clean data are left alone."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.drive import LAYOUT, MOTION_PRIOR, drive

from tsgt.geometry import exp_so3
from tsgt.geometry.motion_calibration import Setup, SetupParameters, calibrated_covariance, refine_setup
from tsgt.geometry.motion_calibration.information import Information
from tsgt.model import SetupCovariance

if TYPE_CHECKING:
    from tsgt.geometry.motion_calibration import RefinedSetup
    from tsgt.geometry.trajectory import Observations

NUMBERS = [1, 2, 3]


def refined(observations: Observations, *, prisms: bool = False) -> RefinedSetup:
    """Refine with the covariance of a good calibration from targets: 1 mm and 0.03 mrad, prisms to 0.5 mm."""
    parameters = SetupParameters.of_observations(observations, Setup.of(observations))
    names = parameters.names(NUMBERS, NUMBERS)
    frames = [name for name in names if name[-2:] in (".x", ".y", ".z") or "rotation" in name]
    sigmas = [3e-5 if "rotation" in name else 5e-4 if "prism" in name else 1e-3 for name in frames]
    known = SetupCovariance(
        components=tuple(frames), matrix=tuple(map(tuple, np.diag(np.square(sigmas)).tolist()))
    )
    covariance = calibrated_covariance(parameters, names, known)
    return refine_setup(observations, parameters, covariance, MOTION_PRIOR, np.ones((3, 3)), prisms=prisms)


def best(found: RefinedSetup) -> tuple[str, int]:
    """Kind and row of the most probable hypothesis."""
    each = max(found.evidence, key=lambda each: each.log_bayes_factor + each.hypothesis.log_prior)
    return each.hypothesis.kind, each.hypothesis.row


def planted(observations: Observations, true: Setup) -> Observations:
    """Return measurements as stations with other instrument errors and latencies take them, with the given frames."""
    reverse = replace(true, instrument=-true.instrument, latencies_s=-true.latencies_s)
    return replace(reverse.applied(observations), frames=observations.frames, layout=observations.layout)


def test_clean_data_are_left_alone() -> None:
    """Nothing is selected, and the set-up and its covariance stay as they are."""
    found = refined(drive(60.0, seed=3))
    assert not found.used
    assert found.p_value > 0.01
    assert not any(each.selected for each in found.evidence)
    assert found.setup is found.parameters.reference


def test_noise_is_not_tuned_again_for_a_set_up_that_explains_nothing() -> None:
    """Clean data: the prior is the given one."""
    assert refined(drive(60.0, seed=3)).motion_prior is MOTION_PRIOR


def test_evidence_is_bounded() -> None:
    """No prior between the narrowest and the widest has more evidence than the bound."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(6, 6))
    information = Information(root @ root.T, rng.normal(scale=5.0, size=6))
    columns = rng.normal(size=(6, 10))
    bound = information.max_evidence(columns[:, :2], columns)
    between = [information.evidence(columns[:, : 2 + number]) for number in range(9)]
    assert max(between) < bound < max(between) + 20.0


@pytest.mark.slow
def test_vertical_index_is_found() -> None:
    """Of one station: the most probable cause, estimated within its sigma."""
    observations = drive(60.0, seed=1)
    true = Setup.of(observations)
    true.instrument[1, 0] = 4e-4
    found = refined(planted(observations, true))
    assert found.used
    assert best(found) == ("vertical_index", 1)
    assert [each.hypothesis.kind for each in found.evidence if each.selected] == ["vertical_index"]
    at = found.parameters.instrument[1, 0]
    sigma = float(np.sqrt(found.covariance[at, at]))
    assert found.setup.instrument[1, 0] == pytest.approx(4e-4, abs=4 * sigma)
    assert sigma < 1e-4


@pytest.mark.slow
def test_turned_tripod_is_found() -> None:
    """Station 3 turned by 0.4 mrad about its vertical after its frame was calibrated."""
    observations = drive(60.0, seed=2)
    frames = observations.frames.copy()
    frames[2, :3, :3] = exp_so3(np.array([0.0, 0.0, -4e-4])) @ frames[2, :3, :3]
    found = refined(replace(observations, frames=frames))
    assert best(found) == ("turned", 2)
    turned = next(each for each in found.evidence if each.hypothesis.kind == "turned" and each.selected)
    assert turned.estimate[0] == pytest.approx(4e-4, abs=4 * turned.sigma[0])
    missed_m, _ = found.setup.corrections(Setup.of(observations), found.parameters.pivot)
    assert np.abs(missed_m).max() < 4e-3


@pytest.mark.slow
def test_latency_is_found() -> None:
    """Station 2 stamps 25 ms late."""
    observations = drive(60.0, seed=4)
    true = Setup.of(observations)
    true.latencies_s[1] = 0.025
    found = refined(planted(observations, true))
    assert best(found) == ("latency", 1)
    assert found.setup.latencies_s[1] == pytest.approx(0.025, abs=3e-3)


@pytest.mark.slow
@pytest.mark.parametrize("prisms", [False, True])
def test_prisms_are_refined_only_on_request(prisms: bool) -> None:  # noqa: FBT001
    """A prism that is 12 mm off is named in any case; the layout changes only if asked."""
    layout = LAYOUT.copy()
    layout[1, 0] += 0.012
    found = refined(replace(drive(60.0, seed=5), layout=layout), prisms=prisms)
    assert best(found) == ("prism", 1)
    if not prisms:
        np.testing.assert_array_equal(found.setup.layout, layout)
        return
    distances, true = (
        np.linalg.norm(each - np.roll(each, 1, axis=0), axis=1) for each in (found.setup.layout, LAYOUT)
    )
    assert distances == pytest.approx(true, abs=1.5e-3)


@pytest.mark.slow
def test_another_layout_is_no_refinement() -> None:
    """Decimetres are a gross error: the set-up stays, so that the residuals show it."""
    observations = drive(30.0)
    assert not refined(replace(observations, layout=1.5 * LAYOUT), prisms=True).used
