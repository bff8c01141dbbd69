"""Initial values of a fit: time offset by correlation of motion, rotation of the sensor from rates and velocities."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from tsgt.errors import GeometryError
from tsgt.geometry import log_so3, rotate, rotation_from_quaternion

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.analysis.compare.interpolation import ReferenceTrajectory
    from tsgt.analysis.compare.trajectories import Estimate, ReferencePoses
    from tsgt.geometry import FloatArray

GRID_S = 0.05
MAX_GRID = 10_000_000  # Six days
BASELINE_NS = 180_000_000  # Differences over it: white noise of an estimate counts little, turns remain
MAX_BASELINE_NS = 1_100_000_000  # Estimates at 1 Hz
MIN_OVERLAP_S = 10.0  # Of both, for a correlation to mean anything
MIN_CORRELATION, CLEAR_CORRELATION = 0.3, 0.7
AMBIGUOUS_SHARE = 0.6  # Of the largest log-likelihood; of the right offset, others have less than half
REST_MPS, REST_RADPS = 0.03, 0.03  # Below, a motion may be noise of the reference
TURN_RATE_SIGMA_RADPS = 0.02
VELOCITY_SIGMA_MPS = 0.15  # A lever arm, not yet known, moves with the turn rate


@dataclass(frozen=True, slots=True)
class EstimateMotion:
    """Motion of an estimate at K instants, from differences over a baseline."""

    stamp_ns: NDArray[np.int64]  # (K,) on the estimate's clock, the middles
    velocity_mps: FloatArray  # (K, 3) along the sensor's axes; of positions alone, along the estimate's frame
    turn_rate_radps: FloatArray | None  # (K, 3) about the sensor's axes


def overlap_s(reference: ReferencePoses, estimate: Estimate, offset_s: float = 0.0) -> float:
    """Return for how long both were running, by their first and last stamps; negative: the time between them."""
    stamp_ns = reference.stamp_ns[reference.valid]
    if not len(stamp_ns) or not len(estimate.stamp_ns):
        return 0.0
    offset_ns = round(offset_s * 1e9)
    end_ns = min(int(stamp_ns[-1]), int(estimate.stamp_ns[-1]) + offset_ns)
    return (end_ns - max(int(stamp_ns[0]), int(estimate.stamp_ns[0]) + offset_ns)) / 1e9


def estimate_motion(estimate: Estimate) -> EstimateMotion:
    """Return the motion of an estimate, by differences of poses that are close enough in time."""
    stamp_ns = estimate.stamp_ns
    before = np.arange(len(stamp_ns))
    after = np.searchsorted(stamp_ns, stamp_ns + BASELINE_NS)
    near = after < len(stamp_ns)
    before, after = before[near], after[near]
    near = stamp_ns[after] - stamp_ns[before] <= MAX_BASELINE_NS
    before, after = before[near], after[near]
    step_ns = stamp_ns[after] - stamp_ns[before]
    step_s = (step_ns / 1e9)[:, None]
    velocity = (estimate.position_m[after] - estimate.position_m[before]) / step_s
    turn_rate = None
    if estimate.orientation_xyzw is not None:
        rotation = rotation_from_quaternion(estimate.orientation_xyzw)
        turn = log_so3(np.swapaxes(rotation[before], 1, 2) @ rotation[after])
        turn_rate = turn / step_s
        # Along the axes in the middle of the baseline.
        back = np.swapaxes(rotation[before], 1, 2)
        velocity = rotate(back, velocity)
        velocity = velocity - 0.5 * np.cross(turn, velocity)
    return EstimateMotion(stamp_ns[before] + step_ns // 2, velocity, turn_rate)


class OffsetSearchError(GeometryError):
    """No time offset was found, or none that is alone; ``finding`` says what was found instead."""

    def __init__(self, finding: str, remedy: str) -> None:
        super().__init__(f"{finding}: {remedy}")
        self.finding = finding


def offset_by_correlation(
    trajectory: ReferenceTrajectory, motion: EstimateMotion, start_s: float, max_offset_s: float
) -> float:
    """Return the time offset, in s, at which turn rates and speeds of estimate and reference agree best.

    Within ``max_offset_s`` of ``start_s``; this itself if both overlap for less than 10 s, or the robot stands. Norms need neither frame nor extrinsic.
    Masked normalised correlation (D. Padfield, 2012), so that gaps count as unknown; the best offset is the most likely one, as a
    correlation over a short overlap is more often high by chance. Raises OffsetSearchError: the motion agrees nowhere, or elsewhere, too.
    """
    start_ns = round(start_s * 1e9)
    if len(motion.stamp_ns) < 2:
        return start_s
    margin_ns = round(max_offset_s * 1e9)
    first_ns = max(trajectory.start_ns, int(motion.stamp_ns[0]) + start_ns - margin_ns)
    last_ns = min(trajectory.end_ns, int(motion.stamp_ns[-1]) + start_ns + margin_ns)
    if last_ns - first_ns < MIN_OVERLAP_S * 1e9:
        return start_s
    step_ns = round(GRID_S * 1e9)
    # What lies further from the reference than its length cannot be told from another drive.
    near_ns = margin_ns + trajectory.end_ns - trajectory.start_ns
    own_first_ns = max(int(motion.stamp_ns[0]) + start_ns, trajectory.start_ns - near_ns)
    own_last_ns = min(int(motion.stamp_ns[-1]) + start_ns, trajectory.end_ns + near_ns)
    if max(last_ns - first_ns, own_last_ns - own_first_ns) > MAX_GRID * step_ns:
        raise OffsetSearchError(
            f"the time offset cannot be searched over {(own_last_ns - own_first_ns) / 86_400e9:.0f} days",
            "remove poses with times of a wrong clock, or narrow the search with --max-offset-s",
        )
    grid_ns = first_ns + np.arange((last_ns - first_ns) // step_ns + 1) * step_ns
    own_ns = own_first_ns + np.arange((own_last_ns - own_first_ns) // step_ns + 1) * step_ns
    reference = trajectory.motion_at(grid_ns)
    at_rest = (
        np.quantile(each[reference.known], 0.99) < limit
        for each, limit in (
            (_norm(reference.velocity_mps), REST_MPS),
            (_norm(reference.angular_velocity_radps), REST_RADPS),
        )
    )
    if not reference.known.any() or all(at_rest):
        return start_s
    own_known, columns = _on_grid(motion, own_ns - start_ns)
    norms = [(_norm(reference.velocity_mps), columns[0])]
    if motion.turn_rate_radps is not None:
        norms.append((_norm(reference.angular_velocity_radps), columns[1]))
    correlations = [_masked_correlation(theirs, reference.known, own, own_known) for theirs, own in norms]
    # An estimate that flies away still turns as the robot does; one whose rotation is wrong still drives.
    shift, score, likelihood = max(correlations, key=lambda each: float(each[2].max()))
    order = np.argsort(shift)
    offset_s = start_s + (first_ns - own_first_ns) / 1e9 + shift[order] * GRID_S
    score, likelihood = score[order], likelihood[order]
    inside = np.where(np.abs(offset_s - start_s) <= max_offset_s + GRID_S, likelihood, 0.0)
    best, anywhere = int(np.argmax(inside)), int(np.argmax(likelihood))
    elsewhere = inside[best] < AMBIGUOUS_SHARE * likelihood[anywhere]
    if elsewhere and score[anywhere] >= CLEAR_CORRELATION:
        raise OffsetSearchError(
            f"its motion agrees best with the reference's at a time offset of {offset_s[anywhere]:.1f} s (correlation "
            f"{score[anywhere]:.2f}), more than the {max_offset_s:g} s that are searched",
            "is it of the same drive? if so, search further with --max-offset-s",
        )
    if elsewhere or score[best] < MIN_CORRELATION:
        raise OffsetSearchError(
            f"its motion agrees with the reference's at no time offset within {max_offset_s:g} s (correlation {score[best]:.2f})",
            "is it of the same drive? search further with --max-offset-s, or leave the offset out (--fit none)",
        )
    other = _second_peak(inside, best)
    if other is not None:
        raise OffsetSearchError(
            f"its motion agrees with the reference's about as well at a time offset of {offset_s[best]:.1f} s as at "
            f"{offset_s[other]:.1f} s (correlations {score[best]:.2f}, {score[other]:.2f})",
            "is it of the same drive? if so, narrow the search with --max-offset-s, or leave the offset out (--fit none)",
        )
    return float(offset_s[best]) + GRID_S * _vertex(score[max(best - 1, 0) : best + 2])


def _second_peak(likelihood: FloatArray, best: int) -> int | None:
    """Return another peak that is about as likely as the best; None if there is none."""
    low = likelihood < 0.5 * likelihood[best]
    before, after = np.flatnonzero(low[:best]), np.flatnonzero(low[best:])
    elsewhere = np.ones(len(likelihood), dtype=np.bool_)
    elsewhere[(before[-1] if len(before) else 0) : (best + after[0] if len(after) else len(low))] = False
    if not elsewhere.any():
        return None
    other = int(np.argmax(np.where(elsewhere, likelihood, -np.inf)))
    return other if likelihood[other] > AMBIGUOUS_SHARE * likelihood[best] else None


def _on_grid(
    motion: EstimateMotion, grid_ns: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], list[FloatArray]]:
    after = np.clip(np.searchsorted(motion.stamp_ns, grid_ns), 1, len(motion.stamp_ns) - 1)
    known = motion.stamp_ns[after] - motion.stamp_ns[after - 1] <= MAX_BASELINE_NS
    origin_ns = int(grid_ns[0])
    at, own = (grid_ns - origin_ns) / 1e9, (motion.stamp_ns - origin_ns) / 1e9
    columns = [np.interp(at, own, _norm(motion.velocity_mps))]
    if motion.turn_rate_radps is not None:
        columns.append(np.interp(at, own, _norm(motion.turn_rate_radps)))
    return known, columns


def _masked_correlation(
    a: FloatArray, a_known: NDArray[np.bool_], b: FloatArray, b_known: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Shifts L, Pearson's correlation of ``a[i + L]`` with ``b[i]``, -1 where little of both is known, and its log-likelihood.

    Against none, of normal numbers that are independent a second apart.
    """
    size = next_fast_len(len(a) + len(b))
    a = np.where(a_known, a - a[a_known].mean(), 0.0) if a_known.any() else np.zeros(len(a))
    b = np.where(b_known, b - b[b_known].mean(), 0.0) if b_known.any() else np.zeros(len(b))
    fa, fa2, fam = (rfft(x, size) for x in (a, a * a, a_known.astype(np.float64)))
    fb, fb2, fbm = (np.conj(rfft(x, size)) for x in (b, b * b, b_known.astype(np.float64)))

    def summed(x: NDArray[np.complex128], y: NDArray[np.complex128]) -> FloatArray:
        return np.asarray(irfft(x * y, size))

    count = np.maximum(np.rint(summed(fam, fbm)), 1.0)
    sum_a, sum_b = summed(fa, fbm), summed(fam, fb)
    covariance = summed(fa, fb) - sum_a * sum_b / count
    variance_a = summed(fa2, fbm) - sum_a**2 / count
    variance_b = summed(fam, fb2) - sum_b**2 / count
    least = 1e-9 * max(float((a * a).sum() * (b * b).sum()), 1e-300)
    product = variance_a * variance_b
    enough = (count * GRID_S >= max(MIN_OVERLAP_S, 0.2 * GRID_S * count.max())) & (product > least)
    correlation = np.where(enough, covariance / np.sqrt(np.where(enough, product, 1.0)), -1.0)
    shift = np.arange(size)
    clipped = np.clip(correlation, 0.0, 1.0 - 1e-9)
    likelihood = -0.5 * count * GRID_S * np.log1p(-(clipped**2))
    return np.where(shift < len(a), shift, shift - size), correlation, likelihood


