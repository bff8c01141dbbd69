"""Cover, gaps, jumps and divergence of estimates."""

from __future__ import annotations

import math

import numpy as np
from harness.drives.paired import drive, noisy, paired

from tsgt.analysis.compare import ReferencePoses
from tsgt.analysis.compare.completeness import Completeness, completeness
from tsgt.analysis.compare.errors import error_series
from tsgt.model import ROBOT_ORIGIN

RATE_HZ = 10.0
TRUE = drive(3000, RATE_HZ)
STAMP_NS = np.arange(3000) * 100_000_000
ESTIMATED = noisy(TRUE, np.random.default_rng(4), position_m=0.005, rotation_rad=0.001)


def found(
    estimated: np.ndarray,
    kept: np.ndarray | None = None,
    valid: np.ndarray | None = None,
    *,
    turns: bool = True,
) -> Completeness:
    """Assess an estimate that has the poses ``kept``, (3000,), against a reference with the poses ``valid``."""
    kept = np.ones(3000, np.bool_) if kept is None else kept
    valid = np.ones(3000, np.bool_) if valid is None else valid
    reference = ReferencePoses(STAMP_NS, TRUE, None, None, valid, ROBOT_ORIGIN)
    pairs = paired(estimated[kept & valid], TRUE[kept & valid], has_orientation=turns)
    object.__setattr__(pairs, "stamp_ns", STAMP_NS[kept & valid])
    return completeness(reference, STAMP_NS[kept], pairs, error_series(pairs))


def test_complete_estimate() -> None:
    """It covers everything, and nothing jumps."""
    each = found(ESTIMATED)
    assert each.share == 1.0
    assert each.gaps == ()
    assert each.jumps == ()
    assert each.diverged_ns is None


def test_gap_is_not_covered() -> None:
    """Ten seconds of 300 are missing; they have a start and a duration."""
    kept = np.ones(3000, np.bool_)
    kept[1001:1100] = False
    each = found(ESTIMATED, kept)
    assert each.share == 1 - 10.0 / 299.9
    assert [(gap.start_ns, gap.duration_s) for gap in each.gaps] == [(100_000_000_000, 10.0)]


def test_single_dropout_is_no_gap() -> None:
    """Two intervals instead of one."""
    kept = np.ones(3000, np.bool_)
    kept[1001] = False
    assert found(ESTIMATED, kept).share == 1.0


def test_time_without_a_reference_does_not_count() -> None:
    """The estimate is missing only where the reference is invalid."""
    valid = np.ones(3000, np.bool_)
    valid[500:700] = False
    each = found(ESTIMATED, kept=valid.copy(), valid=valid)
    assert each.share == 1.0
    assert math.isclose(each.reference_valid_s, 279.8)


def test_estimate_that_ends_early() -> None:
    """The rest counts as missing."""
    kept = np.arange(3000) < 1500
    assert math.isclose(found(ESTIMATED, kept).share, 149.9 / 299.9)


def test_jump_is_found() -> None:
    """As after a loop closure: of position, and of rotation."""
    shifted = ESTIMATED.copy()
    shifted[1200:, 1, 3] += 0.3
    (jump,) = found(shifted).jumps
    assert jump.stamp_ns == STAMP_NS[1200]
    assert math.isclose(jump.position_m, 0.3, rel_tol=0.1)
    (jump,) = found(shifted, turns=False).jumps
    assert math.isnan(jump.rotation_rad)


def test_drift_during_a_gap_is_no_jump() -> None:
    """It has the gap to explain it."""
    shifted, kept = ESTIMATED.copy(), np.ones(3000, np.bool_)
    shifted[1100:, 1, 3] += 0.3
    kept[1001:1100] = False
    assert found(shifted, kept).jumps == ()


def test_divergence_begins_where_the_error_leaves_the_limit_for_good() -> None:
    """Growing with 1 m/s from 200 s on; the limit there is 1 m and 5 % of the 195 m driven."""
    diverging = ESTIMATED.copy()
    diverging[2000:, 0, 3] += 0.1 * np.arange(1000)
    each = found(diverging)
    assert each.diverged_s is not None
    assert math.isclose(each.diverged_s, 200 + 10.75 / 0.95 + 0.05, abs_tol=0.3)


def test_recovered_estimate_has_not_diverged() -> None:
    """An error of 50 m for 20 s is not for good."""
    lost = ESTIMATED.copy()
    lost[1000:1200, 0, 3] += 50.0
    assert found(lost).diverged_ns is None


def test_noisy_positions_have_not_diverged() -> None:
    """GNSS with 3 m per axis is always that bad."""
    each = found(noisy(TRUE, np.random.default_rng(6), position_m=3.0, rotation_rad=0.0), turns=False)
    assert each.diverged_ns is None
    assert each.jumps == ()
