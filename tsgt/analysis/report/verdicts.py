"""What of a recording can be trusted, and what to look at. Pure.

The limits are for guidance: they are what a set-up in order keeps to, with room.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.report.findings import position_sigma_mm
from tsgt.estimation import Kind

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tsgt.analysis.report.findings import Findings

_VALID_SHARE = 0.95
_IN_GAPS = 0.05
_STATIC_BIAS_MM = 3.0
_MOVING_MM = 10.0
_SIGMA_MM = 10.0
_TIMING_SHARE = 2.0
_BOUND_MM = 3.0
_RESIDUAL_MEAN = 0.5
_RESIDUAL_STD = 1.5
_NOISE_SCALE = (0.5, 2.0)
_OUTLIERS = 0.01
_LEAST_RESIDUALS = 30
_NEES = (3.0, 12.0)


class Level(StrEnum):
    """How good it is."""

    GOOD = "good"
    CARE = "take care"
    BAD = "do not trust"


@dataclass(frozen=True, slots=True)
class Verdict:
    """One thing to know, in a sentence that says what to do."""

    level: Level
    text: str


def verdicts(findings: Findings) -> list[Verdict]:
    """Judge what was found, the worst first."""
    found = [
        *_poses(findings),
        *_stations(findings),
        *_times(findings),
        *_distances(findings),
        *_residuals(findings),
        *_reference(findings),
    ]
    order = (Level.BAD, Level.CARE, Level.GOOD)
    return sorted(found, key=lambda verdict: order.index(verdict.level))


def _poses(f: Findings) -> Iterator[Verdict]:
    failed = [name for name in ("continuous", "linear") if name in f.problems]
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
        # Rounded down: 100.0 % is all of them.
        f"{math.floor(1e3 * share) / 10:.1f}% of the poses of {estimator} are valid"
        f"{f' (not valid: {why})' if why else ''}. Use no other.",
    )
    sigma_mm = position_sigma_mm(poses)
    yield Verdict(
        Level.GOOD if np.median(sigma_mm) <= _SIGMA_MM else Level.CARE,
        f"The valid poses state {np.median(sigma_mm):.1f} mm (median) and "
        f"{np.percentile(sigma_mm, 95):.1f} mm (95 %) as the sigma of their position per axis; an error that all "
        "prisms share, as of a station's frame, is not in it.",
    )


def _stations(f: Findings) -> Iterator[Verdict]:
    limit_s = f.recording.parameters.pipeline.outage_limit_ns / 1e9
    for number, each in f.station_statistics.items():
        if not each.usable:
            yield Verdict(Level.BAD, f"Station {number} has no usable measurement.")
        elif each.in_gaps > _IN_GAPS:
            yield Verdict(
                Level.CARE,
                f"Station {number} has {each.gaps} gap{'s' * (each.gaps > 1)} longer than {limit_s:g} s, {each.in_gaps:.0%} of "
                f"the time; the longest lasts {each.longest_gap_s:.1f} s.",
            )
    if f.log.authenticated is False:
        yield Verdict(
            Level.CARE, "The radio was not authenticated: nobody can say whether somebody else has sent."
        )


def bound_and_speed(f: Findings) -> tuple[float, float]:
    """Median bound of the stamps in ms, and the speed in m/s below which the robot is 95 % of the time; NaN: not known."""
    bounds = [s.bound_ns[np.isfinite(s.bound_ns)] for s in f.stations]
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
            Level.CARE, "No bound of the time stamps was recorded; how well the clocks agreed is not known."
        )
    elif not math.isnan(fast_mps):
        reach_mm = bound_ms * fast_mps
        yield Verdict(
            Level.GOOD if reach_mm <= _BOUND_MM else Level.CARE,
            f"Stamps are within {bound_ms:.2f} ms (median bound): {reach_mm:.1f} mm at {fast_mps:.1f} m/s (95 % of the "
            "speed).",
        )


def _distances(f: Findings) -> Iterator[Verdict]:
    if f.inter_prism is None:
        yield Verdict(Level.BAD, f"Distances between prisms: {f.problems['inter_prism']}.")
        return
    standing = [pair.statistics() for pair in f.inter_prism.static if len(pair.distances_m)]
    moving = [pair.statistics() for pair in f.inter_prism.dynamic if len(pair.distances_m)]
    if not moving:
        yield Verdict(Level.BAD, "At no time were all prisms measured without a gap.")
        return
    if not standing:
        why = "The robot never stood still for 3 s"
        if f.odometry_ns:
            why = "By the odometry, the robot stood still before or after this recording only"
        elif f.odometry_ns is not None:
            why = "By the odometry, the robot never stood still for 3 s"
        yield Verdict(
            Level.CARE,
            f"{why}: errors of layout, frames and prism constants cannot be told from those of time.",
        )
    for pair in f.inter_prism.static:
        figures = pair.statistics()
        bias_mm = figures.mean - figures.reference
        if abs(bias_mm) > _STATIC_BIAS_MM:
            yield Verdict(
                Level.CARE,
                f"Standing still, the distance {pair.name} is {bias_mm:+.1f} mm off the layout: look at the prism "
                "layout, the prism constants, the stations' frames.",
            )
    moving_mm = float(np.mean([figures.mean_abs_error for figures in moving]))
    yield Verdict(
        Level.GOOD if moving_mm <= _MOVING_MM else Level.CARE,
        f"On average, distances between prisms are {moving_mm:.1f} mm off over the whole way.",
    )
    if standing:
        standing_mm = float(np.mean([figures.std for figures in standing]))
        spread_mm = float(np.mean([figures.std for figures in moving]))
        if spread_mm > _TIMING_SHARE * standing_mm:
            yield Verdict(
                Level.CARE,
                f"Distances between prisms spread {spread_mm:.1f} mm over the whole way, and {standing_mm:.1f} mm standing still: the "
                "rest comes from straight lines between measurements, from stamps and latencies (`tsgt calibrate motion`).",
            )


def _residuals(f: Findings) -> Iterator[Verdict]:
    if f.continuous is None:
        return
    scale = f.continuous.motion.noise_scale
    if not f.continuous.motion.tuned:
        yield Verdict(
            Level.CARE,
            "The measurements are too few to tell how the robot moves and how much they scatter: both are as recorded.",
        )
    elif not _NOISE_SCALE[0] <= scale <= _NOISE_SCALE[1]:
        yield Verdict(
            Level.CARE, f"The measurements scatter by {scale:.2g} times what the instruments' noise says."
        )
    judged = [each for axes in f.residuals.values() for each in axes.values() if each.n >= _LEAST_RESIDUALS]
    strange = [
        f"station {station} {axis.replace('_', ' ')} (mean {each.mean:+.1f}, std {each.std:.1f})"
        for station, axes in f.residuals.items()
        for axis, each in axes.items()
        if each.n >= _LEAST_RESIDUALS and (abs(each.mean) > _RESIDUAL_MEAN or each.std > _RESIDUAL_STD)
    ]
    if strange:
        yield Verdict(
            Level.CARE,
            f"Residuals are not what noise makes: {', '.join(strange)}. A mean is a frame or a latency.",
        )
    elif judged:
        yield Verdict(Level.GOOD, "The residuals of all stations are what their noise makes.")
    n = len(f.continuous.sources)
    if len(f.outliers) > _OUTLIERS * n:
        yield Verdict(
            Level.CARE, f"{len(f.outliers)} of {n} measurements stray too far to be noise; see the residuals."
        )


def _reference(f: Findings) -> Iterator[Verdict]:
    for name, each in f.compared.items():
        if not each.compared:
            yield Verdict(
                Level.BAD, f"No valid pose of {name} lies in the time of the reference; nothing was compared."
            )
            continue
        honest = math.isfinite(each.nees.mean) and _NEES[0] <= each.nees.mean <= _NEES[1]
        yield Verdict(
            Level.GOOD if honest else Level.CARE,
            f"Against the reference, {name} is off by {each.position_rms_mm:.1f} mm and "
            f"{each.orientation_rms_deg:.2f} degrees (rms, unaligned)"
            + (
                "; its covariances fit that."
                if honest
                else f"; its covariances do not fit that (NEES {each.nees.mean:.1f} instead of 6)."
            ),
        )
