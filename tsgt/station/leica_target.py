"""Single measurements of a target that a person aims at, with a Leica instrument."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from tsgt.errors import InstrumentRefusedError
from tsgt.model import Status
from tsgt.station.geocom import Rpc
from tsgt.station.geocom_codes import name_of
from tsgt.station.leica_identity import done
from tsgt.station.leica_measurement import full_measurement
from tsgt.station.leica_setup import clear

if TYPE_CHECKING:
    from tsgt.clock import Clock
    from tsgt.station.geocom_connection import GeoComConnection
    from tsgt.station.leica_measurement import FullMeasurement

_WAIT_MS: Final = 1000
_SHOT_NS: Final = 8_000_000_000
"""A precise distance to a foil takes 1 to 3 s, and in bad air some more."""

_FACE_S: Final = 30.0


async def shoot(line: GeoComConnection, clock: Clock) -> FullMeasurement:
    """Measure what the telescope points at, once; it takes some seconds.

    Raises
    ------
    InstrumentError
        The instrument does not answer.
    """
    await clear(line)
    await line.call(Rpc.TMC_DO_MEASURE, 1, 1)
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
        The instrument cannot change its face.
    InstrumentError
        The instrument does not answer.
    """
    first = await shoot(line, clock)
    if first.distance_m is None:
        return first
    await _change_face(line, at_prism=at_prism)
    second = await shoot(line, clock)
    await _change_face(line, at_prism=False)
    return both_faces(first, second)


def both_faces(first: FullMeasurement, second: FullMeasurement) -> FullMeasurement:
    """Return the mean of a target in two faces, as seen in the first; without the second if that saw nothing.

    The errors of the collimation, of the tilting axis and of the zenith index have opposite signs in the two.
    """
    if first.distance_m is None or second.distance_m is None:
        return first if first.distance_m is None else second
    turned_rad = second.horizontal_angle_rad + math.pi
    across_rad = math.remainder(turned_rad - first.horizontal_angle_rad, math.tau)
    up_rad = math.tau - second.zenith_angle_rad - first.zenith_angle_rad
    worse = second if second.status is Status.LOW_ACCURACY else first
    return first._replace(
        horizontal_angle_rad=(first.horizontal_angle_rad + across_rad / 2) % math.tau,
        zenith_angle_rad=first.zenith_angle_rad + up_rad / 2,
        distance_m=(first.distance_m + second.distance_m) / 2,
        status=worse.status,
        code=worse.code,
    )


async def _change_face(line: GeoComConnection, *, at_prism: bool) -> None:
    reply = await line.call(Rpc.AUT_CHANGE_FACE, 0, int(at_prism), 0, timeout_s=_FACE_S)
    if not done(reply):
        raise InstrumentRefusedError(
            f"the instrument does not change its face: {name_of(reply.code)}; measure in one face (target_faces = 1)"
        )
