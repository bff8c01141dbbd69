"""Verdicts: which results can be trusted, and what to check, by limits that a correct set-up meets with a margin. Sans-I/O."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.diagnosis import GEOMETRY, TARGETS
from tsgt.analysis.report.findings import position_sigma_mm
from tsgt.estimation import Kind, point_label
from tsgt.model import MIN_PRISMS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tsgt.analysis.report.findings import Findings

_VALID_SHARE = 0.95
_IN_GAPS = 0.05
_MOVING_MM = 10.0
_SIGMA_MM = 10.0
_BOUND_MM = 3.0
_LARGE_EFFECT_MM = 10.0
_NEES = (3.0, 12.0)


class Level(StrEnum):
    """Severity of a verdict."""

    GOOD = "good"
    CARE = "take care"
    BAD = "do not trust"


@dataclass(frozen=True, slots=True)
class Verdict:
    """A statement about a result, and what to do about it: an imperative sentence, commands in backquotes; empty if nothing."""

    level: Level
    text: str
    repair: str = ""


def verdicts(findings: Findings) -> list[Verdict]:
    """Return the verdicts, the worst first."""
    found = [
        *_diagnosis(findings),
        *_poses(findings),
        *_stations(findings),
        *_times(findings),
        *_distances(findings),
        *_motion(findings),
        *_reference(findings),
    ]
    order = (Level.BAD, Level.CARE, Level.GOOD)
    return sorted(found, key=lambda verdict: order.index(verdict.level))


def _diagnosis(f: Findings) -> Iterator[Verdict]:
    if f.diagnosis is None:
        return
    for each in f.diagnosis.findings:
        if each.cause == GEOMETRY or each.effect_mm >= _LARGE_EFFECT_MM:
            level = Level.BAD
        else:
            level = Level.GOOD if each.effect_mm == 0 and each.cause != TARGETS else Level.CARE
        deciding = each.deciding_measurement
        yield Verdict(level, each.text, f"{each.repair} To decide: {deciding}." if deciding else each.repair)
    if not f.diagnosis.findings:
        yield Verdict(
            Level.GOOD,
            "The measurements agree with the set-up and with the stated noise; no cause of errors was found.",
        )


def _poses(f: Findings) -> Iterator[Verdict]:
    # One or two prisms, with an IMU, have no poses by linear.
    few = f.continuous is not None and len(f.recording.parameters.prisms) < MIN_PRISMS
    failed = [
        name for name in ("continuous", "linear") if name in f.problems and not (few and name == "linear")
    ]
    for why in dict.fromkeys(f.problems[name] for name in failed):
        names = " and ".join(name for name in failed if f.problems[name] == why)
        yield Verdict(Level.BAD, f"No poses by {names}: {why}.")
    poses = f.poses
    if poses is None:
        return
    share = float(np.mean(poses.valid))
    level = Level.GOOD if share >= _VALID_SHARE else Level.CARE
    estimator = Kind(poses.kind[0]).estimator
    why = ", ".join(f"{reason} {n}" for reason, n in poses.invalid_counts().items())
    yield Verdict(
        level,
        # Rounded down, so that 100.0 % means all poses.
        f"{math.floor(1e3 * share) / 10:.1f}% of the poses of {estimator} are valid"
        f"{f' (not valid: {why})' if why else ''}.",
        "" if share == 1.0 else "Use valid poses only.",
    )
    if not poses.valid.any():
        return
    sigma_mm, common_mm = (
        position_sigma_mm(each[poses.valid]) for each in (poses.covariance, poses.covariance_common)
    )
    known = np.isfinite(common_mm)
    yield Verdict(
        Level.GOOD if np.median(sigma_mm) <= _SIGMA_MM else Level.CARE,
        f"The stated position sigma of the valid poses per axis at {point_label(poses.reference_point)} is "
        f"{np.median(sigma_mm):.1f} mm (median) and {np.percentile(sigma_mm, 95):.1f} mm (95 %)"
        + (
            f"; {np.median(common_mm[known]):.1f} mm of it (median) are common to all poses and do not average out."
            if known.any()
            else "; it does not include errors common to all poses, such as those of a station frame, which are unknown."
        ),
    )


def _stations(f: Findings) -> Iterator[Verdict]:
    limit_s = f.recording.parameters.pipeline.outage_limit_ns / 1e9
    gaps = []
    for number, each in f.station_statistics.items():
        if not each.usable:
            yield Verdict(Level.BAD, f"Station {number} has no usable measurement.")
        elif each.in_gaps > _IN_GAPS:
            gaps.append(f"station {number} {each.in_gaps:.0%} (the longest {each.longest_gap_s:.1f} s)")
    if gaps:
        yield Verdict(
            Level.CARE,
            f"Measurements are missing for more than {limit_s:g} s in this share of the time: {', '.join(gaps)}.",
            "See the figures of the stations for lost targets and lost radio packets."
            if f.log.protocol is None
            else "Add the measurements that the stations stored: `tsgt merge`.",
        )
    if f.log.authenticated is False:
        yield Verdict(
            Level.CARE,
            "The radio was not authenticated: data of other senders cannot be excluded.",
            "Make a key for the next drive: `tsgt radio key`.",
        )


def bound_and_speed(f: Findings) -> tuple[float, float]:
    """Return the median timestamp bound in ms and the 95th percentile of the speed in m/s; NaN if unknown."""
    bounds = [s.bound_ns[np.isfinite(s.bound_ns)] for s in f.station_records]
    known = np.concatenate(bounds) if bounds else np.empty(0)
    speed_mps = np.empty(0) if f.distance_errors is None else f.distance_errors.motion.speed_mps
    speed_mps = speed_mps[np.isfinite(speed_mps)]
    return (
        float(np.median(known)) / 1e6 if len(known) else math.nan,
        float(np.percentile(speed_mps, 95)) if len(speed_mps) else math.nan,
    )


def _times(f: Findings) -> Iterator[Verdict]:
    bound_ms, fast_mps = bound_and_speed(f)
    if math.isnan(bound_ms):
        yield Verdict(
            Level.CARE,
            "The accuracy of the clock synchronisation is unknown: no timestamp bound was recorded.",
        )
    elif not math.isnan(fast_mps):
        bound_mm = bound_ms * fast_mps
        yield Verdict(
            Level.GOOD if bound_mm <= _BOUND_MM else Level.CARE,
            f"The median timestamp bound is {bound_ms:.2f} ms, which is {bound_mm:.1f} mm at {fast_mps:.1f} m/s (95th "
            "percentile of the speed).",
        )


def _distances(f: Findings) -> Iterator[Verdict]:
    if f.inter_prism is None:
        single = len(f.recording.parameters.prisms) == 1
        level = Level.CARE if single else Level.BAD
        yield Verdict(level, f"No inter-prism distances: {f.problems['inter_prism']}.")
        return
    measured = {prism for pair in f.inter_prism.dynamic for prism in pair.prisms}
    missing = [str(each.prism) for each in f.recording.parameters.prisms if each.prism not in measured]
    if missing:
        yield Verdict(
            Level.CARE,
            f"Prism {' and prism '.join(missing)} has no usable measurement; distances are those between the others.",
        )
    static = [pair.statistics() for pair in f.inter_prism.static if len(pair.distances_m)]
    moving = [pair.statistics() for pair in f.inter_prism.dynamic if len(pair.distances_m)]
    if not moving:
        yield Verdict(Level.BAD, "At no time were all prisms measured without a gap.")
        return
    if not static:
        why = "The robot was never stationary for some seconds"
        if f.odometry_stationary_ns:
            why = "According to the odometry, the robot was stationary before or after this recording only"
        elif f.odometry_stationary_ns is not None:
            why = "According to the odometry, the robot was never stationary for some seconds"
        yield Verdict(
            Level.CARE,
            f"{why}: there are no distances between standing prisms, which need no interpolation.",
            "Stop for some seconds now and then.",
        )
    moving_mm = float(np.mean([figures.mean_abs_error for figures in moving]))
    yield Verdict(
        Level.GOOD if moving_mm <= _MOVING_MM else Level.CARE,
        f"The measured distances between the prisms differ from the prism layout by {moving_mm:.1f} mm on average.",
    )


def _motion(f: Findings) -> Iterator[Verdict]:
    if f.continuous is not None and f.continuous.imu is None and not f.continuous.motion.tuned:
        yield Verdict(
            Level.CARE,
            "There are too few measurements to estimate motion prior and noise scale: both are those of the recording.",
            "Record longer than some seconds.",
        )


def _reference(f: Findings) -> Iterator[Verdict]:
    at = point_label(f.recording.parameters.reference_point)
    poses = f.poses
    shown = None if poses is None else Kind(poses.kind[0]).estimator
    any_compared = any(each.compared for each in f.reference_errors.values())
    for name, each in f.reference_errors.items():
        if not each.compared:
            if name == shown or not any_compared:  # the other one has no poses of fewer than three prisms
                yield Verdict(
                    Level.BAD,
                    f"No valid pose of {name} is within the time of the reference; nothing was compared.",
                    "Check that the reference is of this drive and on the same clock.",
                )
            continue
        consistent = math.isfinite(each.nees.mean) and _NEES[0] <= each.nees.mean <= _NEES[1]
        if consistent and name != shown:
            continue
        yield Verdict(
            Level.GOOD if consistent else Level.CARE,
            f"The error of {name} against the reference is {each.position_rms_mm:.1f} mm at {at}, "
            f"{each.centroid.position_rms_mm:.1f} mm at the prisms' centroid, and {each.orientation_rms_deg:.2f} degrees "
            "(rms, unaligned)"
            + (
                "; its covariances are consistent with that."
                if consistent
                else f"; its covariances are inconsistent with that (NEES {each.nees.mean:.1f}, expected 6)."
            ),
        )
    if "aligned" in f.problems:
        yield Verdict(
            Level.CARE,
            f"The poses are not aligned with the reference: {f.problems['aligned']}.",
            "Use `--align translation` or `--align none`: a rigid alignment needs a path that is not straight.",
        )
