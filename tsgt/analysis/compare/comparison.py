"""Comparison of an estimate with the reference: fit, errors, and what each fitted quantity hides."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tsgt.analysis.compare.alignment import OffsetSearchError, fit, nested_fits
from tsgt.analysis.compare.alignment.uncertainty import WEAK_SIGMA
from tsgt.analysis.compare.assessment import MIN_POSES, Assessment, assess, paired
from tsgt.analysis.compare.checks import input_findings, quaternion_finding, relative_offset_s
from tsgt.analysis.compare.errors import JudgedErrors, absolute
from tsgt.analysis.compare.pairing import Pairing
from tsgt.analysis.compare.relation import FitSettings, initial_relation
from tsgt.errors import GeometryError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from tsgt.analysis.compare.relation import Fit, FittedPart, Relation
    from tsgt.analysis.compare.trajectories import Estimate, ReferencePoses
    from tsgt.geometry import FloatArray

PART_NAMES: dict[FittedPart, str] = {
    "offset": "time offset",
    "skew": "clock skew",
    "extrinsic": "extrinsic",
    "scale": "scale",
}
NEGLIGIBLE_SHARE = 0.05  # A quantity that changes the error by less is not needed
_FAIR_PARTS: frozenset[FittedPart] = frozenset({"offset", "skew", "extrinsic", "frame"})


@dataclass(frozen=True, slots=True)
class FitStep:
    """Absolute errors with one set of fitted quantities."""

    settings: FitSettings
    fit: Fit
    ate: JudgedErrors

    @property
    def label(self) -> str:
        """What is fitted, in words."""
        names = [name for part, name in PART_NAMES.items() if part in self.settings.parts]
        alignment = {"start": "alignment at the start", "yaw": "alignment over all by yaw and position"}
        if "frame" in self.settings.parts and self.settings.align != "none":
            names.append(alignment.get(self.settings.align, "alignment over all"))
        return ", ".join(names) or "nothing"

    @property
    def fair(self) -> bool:
        """Whether only clock, extrinsic and starting pose are fitted, which say nothing about the quality of an estimate."""
        return self.settings.parts <= _FAIR_PARTS and self.settings.align in ("none", "start")

    def keys(self) -> dict[str, Any]:
        """Return the figures for ``--json``."""
        return {
            "fit": sorted(self.settings.parts),
            "align": self.settings.align if "frame" in self.settings.parts else "none",
            "fair": self.fair,
            "position_rms_mm": self.ate.errors.position_mm.rms,
            "orientation_rms_deg": self.ate.errors.orientation_deg.rms,
        }


@dataclass(frozen=True, slots=True)
class Comparison:
    """An estimate against the reference.

    Attributes
    ----------
    settings, fit, errors : What was asked for: the headline.
    steps : Growing sets of fitted quantities, from none (unless both overlap by a fitted offset only) to all.
    smallest_fair : Index of the smallest fair set in ``steps``.
    relative_times : Whether its times are no Unix times: the offset is that of this drive alone.
    warnings : What is doubtful about the estimate's times and units.
    """

    estimate: Estimate
    settings: FitSettings
    fit: Fit
    errors: Assessment
    steps: tuple[FitStep, ...]
    smallest_fair: int
    relative_times: bool
    warnings: tuple[str, ...]

    @property
    def name(self) -> str:
        """Name of the estimate."""
        return self.estimate.name

    @property
    def fully_aligned(self) -> FitStep:
        """With everything fitted that the motion determines."""
        return self.steps[-1]

    def sigma(self, *names: str) -> FloatArray:
        """Return the sigmas of fitted unknowns by their names in ``Fit.names``; NaN of what was not fitted."""
        sigma = dict(
            zip(self.fit.names, np.sqrt(np.maximum(np.diag(self.fit.covariance), 0.0)).tolist(), strict=True)
        )
        return np.array([sigma.get(name, math.nan) for name in names])

    @property
    def extrinsic_sigma(self) -> FloatArray:
        """Sigmas of position (m) and rotation (rad) in the axes of the reference's point, (6,)."""
        return self.sigma(*_components("extrinsic"))

    @property
    def unobservable(self) -> tuple[str, ...]:
        """What the motion does not determine, of all that could be fitted."""
        return tuple(dict.fromkeys((*self.fit.unobservable, *self.fully_aligned.fit.unobservable)))

    @property
    def weakly_determined(self) -> dict[str, float]:
        """Sigmas, in s, m and rad, of what the motion determines, but not within 1 ms, 5 mm or 0.1 degrees at two sigmas."""
        found: dict[str, float] = {}
        for each in (self.fit, self.fully_aligned.fit):
            sigmas = np.sqrt(np.maximum(np.diag(each.covariance), 0.0)).tolist()
            found = {
                **{n: s for n, s in zip(each.names, sigmas, strict=True) if s > WEAK_SIGMA.get(n, math.inf)},
                **found,
            }
        return found

    def keys(self) -> dict[str, Any]:
        """Return the figures for ``--json``."""
        relation = self.fit.relation
        extrinsic, frame = self.extrinsic_sigma, self.sigma(*_components("frame"))
        return {
            "source": self.estimate.source,
            "notes": [*self.estimate.notes, *self.warnings],
            "fit": sorted(self.settings.parts),
            "align": self.settings.align if "frame" in self.settings.parts else "none",
            "offset_ms": 1e3 * relation.offset_s,
            "offset_sigma_ms": 1e3 * float(self.sigma("offset_s")[0]),
            "skew_ppm": 1e6 * relation.skew,
            "skew_sigma_ppm": 1e6 * float(self.sigma("skew")[0]),
            "scale": relation.scale,
            "scale_sigma": float(self.sigma("scale")[0]),
            "extrinsic": relation.T_point_sensor.tolist(),
            "extrinsic_sigma_mm": (1e3 * extrinsic[:3]).tolist(),
            "extrinsic_sigma_deg": np.degrees(extrinsic[3:]).tolist(),
            "frame": relation.T_station1_frame.tolist(),
            "frame_sigma_mm": (1e3 * frame[:3]).tolist(),
            "frame_sigma_deg": np.degrees(frame[3:]).tolist(),
            "unobservable": list(self.unobservable),
            "weakly_determined": list(self.weakly_determined),
            "ate_fit_sigma_mm": 1e3 * self.fit.ate_sigma_m,
            "outliers": int(len(self.errors.pairs.row) - np.count_nonzero(self.fit.used)),
            **self.errors.keys(),
            "aligned": {
                "fit": sorted(self.fully_aligned.settings.parts),
                "offset_ms": 1e3 * self.fully_aligned.fit.relation.offset_s,
                "extrinsic": self.fully_aligned.fit.relation.T_point_sensor.tolist(),
                "ate_fit_sigma_mm": 1e3 * self.fully_aligned.fit.ate_sigma_m,
                **self.fully_aligned.ate.keys(),
            },
            "steps": [each.keys() for each in self.steps],
            "smallest_fair_set": self.steps[self.smallest_fair].keys(),
        }


