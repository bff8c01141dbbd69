"""Single measurements of a target that a person aims at, with a Leica instrument."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from tsgt.errors import InstrumentRefusedError
from tsgt.model import Status
from tsgt.station.geocom import Rpc, name_of
from tsgt.station.leica.identity import done
from tsgt.station.leica.measurement import full_measurement
from tsgt.station.leica.setup import clear

if TYPE_CHECKING:
    from tsgt.clock import Clock
    from tsgt.station.geocom import GeoComConnection
    from tsgt.station.leica.measurement import FullMeasurement

_WAIT_MS: Final = 1000
_SHOT_NS: Final = 8_000_000_000
"""A precise distance to a foil takes 1 to 3 s, and in bad air some more."""

_FACE_S: Final = 30.0
_TRIES: Final = 3
_CLEAR, _MEASURE = 3, 1

_APART_RAD: Final = math.radians(0.2)
_APART_M: Final = 0.05
"""The errors of an instrument's axes are a tenth of this: two faces that differ by more saw two targets."""


async def shoot(line: GeoComConnection, clock: Clock) -> FullMeasurement:
    """Measure what the telescope points at, once; it takes some seconds.

    Raises
    ------
    InstrumentRefusedError
        It does not begin; the distance that it still has may be one to another target.
    InstrumentError
        The instrument does not answer.
    """
    await _do(line, _CLEAR)
    await _do(line, _MEASURE)
    until_ns = clock.monotonic_ns() + _SHOT_NS
    while True:
        shot = full_measurement(await line.call(Rpc.TMC_GET_FULL_MEAS, _WAIT_MS, 1))
        waits = shot.status is Status.ANGLE_ONLY or shot.status is Status.ERROR
        if not waits or clock.monotonic_ns() >= until_ns:
            break
        await clock.sleep_until(clock.monotonic_ns() + 50_000_000)
    await clear(line)
    if shot.status is Status.ANGLE_ONLY:  # for so long: there is nothing that reflects
        shot = shot._replace(status=Status.NO_TARGET)
    return shot


async def shoot_in_two_faces(line: GeoComConnection, clock: Clock, *, at_prism: bool) -> FullMeasurement:
    """Measure in one face, then in the other, and come back; return the mean, as seen in the first face.

    Raises
    ------
    InstrumentRefusedError
        The instrument cannot change its face, or sees another target in it.
    InstrumentError
        The instrument does not answer.
    """
    first = await shoot(line, clock)
    if first.distance_m is None:
        return first
    await _change_face(line, at_prism=at_prism)
    second = await shoot(line, clock)
    await _change_face(line, at_prism=False)
    check_same_target(first, second)
    return both_faces(first, second)


def both_faces(first: FullMeasurement, second: FullMeasurement) -> FullMeasurement:
    """Return the mean of a target in two faces, as seen in the first; without the second if that saw nothing.

    The errors of the collimation, of the tilting axis and of the zenith index have opposite signs in the two.
    """
    if first.distance_m is None or second.distance_m is None:
        return first if first.distance_m is None else second
    across_rad, up_rad = _apart_rad(first, second)
    worse = second if second.status is Status.LOW_ACCURACY else first
    return first._replace(
        horizontal_angle_rad=(first.horizontal_angle_rad + across_rad / 2) % math.tau,
        zenith_angle_rad=first.zenith_angle_rad + up_rad / 2,
        distance_m=(first.distance_m + second.distance_m) / 2,
        status=worse.status,
        code=worse.code,
    )


def _apart_rad(first: FullMeasurement, second: FullMeasurement) -> tuple[float, float]:
    """Return by how much the second face points elsewhere, about the plumb line and in height."""
    turned_rad = second.horizontal_angle_rad + math.pi
    across_rad = math.remainder(turned_rad - first.horizontal_angle_rad, math.tau)
    return across_rad, math.tau - second.zenith_angle_rad - first.zenith_angle_rad


def check_same_target(first: FullMeasurement, second: FullMeasurement) -> None:
    """Refuse two faces that cannot be of one target.

    Raises
    ------
    InstrumentRefusedError
        They are too far apart.
    """
    if first.distance_m is None or second.distance_m is None:
        return
    across_rad, up_rad = _apart_rad(first, second)
    apart_rad = math.hypot(across_rad * math.sin(first.zenith_angle_rad), up_rad)
    apart_m = abs(first.distance_m - second.distance_m)
    if apart_rad > _APART_RAD or apart_m > _APART_M:
        raise InstrumentRefusedError(
            f"the two faces saw different things, {math.degrees(apart_rad):.2f} degrees and {apart_m:.3f} m apart: the"
            " telescope was turned, or something came in between; measure again"
        )


async def _do(line: GeoComConnection, program: int) -> None:
    for _ in range(_TRIES):
        reply = await line.call(Rpc.TMC_DO_MEASURE, program, 1)
        if done(reply):
            return
    raise InstrumentRefusedError(
        f"the instrument begins no new measurement: {name_of(reply.code)}; measure again"
    )


async def _change_face(line: GeoComConnection, *, at_prism: bool) -> None:
    reply = await line.call(Rpc.AUT_CHANGE_FACE, 0, int(at_prism), 0, timeout_s=_FACE_S)
    if not done(reply):
        raise InstrumentRefusedError(
            f"the instrument does not change its face: {name_of(reply.code)}; measure in one face (target_faces = 1)"
        )
