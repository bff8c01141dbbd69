"""Single-shot and two-face measurements of targets with a Leica instrument.

Every call raises InstrumentError when the instrument does not respond.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from tsgt.errors import InstrumentRefusedError
from tsgt.model import Status
from tsgt.station.geocom import Outcome, Rpc, name_of, outcome_of
from tsgt.station.leica.identity import numeric_values, succeeded
from tsgt.station.leica.measurement import decode_full_measurement
from tsgt.station.leica.setup import clear_distance

if TYPE_CHECKING:
    from tsgt.clock import Clock
    from tsgt.station.geocom import GeoComConnection
    from tsgt.station.leica.measurement import FullMeasurement

_WAIT_MS: Final = 1000
_MEASUREMENT_TIMEOUT_NS: Final = 8_000_000_000
"""A precise distance to a reflective tape takes 1 to 3 s, and more in turbulent air."""

_CHANGE_FACE_TIMEOUT_S: Final = 30.0
_TRIES: Final = 3
_CLEAR, _MEASURE = 3, 1
_NO_DISTANCE_YET: Final = frozenset({Outcome.ANGLE_ONLY, Outcome.LOW_ACCURACY})

_FACE_TOLERANCE_RAD: Final = math.radians(0.2)
_FACE_TOLERANCE_M: Final = 0.05
"""Ten times the axis errors of an instrument: faces that differ by more measured different targets."""


async def measure_target(line: GeoComConnection, clock: Clock) -> FullMeasurement:
    """Measure the target in the line of sight once; takes some seconds.

    Raises InstrumentRefusedError if the instrument does not start: its stored distance may be that of another target.
    """
    await _start_program(line, _CLEAR)
    await _start_program(line, _MEASURE)
    until_ns = clock.monotonic_ns() + _MEASUREMENT_TIMEOUT_NS
    while True:
        measured = decode_full_measurement(await line.call(Rpc.TMC_GET_FULL_MEAS, _WAIT_MS, 1))
        # While it measures, some codes come with angles alone, or without any values.
        pending = measured.distance_m is None and (
            measured.status in (Status.ANGLE_ONLY, Status.ERROR)
            or outcome_of(measured.code, has_values=True) in _NO_DISTANCE_YET
        )
        if not pending or clock.monotonic_ns() >= until_ns:
            break
        await clock.sleep_until(clock.monotonic_ns() + 50_000_000)
    await clear_distance(line)
    if measured.status is Status.ANGLE_ONLY:  # until the timeout: nothing reflects
        measured = measured._replace(status=Status.NO_TARGET)
    return measured


async def measure_in_two_faces(line: GeoComConnection, clock: Clock, *, at_prism: bool) -> FullMeasurement:
    """Measure in both faces and return to the first; return the mean in terms of the first face.

    Raises InstrumentRefusedError if the instrument cannot change its face, or the faces measured different targets.
    """
    first = await measure_target(line, clock)
    if first.distance_m is None:
        return first
    face = int(first.zenith_angle_rad > math.pi)
    try:
        await _change_face(line, at_prism=at_prism)
        second = await measure_target(line, clock)
    except InstrumentRefusedError:  # nothing else: a cancelled or lost client must not wait for the telescope
        if await _face(line) != face:
            await _change_face(line, at_prism=False)
        raise
    await _change_face(line, at_prism=False)
    check_same_target(first, second)
    return mean_of_two_faces(first, second)


def mean_of_two_faces(first: FullMeasurement, second: FullMeasurement) -> FullMeasurement:
    """Return the mean of a two-face measurement in terms of the first face; the first alone if the second has no distance.

    Collimation, tilting-axis and vertical-index errors have opposite signs in the two faces and cancel.
    """
    if first.distance_m is None or second.distance_m is None:
        return first if first.distance_m is None else second
    horizontal_rad, vertical_rad = _face_difference_rad(first, second)
    worse = second if second.status is Status.LOW_ACCURACY else first
    return first._replace(
        horizontal_angle_rad=(first.horizontal_angle_rad + horizontal_rad / 2) % math.tau,
        zenith_angle_rad=first.zenith_angle_rad + vertical_rad / 2,
        distance_m=(first.distance_m + second.distance_m) / 2,
        status=worse.status,
        code=worse.code,
    )


def _face_difference_rad(first: FullMeasurement, second: FullMeasurement) -> tuple[float, float]:
    """Return horizontal and zenith angle of the second face minus the first, both in terms of the first."""
    turned_rad = second.horizontal_angle_rad + math.pi
    horizontal_rad = math.remainder(turned_rad - first.horizontal_angle_rad, math.tau)
    return horizontal_rad, math.tau - second.zenith_angle_rad - first.zenith_angle_rad


def check_same_target(first: FullMeasurement, second: FullMeasurement) -> None:
    """Raise InstrumentRefusedError if two faces differ by more than the axis errors: they measured two targets."""
    if first.distance_m is None or second.distance_m is None:
        return
    horizontal_rad, vertical_rad = _face_difference_rad(first, second)
    difference_rad = math.hypot(horizontal_rad * math.sin(first.zenith_angle_rad), vertical_rad)
    difference_m = abs(first.distance_m - second.distance_m)
    if difference_rad > _FACE_TOLERANCE_RAD or difference_m > _FACE_TOLERANCE_M:
        raise InstrumentRefusedError(
            f"the two faces measured different targets, {math.degrees(difference_rad):.2f} degrees and"
            f" {difference_m:.3f} m apart: the telescope was turned, or something interrupted the line of sight;"
            " measure again"
        )


async def _start_program(line: GeoComConnection, program: int) -> None:
    for _ in range(_TRIES):
        reply = await line.call(Rpc.TMC_DO_MEASURE, program, 1)
        if succeeded(reply):
            return
    raise InstrumentRefusedError(
        f"the instrument does not start a new measurement: {name_of(reply.code)}; measure again"
    )


async def _face(line: GeoComConnection) -> int | None:
    """Return the face: 0 the first, 1 the second; None where the instrument does not report it."""
    values = numeric_values(await line.call(Rpc.TMC_GET_FACE), 1)
    return None if values is None else int(values[0])


async def _change_face(line: GeoComConnection, *, at_prism: bool) -> None:
    before = await _face(line) if at_prism else None
    reply = await line.call(Rpc.AUT_CHANGE_FACE, 0, int(at_prism), 0, timeout_s=_CHANGE_FACE_TIMEOUT_S)
    if not succeeded(reply):
        if before is not None and await _face(line) == 1 - before:
            raise InstrumentRefusedError(
                f"the instrument does not find the prism in the other face: {name_of(reply.code)}; check the line of sight,"
                " or measure in one face (target_faces = 1)"
            )
        raise InstrumentRefusedError(
            f"the instrument does not change its face: {name_of(reply.code)}; measure in one face (target_faces = 1)"
        )
