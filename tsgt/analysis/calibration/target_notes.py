"""What the residuals of targets look like, in sentences: the cause, its size with uncertainty, and what repairs it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.analysis.calibration.rejected_targets import listed, numbers, rejection_notes
from tsgt.geometry.target_calibration import DATA_SHEET_SIGMA, CauseKind, InstrumentError

if TYPE_CHECKING:
    from tsgt.analysis.calibration.targets import TargetCalibration
    from tsgt.geometry.target_calibration import Cause, FitQuality

NOISE_LEVEL = 1e-3  # Probability by chance of a misfit that is called noise larger than stated
SPEC_FACTOR = 3.0  # Data sheet's sigmas that an instrument error surely exceeds if it is reported as one
UNEVEN = 1.3  # Ratio of noise scales beyond which the largest is named

_NAMES = {
    InstrumentError.VERTICAL_INDEX: ("a vertical index error", "mrad", 1e3),
    InstrumentError.COLLIMATION: ("a collimation error", "mrad", 1e3),
    InstrumentError.RANGE_SCALE: ("a scale error of the distances", "ppm", 1e6),
    InstrumentError.RANGE_CONSTANT: ("a constant error of the distances", "mm", 1e3),
}
_REPAIRS = {
    InstrumentError.VERTICAL_INDEX: "adjust the instrument, or measure in both faces",
    InstrumentError.COLLIMATION: "adjust the instrument, or measure in both faces",
    InstrumentError.RANGE_SCALE: "check its atmospheric correction",
    InstrumentError.RANGE_CONSTANT: "check the reflector type set in the instrument",
}


def target_notes(calibration: TargetCalibration) -> list[str]:
    """Return one sentence per finding, the most important first."""
    network = calibration.network
    notes = rejection_notes(calibration)
    notes += [
        _excess_text(calibration, cause)
        for cause in network.causes
        if cause.kind is CauseKind.INSTRUMENT and _is_beyond_data_sheet(calibration, cause)
    ]
    for cause in network.causes:
        if cause.kind is CauseKind.TARGET_CONSTANT:
            value_mm = 1e3 * network.network.target_constant_m
            done = "corrected here" if calibration.applied else "not corrected with --weights none"
            notes.append(
                f"all stations: the distances to the targets look {-value_mm:+.1f} mm wrong: check the constant of the "
                f"targets (add {value_mm:+.1f} mm to --target-constant-mm); {done}"
            )
        if cause.kind is CauseKind.TRIPOD:
            notes.append(_tripod_text(calibration, cause))
    suspects = [
        f"{_sight(calibration, cause)} is {1e3 * cause.size_m:.1f} mm off: suspect but kept; "
        f"--exclude {exclusion(calibration, cause)} leaves it out"
        for cause in network.suspects
        if cause.kind is CauseKind.SIGHT
    ]
    # The misfit of a tripod that moved stays in the residuals.
    has_moved = any(cause.kind is CauseKind.TRIPOD for cause in network.causes)
    if network.overall.p_value < NOISE_LEVEL and not has_moved:
        notes.append(_noise_text(calibration, has_suspects=bool(suspects)))
    return notes + suspects


def suspect_exclusions(calibration: TargetCalibration) -> list[str]:
    """Return what ``--exclude`` would leave out: what a tripod that moved measured before, and suspect sights.

    Suspect are also those that are not told apart from another cause.
    """
    network = calibration.network
    outdated = [
        f"{numbers(calibration, cause)[0]}:{target}"
        for cause in network.causes
        if cause.kind is CauseKind.TRIPOD
        for target in _before(calibration, cause)
    ]
    unidentified = [each for cause in network.unidentified for each in (cause, *cause.alternatives)]
    suspects = [
        exclusion(calibration, cause)
        for cause in (*unidentified, *network.suspects)
        if cause.kind is CauseKind.SIGHT
    ]
    return list(dict.fromkeys([*outdated, *suspects]))


def exclusion(calibration: TargetCalibration, cause: Cause) -> str:
    """Return the value of ``--exclude`` for a sight."""
    station, target = numbers(calibration, cause)
    return f"{target}" if cause.either_station else f"{station}:{target}"


def unidentified_text(calibration: TargetCalibration) -> str:
    """Return which causes the readings do not tell apart."""
    return "; ".join(
        " or ".join(dict.fromkeys(_name(calibration, each) for each in (cause, *cause.alternatives)))
        for cause in calibration.network.unidentified
    )


def _excess_text(calibration: TargetCalibration, cause: Cause) -> str:
    assert cause.error is not None  # noqa: S101 (of an instrument)
    station = calibration.network.readings.stations[cause.station]
    what, unit, factor = _NAMES[cause.error]
    estimate = calibration.errors(station)[cause.error]
    others = sorted(
        {
            calibration.network.readings.stations[other.station]
            for other in cause.alternatives
            if other.kind is CauseKind.INSTRUMENT and other.error is cause.error
        }
    )
    which = f"station {station}" if not others else f"station {station} or {listed(others, 'or')}"
    if not calibration.applied:
        done = "not applied with --weights none"
    elif cause.error is InstrumentError.RANGE_CONSTANT:
        done = "applied to the targets only: the constant of the prisms may differ"
    else:
        done = "applied"
    return (
        f"{which}: the residuals look like {what} of {factor * estimate.value:.3g} {unit} (sigma {factor * estimate.sigma:.2g}), "
        f"{done}; {_REPAIRS[cause.error]}"
    )


def _tripod_text(calibration: TargetCalibration, cause: Cause) -> str:
    assert cause.value is not None  # noqa: S101 (selected)
    station, target = numbers(calibration, cause)
    before = _before(calibration, cause)
    sights = [_sight(calibration, each) for each in cause.alternatives if each.kind is CauseKind.SIGHT]
    instead = (
        f" (nearly as likely: {' and '.join(sights)} wrong; measure these again to decide)" if sights else ""
    )
    return (
        f"station {station}: the tripod looks moved by {1e3 * cause.size_m:.1f} mm and turned by "
        f"{1e3 * abs(float(cause.value[3])):.2f} mrad before target {target} was measured{instead}; measure the targets before it "
        f"again, or leave them out: --exclude {','.join(f'{station}:{each}' for each in before)}"
    )


def _noise_text(calibration: TargetCalibration, *, has_suspects: bool) -> str:
    network = calibration.network
    quality = network.overall
    scales = dict(
        zip(("along the line of sight", "horizontal", "vertical"), network.by_component, strict=True)
    )
    stations = {
        f"station {station}": each
        for station, each in zip(network.readings.stations, network.by_station, strict=True)
    }
    parts = [name for part in (scales, stations) if (name := _largest(part))]
    mostly = f", mostly {' and '.join(parts)}" if parts else ""
    reason = "with the suspects below" if has_suspects else "noise larger than stated, or many small errors"
    return (
        f"the residuals are {quality.noise_scale:.2f} times the stated noise (chi-square {quality.chi_squared:.1f} of "
        f"{quality.redundancy:.0f} degrees of freedom, p {quality.p_value:.1g}){mostly}: {reason}; the sigmas are "
        "scaled by it"
    )


def _largest(qualities: dict[str, FitQuality]) -> str:
    """Return the part with the largest noise scale, if it stands out."""
    ordered = sorted(qualities, key=lambda name: -qualities[name].noise_scale)
    first, second = (qualities[name].noise_scale for name in ordered[:2])
    return f"{ordered[0]} ({first:.1f} times)" if first > UNEVEN * second else ""


def _before(calibration: TargetCalibration, cause: Cause) -> list[int]:
    """Numbers of the targets that a station measured before its tripod moved."""
    readings = calibration.network.readings
    own = readings.target[readings.station == cause.station].tolist()
    return [readings.targets[target] for target in dict.fromkeys(own[: own.index(cause.target)])]


def _is_beyond_data_sheet(calibration: TargetCalibration, cause: Cause) -> bool:
    assert cause.error is not None  # noqa: S101 (of an instrument)
    estimate = calibration.network.errors[cause.station, cause.error]
    return abs(estimate.value) - 1.5 * estimate.sigma > SPEC_FACTOR * DATA_SHEET_SIGMA[cause.error]


def _name(calibration: TargetCalibration, cause: Cause) -> str:
    if cause.kind is CauseKind.TARGET_CONSTANT:
        return "a wrong constant of all targets"
    if cause.kind is CauseKind.INSTRUMENT and cause.error is not None:
        station = calibration.network.readings.stations[cause.station]
        return f"{_NAMES[cause.error][0]} of station {station}"
    if cause.kind is CauseKind.SIGHT:
        return _sight(calibration, cause)
    return f"a {cause.kind.value} of station {calibration.network.readings.stations[cause.station]}"


def _sight(calibration: TargetCalibration, cause: Cause) -> str:
    station, target = numbers(calibration, cause)
    return f"target {target}" if cause.either_station else f"target {target} of station {station}"