def reference_keys(reference: ReferencePoses) -> dict[str, Any]:
    """Return what the reference is for ``--json``."""
    point = reference.point
    return {
        "point": {
            "name": point.name,
            "position_m": list(point.position_m),
            "orientation_xyzw": list(point.orientation_xyzw),
        },
        "poses": len(reference.stamp_ns),
        "valid_poses": int(np.count_nonzero(reference.valid)),
        "start_ns": int(reference.stamp_ns[0]),
        "end_ns": int(reference.stamp_ns[-1]),
        "has_covariance": reference.covariance is not None,
    }


def _components(part: str) -> list[str]:
    return [f"{part}_{name}" for name in ("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad")]


def compare_estimate(
    reference: ReferencePoses,
    estimate: Estimate,
    settings: FitSettings | None = None,
    *,
    start: Relation | None = None,
    max_sigma_m: float | None = None,
) -> Comparison:
    """Compare an estimate with the reference.

    Parameters
    ----------
    settings
        What is fitted; by default the time offset and the alignment at the start.
    start
        What holds where nothing is fitted; by default clock, frame and point of the reference.
    max_sigma_m
        Instants at which the sensor's position by the reference is less certain are left out.

    Raises
    ------
    GeometryError
        The estimate cannot be compared: both do not overlap in time, it does not move, its unit or its quaternions are wrong.
    """
    settings = FitSettings() if settings is None else settings
    settings, start, warnings = _checked(
        reference, estimate, settings, initial_relation() if start is None else start
    )
    everything = replace(
        settings,
        parts=settings.parts | {"offset", "extrinsic", "frame"},
        align="yaw" if settings.align == "yaw" else "rigid",
    )
    try:
        try:
            nested = nested_fits(reference, estimate, everything, start)
        except OffsetSearchError as problem:
            if "offset" in settings.parts:
                raise
            everything = replace(everything, parts=everything.parts - {"offset"})
            nested = nested_fits(reference, estimate, everything, start)
            warnings += (f"compared at the times of its stamps, but {problem.finding}",)
    except ValueError as problem:  # as a GeometryError is, too
        raise GeometryError(str(problem)) from problem
    wrong = quaternion_finding(reference, estimate, nested[-1][1].relation.offset_s)
    if wrong is not None and wrong.severity == "error":
        raise GeometryError(wrong.text)
    pairing = Pairing(reference, estimate, max_sigma_m=max_sigma_m)
    if not nested[0][0].parts and np.count_nonzero(nested[0][1].used) < MIN_POSES:
        nested = nested[1:]  # as stamped, both hardly overlap
    steps = tuple(_step(pairing, own, found) for own, found in nested)
    same = [each.fit for each in steps if _set(each.settings) == _set(settings)]
    chosen = same[0] if same else fit(reference, estimate, settings, start)
    return Comparison(
        estimate=estimate,
        settings=settings,
        fit=chosen,
        errors=assess(
            pairing,
            chosen.relation,
            aligned=_is_aligned(settings),
            fair=[each.fit.relation for each in steps if each.fair][-1],
        ),
        steps=steps,
        smallest_fair=_smallest_fair(steps),
        relative_times=relative_offset_s(reference, estimate) is not None,
        warnings=warnings,
    )


