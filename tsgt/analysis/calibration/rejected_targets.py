"""What is said about a rejected target: what disagrees, whether it moved or a station erred, and what decides it."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.target_calibration import AIM, MOVED, READINGS, CauseKind, sight_error
from tsgt.model import TARGET_NOISE

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from tsgt.analysis.calibration.targets import TargetCalibration
    from tsgt.geometry.target_calibration import Cause, SightError

CONFUSED_M = 0.02  # Distance from another target's place below which the numbers were confused
DECIDED = 0.95  # Probability from which one explanation is stated


def rejection_notes(calibration: TargetCalibration) -> list[str]:
    """Return one sentence per rejected sight; one for all of a target of which several are rejected."""
    sights = [cause for cause in calibration.network.causes if cause.kind is CauseKind.SIGHT]
    notes = []
    for cause in sights:
        same = [other for other in sights if other.target == cause.target]
        target = numbers(calibration, cause)[1]
        if len(same) > 1:
            if cause is same[0]:
                notes.append(
                    f"target {target} rejected: {_several(calibration, same)}; measure it again with all stations"
                )
        elif cause.either_station or (others := _instead(calibration, cause)):
            rivals = (
                _stations_of(calibration, cause)
                if cause.either_station
                else [numbers(calibration, cause)[0], *others]
            )
            notes.append(
                f"target {target} rejected: stations {listed(sorted(rivals))} disagree on its place by {1e3 * cause.size_m:.1f} mm, and "
                f"the measurements do not tell which of them is wrong{_confused(calibration, cause)}; measure it again with both"
            )
        else:
            notes.append(_single(calibration, cause))
    return notes


def _single(calibration: TargetCalibration, cause: Cause) -> str:
    """Sentence on a sight that contradicts the other stations."""
    station, target = numbers(calibration, cause)
    others = [each for each in _stations_of(calibration, cause) if each != station]
    agreeing = (
        f"stations {listed(others)} agree" if len(others) > 1 else f"station {others[0]} and the frames agree"
    )
    error = sight_error(calibration.network, cause, TARGET_NOISE)
    if error is None:
        size, where, verdict = cause.size_m, "", "measure it again with all stations"
    else:
        size = float(np.linalg.norm(error.displacement_m))
        along, across, up = 1e3 * error.displacement_m
        where = f" (along the line of sight {along:+.1f}, clockwise {across:+.1f}, up {up:+.1f} mm)"
        verdict = _verdict(calibration, cause, error)
    return (
        f"station {station}: target {target} rejected: {1e3 * size:.1f} mm from the place on which {agreeing}{where}: {verdict}"
        f"{_tripod_instead(calibration, cause)}"
    )


def _verdict(calibration: TargetCalibration, cause: Cause, error: SightError) -> str:
    """Say whether the station erred or the target moved, or what would decide it."""
    station, _ = numbers(calibration, cause)
    again = f"measure it again with station {station}"
    if confused := _confused(calibration, cause):
        return f"the station erred{confused}; {again}"
    probabilities = error.probabilities()
    place = _place_in_order(calibration, cause)
    moved_by = probabilities[MOVED]
    name = max(READINGS, key=lambda each: probabilities[each])
    if place == "between":
        # A target that moves does not come back.
        erred = max(1 - moved_by, 1e-9)
        what = (
            f"its {name} is wrong" if probabilities[name] > DECIDED * erred else "or aimed at another point"
        )
        return f"the station erred, {what}, as those that measured before and after it agree; {again}"
    if probabilities[name] > DECIDED:
        return f"the station erred, its {name} is wrong; {again}"
    if moved_by < 1 - DECIDED:
        return f"the station erred: a wrong reading, or a point beside the target; {again}"
    moved = f"the target moved {'after' if place == 'first' else 'before'} this station measured it"
    if moved_by > DECIDED:
        return f"{moved}; {again}"
    decides = (
        "measured again it agrees with the others either way, and can then be used"
        if place == "first"
        else f"{again}: at the same place again it has moved, where the others have it the station erred"
    )
    return (
        f"it cannot be told whether the station erred (probability {1 - moved_by:.2f}, {_reading(probabilities)}) or {moved} "
        f"({moved_by:.2f}): {decides}"
    )


def _reading(probabilities: Mapping[str, float]) -> str:
    name = max((*READINGS, AIM), key=lambda each: probabilities[each])
    return "a point beside the target" if name == AIM else f"its {name}"


def _place_in_order(calibration: TargetCalibration, cause: Cause) -> str:
    """Whether a station measured the target ``first``, ``last`` or ``between`` the others, in the order of the file."""
    readings = calibration.network.readings
    stations = readings.station[readings.target == cause.target]
    own = np.flatnonzero(stations == cause.station)
    if own[0] == 0 and own[-1] == len(own) - 1:
        return "first"
    if own[-1] == len(stations) - 1 and own[0] == len(stations) - len(own):
        return "last"
    return "between"


def _several(calibration: TargetCalibration, same: Sequence[Cause]) -> str:
    """Say what several wrong sights of one target are."""
    wrong = {cause.station for cause in same}
    readings = calibration.network.readings
    order = [station for station, _ in groupby(readings.station[readings.target == same[0].target].tolist())]
    agreeing = [station for station in order if station not in wrong]
    if len(agreeing) < 2:
        return (
            "no two stations agree on its place; it moved more than once between the measurements, or its number was "
            "given to several targets"
        )
    stations = [listed(sorted(readings.stations[row] for row in rows)) for rows in (wrong, set(agreeing))]
    return f"stations {stations[0]} do not see it where stations {stations[1]} agree; it moved, or these aimed at another point"


def _instead(calibration: TargetCalibration, cause: Cause) -> list[int]:
    """Numbers of stations that may be wrong about the same target in place of that of a sight."""
    return [
        numbers(calibration, other)[0]
        for other in cause.alternatives
        if other.kind is CauseKind.SIGHT and other.target == cause.target
    ]


def _tripod_instead(calibration: TargetCalibration, cause: Cause) -> str:
    """Say that a tripod that moved explains the sight nearly as well."""
    targets = [
        numbers(calibration, other)[1] for other in cause.alternatives if other.kind is CauseKind.TRIPOD
    ]
    return f"; or its tripod moved before it measured target {listed(targets, 'or')}" if targets else ""


def _confused(calibration: TargetCalibration, cause: Cause) -> str:
    network = calibration.network
    assert cause.value is not None  # noqa: S101 (selected)
    assert cause.target is not None  # noqa: S101 (of a sight)
    points = network.network.points_m
    # A place that a station measured wrong differs by the displacement, with the sign of the sight.
    distances = np.linalg.norm(points - (points[cause.target] + cause.value), axis=1)
    distances[cause.target] = np.inf
    nearest = int(np.argmin(distances))
    if distances[nearest] > CONFUSED_M:
        return ""
    return f", this is the place of target {network.readings.targets[nearest]}"


def _stations_of(calibration: TargetCalibration, cause: Cause) -> list[int]:
    """Numbers of the stations that measured the cause's target."""
    readings = calibration.network.readings
    rows = sorted(set(readings.station[readings.target == cause.target].tolist()))
    return [readings.stations[row] for row in rows]


def numbers(calibration: TargetCalibration, cause: Cause) -> tuple[int, int]:
    """Numbers of the station and the target of a sight or a tripod."""
    readings = calibration.network.readings
    assert cause.target is not None  # noqa: S101 (of a sight or a tripod)
    return readings.stations[cause.station], readings.targets[cause.target]


def listed(items: Sequence[int], word: str = "and") -> str:
    """Return numbers as a list in a sentence."""
    *most, last = map(str, items)
    return f"{', '.join(most)} {word} {last}" if most else last
