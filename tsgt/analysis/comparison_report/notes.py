"""What a reader must know of a comparison, in sentences."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tsgt.analysis.compare import Comparison

OVERCONFIDENT = 2.0  # Times the expected NEES, above which it is a remark


def notes(each: Comparison) -> list[str]:
    """Return what limits the figures of a comparison, and what was left out or repaired, a sentence each."""
    lines = [*each.estimate.notes, *cautions(each), *_left_out(each)]
    if each.errors.drift.shortened and each.errors.drift.segments:
        longest = each.errors.drift.segments[-1].length_m
        lines.append(
            f"the path is too short for KITTI's segments; drift is over segments of up to {longest:g} m"
        )
    return lines


def cautions(each: Comparison) -> list[str]:
    """Return what makes figures of a comparison less than they seem, a sentence each."""
    lines = list(each.warnings)
    if undetermined(each):
        names = ", ".join(component_text(name) for name in undetermined(each))
        lines.append(f"undetermined by this motion, left as given: {names}")
    if each.weakly_determined:
        weak = ", ".join(_with_sigma(name, sigma) for name, sigma in each.weakly_determined.items())
        lines.append(
            f"weakly determined by this motion, not within 1 ms, 5 mm or 0.1° at two sigmas: {weak} (sigma)"
        )
    c = each.errors.completeness
    if c.diverged_s is not None:
        lines.append(f"diverged {c.diverged_s:.0f} s after its start; all figures include that")
    if c.jumps:
        worst = max(c.jumps, key=lambda jump: jump.position_m)
        plural = "s, the largest" if len(c.jumps) > 1 else ""
        lines.append(f"{len(c.jumps)} jump{plural} of {1e3 * worst.position_m:.0f} mm")
    fair = each.steps[each.smallest_fair]
    own = each.errors.ate.errors.position_mm.rms
    with_extrinsic = fair.ate.errors.position_mm.rms
    if "extrinsic" in fair.settings.parts - each.settings.parts and with_extrinsic < own:
        lines.append(
            f"the extrinsic is not fitted: with it the error falls from {own:.1f} to {with_extrinsic:.1f} mm; "
            "use `--fit offset,extrinsic`, or `--extrinsic FILE`"
        )
    nees = each.errors.nees
    if (
        nees is not None
        and _comparable(each)
        and nees.statistics.mean > OVERCONFIDENT * nees.degrees_of_freedom
    ):
        factor = nees.statistics.mean / nees.degrees_of_freedom
        lines.append(
            f"its covariance is too small: squared errors are {factor:.1f} times what it states (NEES)"
        )
    return lines


def undetermined(each: Comparison) -> list[str]:
    """Return the unknowns that the motion does not determine, without those that the estimate does not have."""
    return [name for name in each.unobservable if not _meaningless(each, name)]


def _left_out(each: Comparison) -> list[str]:
    c = each.errors.completeness
    reasons = (
        (c.outside, "before or after the reference"),
        (c.reference_gap, "where the reference is invalid"),
        (c.reference_weak, "where the reference is less certain than asked for"),
    )
    return [f"{count} of {c.poses} poses left out {where}" for count, where in reasons if count]


def _comparable(each: Comparison) -> bool:
    """Return whether errors are those that a covariance states.

    That of odometry grows from the start, whose pose an alignment over all moves; positions of the start alone show no direction.
    """
    if "frame" not in each.settings.parts:
        return True
    return (each.settings.align == "start") == (each.estimate.orientation_xyzw is not None)


def _with_sigma(name: str, sigma: float) -> str:
    if name.endswith("_rad"):
        return f"{component_text(name)} {math.degrees(sigma):.2f}°"
    return f"{component_text(name)} {1e3 * sigma:.2g} {'ms' if name.endswith('_s') else 'mm'}"


def _meaningless(each: Comparison, name: str) -> bool:
    """Return whether an unknown does not exist: a position has no axes."""
    return each.estimate.orientation_xyzw is None and name.startswith("extrinsic") and name.endswith("_rad")


def component_text(name: str) -> str:
    """Return a name of a fitted unknown in words: ``extrinsic_z_m`` is "extrinsic z"."""
    return name.rsplit("_", 1)[0].replace("_", " ") if name.endswith(("_m", "_rad", "_s")) else name