def _vertex(values: FloatArray) -> float:
    """Where a parabola through three neighbours is highest, in steps from the middle."""
    if len(values) < 3 or values.min() <= -1.0:
        return 0.0
    before, middle, after = values.tolist()
    curvature = before - 2.0 * middle + after
    return 0.5 * (before - after) / curvature if curvature < 0 else 0.0


def extrinsic_rotation(
    trajectory: ReferenceTrajectory, motion: EstimateMotion, offset_s: float, *, any_scale: bool
) -> tuple[FloatArray, float] | None:
    """Return ``R_point_sensor``, (3, 3), and the scale, from turn rates and velocities along the axes of either.

    Wahba's problem by singular values; None without turn rates or motion. The lever arm is ignored.
    """
    if motion.turn_rate_radps is None or not len(motion.stamp_ns):
        return None
    reference = trajectory.motion_at(motion.stamp_ns + round(offset_s * 1e9))
    known = reference.known
    if np.count_nonzero(known) < 3:
        return None
    back = np.swapaxes(reference.rotation[known], 1, 2)
    rate = rotate(back, reference.angular_velocity_radps[known])
    velocity = rotate(back, reference.velocity_mps[known])
    own_rate, own_velocity = motion.turn_rate_radps[known], motion.velocity_mps[known]
    scale = 1.0
    if any_scale:
        speed, own_speed = _norm(velocity), _norm(own_velocity)
        moving = speed > 0.5 * np.median(speed)
        scale = (
            float(np.median(speed[moving] / np.maximum(own_speed[moving], 1e-12))) if moving.any() else 1.0
        )
        own_velocity = scale * own_velocity
    theirs = np.concatenate([rate / TURN_RATE_SIGMA_RADPS, velocity / VELOCITY_SIGMA_MPS])
    own = np.concatenate([own_rate / TURN_RATE_SIGMA_RADPS, own_velocity / VELOCITY_SIGMA_MPS])
    used = np.ones(len(own), dtype=np.bool_)
    R = np.eye(3)
    for _ in range(3):
        R = rotation_between(own[used], theirs[used])
        error = _norm(theirs - own @ R.T)
        # A part that went wrong must not turn the rest.
        used = error <= max(4.0 * float(np.median(error)), 1e-9)
    return R, scale


def rotation_between(source: FloatArray, target: FloatArray) -> FloatArray:
    """Return the rotation, (3, 3), that turns vectors, (N, 3), closest to others (W. Kabsch, 1976)."""
    u, _, vt = np.linalg.svd(source.T @ target)
    sign = math.copysign(1.0, float(np.linalg.det(u) * np.linalg.det(vt)))
    return np.asarray((vt.T * (1.0, 1.0, sign)) @ u.T)


def _norm(vectors: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt((vectors**2).sum(axis=1)))
