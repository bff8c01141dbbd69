"""Findings on the calibration from targets that a recording carries: bad targets, instrument errors that it corrected. Sans-I/O."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from tsgt.analysis.diagnosis.finding import TARGETS, Finding
from tsgt.geometry.motion_calibration import SetupCause
from tsgt.model import ARCSECOND_RAD

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tsgt.model import Parameters, SetupCovariance, StationParameters

LARGE_INSTRUMENT_ERROR_RAD = 15.0 * ARCSECOND_RAD  # Beyond three times what data sheets allow
MIN_TARGETS = 6
_LARGE = 5.0  # Times the median residual, beyond which a target does not fit the others
_LARGE_M = 0.006


def calibration_findings(parameters: Parameters) -> list[Finding]:
    """Return findings on targets and on corrected instrument errors."""
    return [*_targets(parameters.stations), *_corrected(parameters)]


def _targets(stations: Iterable[StationParameters]) -> list[Finding]:
    bad: dict[int, dict[int, float]] = {}  # by target and station, in m
    kept: set[int] = set()
    for station in stations:
        residuals = sorted(each.residual_m for each in station.targets if each.residual_m is not None)
        usual = residuals[len(residuals) // 2] if len(residuals) >= MIN_TARGETS else math.inf
        for each in station.targets:
            size_m = max(each.residual_m or 0.0, each.leave_one_out_m or 0.0)
            if each.residual_m is None or (size_m > _LARGE_M and each.residual_m > _LARGE * usual):
                bad.setdefault(each.target, {})[station.station] = size_m
                if each.residual_m is not None:
                    kept.add(each.target)
    if not bad:
        return []
    numbers = ", ".join(map(str, sorted(bad)))
    largest_mm = 1e3 * max(max(by_station.values()) for by_station in bad.values())
    seen = sorted({station for by_station in bad.values() for station in by_station})
    plural = len(bad) > 1
    return [
        Finding(
            cause=TARGETS,
            where=f"target{'s' * plural} {numbers}",
            size=largest_mm,
            sigma=math.nan,
            unit="mm",
            effect_mm=0.0,
            confidence=0.99,
            text=f"Target{'s' * plural} {numbers} contradict{'s' * (not plural)} the others by up to {largest_mm:.0f} mm, as seen by "
            f"station{'s' * (len(seen) > 1)} {' and '.join(map(str, seen))}"
            + ("." if kept else "; the frames were solved without."),
            repair=f"Solve the frames without: `tsgt calibrate targets TARGETS --exclude {','.join(map(str, sorted(kept)))}`."
            if kept
            else "Nothing for this drive. Before the next one look whether a target has moved or was confused with another.",
            evidence={
                str(target): {str(s): 1e3 * v for s, v in by_station.items()}
                for target, by_station in sorted(bad.items())
            },
        )
    ]


def _corrected(parameters: Parameters) -> list[Finding]:
    found = []
    for station in parameters.stations:
        for cause, name, error_rad in (
            (SetupCause.VERTICAL_INDEX, "vertical index error", station.vertical_index_rad),
            (SetupCause.COLLIMATION, "collimation error", station.collimation_rad),
        ):
            if abs(error_rad) < LARGE_INSTRUMENT_ERROR_RAD:
                continue
            sigma_rad = _sigma(parameters.setup_covariance, f"station{station.station}.{cause}")
            stated = f"{1e3 * error_rad:+.2f}" + (
                "" if math.isnan(sigma_rad) else f" ± {1e3 * sigma_rad:.1g}"
            )
            found.append(
                Finding(
                    cause=str(cause),
                    where=f"station {station.station}",
                    size=1e3 * error_rad,
                    sigma=1e3 * sigma_rad,
                    unit="mrad",
                    effect_mm=0.0,
                    confidence=0.99,
                    text=f"Station {station.station} has a {name} of {stated} mrad, which the calibration found; it is "
                    "subtracted from its measurements.",
                    repair="Adjust the instrument before the next drive, or measure targets in both faces.",
                )
            )
    return found


def _sigma(covariance: SetupCovariance | None, component: str) -> float:
    if covariance is None or component not in covariance.components:
        return math.nan
    row = covariance.components.index(component)
    return math.sqrt(covariance.matrix[row][row])
