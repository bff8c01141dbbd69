"""Findings about an estimate before the fit: each planted mistake is found and named, a good estimate is not blamed."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from harness.drives.estimates import (
    GNSS,
    LIDAR,
    VISUAL_INERTIAL,
    EstimateModel,
    draw_relation,
    simulate_estimate,
)

from tsgt.analysis.compare import Estimate, ReferencePoses
from tsgt.analysis.compare.checks import input_findings, quaternion_finding, relative_offset_s
from tsgt.config import ScenarioConfig
from tsgt.model import ROBOT_ORIGIN
from tsgt.simulation.world import World, scenario_world

START_NS = 1_700_000_000_000_000_000
UNTIL_S = 200.0


@cache
def _world() -> World:
    return scenario_world(ScenarioConfig(), UNTIL_S, np.random.default_rng(4))


@cache
def _reference() -> ReferencePoses:
    time_s = np.arange(0.0, UNTIL_S, 0.05)
    stamp_ns = START_NS + np.rint(time_s * 1e9).astype(np.int64)
    T = _world().pose_at(time_s)
    return ReferencePoses(stamp_ns, T, None, None, np.ones(len(T), dtype=np.bool_), ROBOT_ORIGIN)


def _estimate(model: EstimateModel = LIDAR, seed: int = 1, **changes: Any) -> Estimate:
    rng = np.random.default_rng(seed)
    relation = draw_relation(model, rng, max_offset_s=0.0)
    found = simulate_estimate(model, relation, _world().pose_at, UNTIL_S, rng, start_ns=START_NS)
    estimate = Estimate("slam", found.stamp_ns, found.position_m, found.orientation_xyzw, None)
    return replace(estimate, **changes)


def _codes(estimate: Estimate, **options: Any) -> list[tuple[str, str]]:
    return [(each.severity, each.code) for each in input_findings(_reference(), estimate, **options)]


@pytest.mark.parametrize("model", [LIDAR, VISUAL_INERTIAL, GNSS])
def test_good_estimates_are_not_blamed(model: EstimateModel) -> None:
    """Of any kind; not even with an offset of 2 s, and after divergence."""
    for seed in range(2):
        estimate = _estimate(replace(model, diverges_at_s=170.0), seed)
        late = replace(estimate, stamp_ns=estimate.stamp_ns + 2_000_000_000)
        assert _codes(estimate) == _codes(late) == []
        assert quaternion_finding(_reference(), _estimate(model, seed), 0.0) is None
        assert quaternion_finding(_reference(), late, 0.0) is None


def test_no_overlap_is_an_error_with_both_periods() -> None:
    """A day apart."""
    estimate = _estimate()
    far = replace(estimate, stamp_ns=estimate.stamp_ns + 86_400 * 10**9)
    (found,) = input_findings(_reference(), far)
    assert (found.severity, found.code) == ("error", "no_overlap")
    assert "covers 2023-11-15 22:13:20 to 2023-11-15 22:16:39" in found.text
    assert "the reference 2023-11-14 22:13:20 to 2023-11-14 22:16:39 (UTC)" in found.text
    assert _codes(far, offset_s=-86_400.0) == []


def test_time_zone_is_suspected() -> None:
    """Whole or half hours apart."""
    estimate = _estimate()
    (found,) = input_findings(
        _reference(), replace(estimate, stamp_ns=estimate.stamp_ns + (5 * 3600 + 1800) * 10**9)
    )
    assert found.text.endswith("they differ by about +5.5 h: is one of them in local time?")


def test_small_overlap_is_a_warning() -> None:
    """30 s of 200 s."""
    estimate = _estimate()
    (found,) = input_findings(_reference(), replace(estimate, stamp_ns=estimate.stamp_ns + 170 * 10**9))
    assert (found.severity, found.code) == ("warning", "small_overlap")
    assert found.text == "only 30 s of overlap: the estimate lasts 200 s, the reference 200 s"


def test_relative_times_are_told_with_the_range_of_the_offset() -> None:
    """The range holds every offset at which both overlap by 10 s, and no other."""
    estimate = _estimate()
    assert relative_offset_s(_reference(), estimate) is None
    own = replace(estimate, stamp_ns=estimate.stamp_ns - START_NS)
    assert _codes(own) == [("warning", "relative_times")]
    found = relative_offset_s(_reference(), own)
    assert found is not None
    centre_s, half_s = found
    assert centre_s == pytest.approx(START_NS / 1e9, abs=0.2)
    assert half_s == pytest.approx(190.0, abs=0.2)
    assert _codes(own, offset_s=START_NS / 1e9) == []


def test_constant_pose_is_an_error() -> None:
    """As of a program that never started to track."""
    estimate = _estimate()
    constant = replace(estimate, position_m=np.full_like(estimate.position_m, 3.0))
    assert _codes(constant) == [("error", "constant")]


@pytest.mark.parametrize(("factor", "name"), [(1e3, "millimetres"), (1e-3, "kilometres")])
def test_wrong_unit_is_an_error(factor: float, name: str) -> None:
    """Told by the speeds; if the scale is fitted, it is of no importance."""
    estimate = _estimate()
    wrong = replace(estimate, position_m=factor * estimate.position_m)
    (found,) = input_findings(_reference(), wrong)
    assert (found.severity, found.code) == ("error", "unit")
    assert f"seem to be in {name}" in found.text
    assert _codes(wrong, scale_fitted=True) == []


def test_missing_scale_is_a_warning() -> None:
    """As of a monocular estimate."""
    estimate = _estimate()
    assert _codes(replace(estimate, position_m=0.2 * estimate.position_m)) == [("warning", "scale")]


@pytest.mark.parametrize("model", [LIDAR, VISUAL_INERTIAL])
@pytest.mark.parametrize(("written", "order"), [([3, 0, 1, 2], "w first"), ([1, 2, 3, 0], "w last")])
def test_wrong_order_of_quaternions_is_an_error(model: EstimateModel, written: list[int], order: str) -> None:
    """Whatever the sensor's and the frame's axes are; with an offset of 0.5 s left."""
    for seed in range(2):
        estimate = _estimate(model, seed)
        assert estimate.orientation_xyzw is not None
        wrong = replace(estimate, orientation_xyzw=estimate.orientation_xyzw[:, written])
        found = quaternion_finding(_reference(), wrong, 0.5)
        assert found is not None
        assert f"with {order} by" in found.text
