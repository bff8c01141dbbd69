"""What is wrong with an estimate before any fit: its times, its units, its quaternions; each finding is one line with the way out.

Order and repeated times are repaired when a file is read, with a note in the estimate. Here nothing is repaired.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Literal

import numpy as np

from tsgt.analysis.compare.interpolation import ReferenceTrajectory
from tsgt.errors import DegenerateGeometryError
from tsgt.geometry import align, log_so3, rotation_from_quaternion

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.analysis.compare.trajectories import Estimate, ReferencePoses
    from tsgt.geometry import FloatArray

FIRST_UNIX_NS = 100_000_000_000_000_000
"""1973: earlier times count from the start of a program or of a computer."""

_MIN_OVERLAP_S = 10.0
_SMALL_SHARE = 0.5  # Of the longer of both; less overlap is a warning
_ZONE_S, _MAX_ZONE_S = 1800.0, 14.5 * 3600.0  # Time zones differ by multiples of half an hour
_CONSTANT_M, _MOVING_M = 1e-3, 0.1
_STEP_S, _MIN_STEP_M, _INTERPOLATED_STEPS = 1.0, 0.02, 10
_MILLI, _SCALE = (500.0, 2000.0), 2.0
_SAMPLES = 500
_WRONG_ORDER_RAD, _ORDER_RATIO = np.radians(15.0), 3.0


@dataclass(frozen=True, slots=True)
class InputFinding:
    """Something about an estimate that makes comparing impossible (``error``) or doubtful (``warning``)."""

    severity: Literal["error", "warning"]
    code: Literal[
        "relative_times", "no_overlap", "small_overlap", "constant", "unit", "scale", "quaternion_order"
    ]
    text: str


def input_findings(
    reference: ReferencePoses,
    estimate: Estimate,
    *,
    offset_s: float = 0.0,
    max_offset_s: float = 0.0,
    scale_fitted: bool = False,
) -> tuple[InputFinding, ...]:
    """Check times, motion and unit of an estimate; the first errors first.

    ``offset_s``: time on the reference's clock less that of the estimate, as far as it is known; it is searched within
    ``max_offset_s``. With ``scale_fitted`` the unit of the positions is of no importance.
    """
    found = [_time_finding(reference, estimate, offset_s, max_offset_s), _motion_finding(reference, estimate)]
    if not scale_fitted and found[1] is None:
        found.append(_unit_finding(reference, estimate))
    return tuple(
        sorted((each for each in found if each is not None), key=lambda each: each.severity == "warning")
    )


def relative_offset_s(reference: ReferencePoses, estimate: Estimate) -> tuple[float, float] | None:
    """Return where to search the offset of an estimate whose times are no Unix times, in s: centre and half width.

    None if its times are of the same kind as those of the reference.
    """
    (start, end), (own_start, own_end) = _span(reference), _ends(estimate.stamp_ns)
    if (own_end < FIRST_UNIX_NS) == (end < FIRST_UNIX_NS):
        return None
    half_ns = (end - start + own_end - own_start) / 2.0
    centre_ns = (start + end) // 2 - (own_start + own_end) // 2
    return centre_ns / 1e9, max(half_ns / 1e9 - _MIN_OVERLAP_S, 0.0)


def quaternion_finding(reference: ReferencePoses, estimate: Estimate, offset_s: float) -> InputFinding | None:
    """Check the order of the quaternions' components, once the time offset is known.

    Positions alone determine the rotation between both frames (rigid alignment). Then the rotation between sensor and robot is
    constant with the right order only. The angle between consecutive poses is the same in any order and tells nothing.
    """
    if estimate.orientation_xyzw is None:
        return None
    rows = np.unique(np.linspace(0, len(estimate.stamp_ns) - 1, _SAMPLES).astype(np.intp))
    motion = ReferenceTrajectory(reference).motion_at(estimate.stamp_ns[rows] + round(1e9 * offset_s))
    rows = rows[motion.known]
    try:
        turn = align(estimate.position_m[rows], motion.position_m[motion.known]).rotation
    except DegenerateGeometryError:
        return None
    to_reference = np.swapaxes(motion.rotation[motion.known], 1, 2) @ turn
    quaternion = estimate.orientation_xyzw[rows]
    given = _spread_rad(to_reference @ rotation_from_quaternion(quaternion))
    others = {
        "w first": _spread_rad(to_reference @ rotation_from_quaternion(quaternion[:, [1, 2, 3, 0]])),
        "w last": _spread_rad(to_reference @ rotation_from_quaternion(quaternion[:, [3, 0, 1, 2]])),
    }
    order, other = min(others.items(), key=lambda each: each[1])
    if given < _WRONG_ORDER_RAD or other > given / _ORDER_RATIO:
        return None
    return InputFinding(
        "error",
        "quaternion_order",
        f"the quaternions are in the wrong order: as read, the rotation differs from the reference by "
        f"{np.degrees(given):.0f} degrees, with {order} by {np.degrees(other):.1f}; reorder the columns, or name them",
    )


def _time_finding(
    reference: ReferencePoses, estimate: Estimate, offset_s: float, max_offset_s: float
) -> InputFinding | None:
    (start, end), (own_start, own_end) = _span(reference), _ends(estimate.stamp_ns + round(1e9 * offset_s))
    overlap_s = (min(end, own_end) - max(start, own_start)) / 1e9
    length_s, own_length_s = (end - start) / 1e9, (own_end - own_start) / 1e9
    if overlap_s <= 0.0:
        if relative_offset_s(reference, estimate) is not None:
            return InputFinding(
                "warning",
                "relative_times",
                "the times are no Unix times: they count from the start of a program; the offset is searched wherever both "
                "overlap, and a wrong one may fit",
            )
        if max_offset_s >= _MIN_OVERLAP_S - overlap_s:
            return InputFinding(
                "warning",
                "no_overlap",
                f"no overlap in time as stamped, they are {-overlap_s:.0f} s apart: the offset is searched within "
                f"{max_offset_s:g} s",
            )
        return InputFinding(
            "error",
            "no_overlap",
            f"no overlap in time: the estimate covers {_period(own_start, own_end)}, the reference {_period(start, end)} "
            f"(UTC){_zone_hint(own_start - start, min(length_s, own_length_s))}",
        )
    if overlap_s < _SMALL_SHARE * max(length_s, own_length_s):
        return InputFinding(
            "warning",
            "small_overlap",
            f"only {overlap_s:.0f} s of overlap: the estimate lasts {own_length_s:.0f} s, the reference {length_s:.0f} s",
        )
    return None


def _zone_hint(difference_ns: int, shorter_s: float) -> str:
    difference_s = difference_ns / 1e9
    zone_s = round(difference_s / _ZONE_S) * _ZONE_S
    if zone_s == 0.0 or abs(zone_s) > _MAX_ZONE_S or abs(difference_s - zone_s) > max(shorter_s, 60.0):
        return ""
    return f"; they differ by about {zone_s / 3600.0:+.1f} h: is one of them in local time?"


def _motion_finding(reference: ReferencePoses, estimate: Estimate) -> InputFinding | None:
    extent_m = float(np.ptp(estimate.position_m, axis=0).max())
    reference_m = float(np.ptp(reference.T_station1_point[reference.valid, :3, 3], axis=0).max())
    if extent_m > _CONSTANT_M or reference_m < _MOVING_M:
        return None
    return InputFinding(
        "error",
        "constant",
        f"the position never changes by more than {1e3 * extent_m:.3g} mm, while the reference moves over {reference_m:.1f} m",
    )


def _unit_finding(reference: ReferencePoses, estimate: Estimate) -> InputFinding | None:
    position_m = reference.T_station1_point[reference.valid, :3, 3]
    step_m = _typical_step_m(reference.stamp_ns[reference.valid], position_m)
    own_step_m = _typical_step_m(estimate.stamp_ns, estimate.position_m)
    if step_m < _MIN_STEP_M or own_step_m == 0.0:
        return None
    ratio = own_step_m / step_m
    for factor, name in ((ratio, "millimetres"), (1.0 / ratio, "kilometres")):
        if _MILLI[0] < factor < _MILLI[1]:
            return InputFinding(
                "error",
                "unit",
                f"the estimate moves {_factor(ratio)} times as fast as the reference: its positions seem to be in {name}; convert "
                "them to metres, or fit the scale (--fit scale)",
            )
    if max(ratio, 1.0 / ratio) > _SCALE:
        return InputFinding(
            "warning",
            "scale",
            f"the estimate moves {_factor(ratio)} times as fast as the reference: if it has no scale (monocular), fit it "
            "(--fit scale)",
        )
    return None


def _factor(ratio: float) -> str:
    return f"{ratio:.0f}" if ratio >= 10.0 else f"{ratio:.2g}"


def _typical_step_m(stamp_ns: NDArray[np.int64], position_m: FloatArray) -> float:
    """Return the distance covered in a second, exceeded in a quarter of all seconds; what runs away at the end has no say."""
    time_s = (stamp_ns - stamp_ns[0]) / 1e9
    # Seconds with poses and those behind them: a single time of a wrong clock may be 50 years away.
    grid_s = np.unique(np.floor(time_s))[:, None] + _STEP_S * np.arange(_INTERPOLATED_STEPS)
    grid_s = np.unique(grid_s[grid_s < time_s[-1]])
    steps = np.diff(np.column_stack([np.interp(grid_s, time_s, axis) for axis in position_m.T]), axis=0)
    steps = steps[np.diff(grid_s) == _STEP_S]
    return float(np.percentile(np.linalg.norm(steps, axis=1), 75)) if len(steps) else 0.0


def _spread_rad(rotation: FloatArray) -> float:
    """Return the root mean square of the angles of rotations, (N, 3, 3), from their chordal mean."""
    u, _, vt = np.linalg.svd(rotation.mean(axis=0))
    mean = u @ np.diag([1.0, 1.0, float(np.linalg.det(u @ vt))]) @ vt
    return float(np.sqrt((log_so3(mean.T @ rotation) ** 2).sum(axis=1).mean()))


def _span(reference: ReferencePoses) -> tuple[int, int]:
    return _ends(reference.stamp_ns[reference.valid])


def _ends(stamp_ns: NDArray[np.int64]) -> tuple[int, int]:
    return int(stamp_ns[0]), int(stamp_ns[-1])


def _period(start_ns: int, end_ns: int) -> str:
    first, last = (datetime.fromtimestamp(stamp_ns / 1e9, UTC) for stamp_ns in (start_ns, end_ns))
    return f"{first:%Y-%m-%d %H:%M:%S} to {last:%Y-%m-%d %H:%M:%S}"