def _checked(
    reference: ReferencePoses, estimate: Estimate, settings: FitSettings, start: Relation
) -> tuple[FitSettings, Relation, tuple[str, ...]]:
    """Check the estimate; return where to search its offset, and what is doubtful."""
    warnings: list[str] = []
    relative = relative_offset_s(reference, estimate)
    if relative is not None and "offset" in settings.parts and not start.offset_s:
        centre_s, half_s = relative
        settings, start = replace(settings, max_offset_s=half_s), replace(start, offset_s=centre_s)
        warnings.append("its times are no Unix times; the offset was searched wherever both overlap")
    findings = input_findings(
        reference,
        estimate,
        offset_s=start.offset_s,
        max_offset_s=settings.max_offset_s if "offset" in settings.parts else 0.0,
        scale_fitted="scale" in settings.parts,
    )
    for each in findings:
        if each.severity == "error":
            raise GeometryError(each.text)
        warnings.append(each.text)
    return settings, start, tuple(warnings)


def compare_estimates(
    reference: ReferencePoses,
    estimates: Sequence[Estimate],
    settings: FitSettings | None = None,
    *,
    starts: Iterable[Relation | None] | None = None,
    max_sigma_m: float | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> list[Comparison]:
    """Compare several estimates with the reference, each as :func:`compare_estimate` does."""
    found = []
    begun = [None] * len(estimates) if starts is None else list(starts)
    for number, (estimate, start) in enumerate(zip(estimates, begun, strict=True), start=1):
        found.append(compare_estimate(reference, estimate, settings, start=start, max_sigma_m=max_sigma_m))
        if on_progress is not None:
            on_progress(number / len(estimates))
    return found


def _set(settings: FitSettings) -> tuple[frozenset[FittedPart], str]:
    return settings.parts, settings.align if "frame" in settings.parts else "none"


def _is_aligned(settings: FitSettings) -> bool:
    return "frame" in settings.parts and settings.align != "none"


def _step(pairing: Pairing, settings: FitSettings, found: Fit) -> FitStep:
    return FitStep(settings, found, absolute(paired(pairing, found.relation), aligned=_is_aligned(settings)))


def _smallest_fair(steps: Sequence[FitStep]) -> int:
    """Return the first fair step whose errors no later fair step reduces by more than a negligible share.

    An error below the reference's resolution needs no further reduction.
    """
    fair = [row for row, each in enumerate(steps) if each.fair]
    for row in fair:
        own = steps[row].ate
        later = [steps[other].ate.errors for other in fair if other > row]
        position = own.position_below_resolution or all(
            each.position_mm.rms >= (1 - NEGLIGIBLE_SHARE) * own.errors.position_mm.rms for each in later
        )
        orientation = own.orientation_below_resolution or not any(
            each.orientation_deg.rms < (1 - NEGLIGIBLE_SHARE) * own.errors.orientation_deg.rms
            for each in later
        )
        if position and orientation:
            return row
    return fair[-1]
