"""What a Leica instrument answers when it is asked for a full measurement, and what is made known of it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

from tsgt.model import Status
from tsgt.station.geocom import Verdict, verdict
from tsgt.station.instrument import Reading
from tsgt.station.leica.identity import numbers

if TYPE_CHECKING:
    from tsgt.station.geocom import Reply

REPEAT_NS: Final = 500_000_000
"""A status without a distance that does not change is given this often."""

MOST_MS: Final = 2**32
"""An instrument's time has 32 bits."""

_FARTHEST_M: Final = 20_000.0

STATUS: Final = {
    Verdict.USABLE: Status.OK,
    Verdict.LOW_ACCURACY: Status.LOW_ACCURACY,
    Verdict.ANGLE_ONLY: Status.ANGLE_ONLY,
    Verdict.NO_TARGET: Status.NO_TARGET,
    Verdict.NOTHING: Status.NO_TARGET,
    Verdict.TILT: Status.TILT,
    Verdict.WRONG_DISTANCE: Status.WRONG_DISTANCE,
}
"""Verdicts that answer the question for a measurement, in the common vocabulary; any other is an error."""


class Stamp(NamedTuple):
    """When a distance was taken, on the host's clock, and one sigma of that."""

    at_ns: int
    sigma_ns: int


class FullMeasurement(NamedTuple):
    """What TMC_GetFullMeas gave.

    Attributes
    ----------
    horizontal_angle_rad, zenith_angle_rad
        0 where it gave none.
    distance_m, time_ms
        Distance and the instrument's time of it; None where it gave none.
    status, code
        The verdict, and the instrument's own.
    first_byte_ns
        When the answer came.
    """

    horizontal_angle_rad: float
    zenith_angle_rad: float
    distance_m: float | None
    time_ms: int | None
    status: Status
    code: int
    first_byte_ns: int

    @property
    def has_angles(self) -> bool:
        """Whether the angles are valid."""
        return (self.horizontal_angle_rad, self.zenith_angle_rad) != (0.0, 0.0)


def full_measurement(reply: Reply) -> FullMeasurement:
    """Read a reply to TMC_GetFullMeas, whatever parts of it are there."""
    code = reply.code
    judged = verdict(code, has_values=bool(reply.values))
    status = STATUS.get(judged, Status.ERROR)
    horizontal_rad = zenith_rad = 0.0
    distance_m = time_ms = None
    if status.usable or status is Status.ANGLE_ONLY or status is Status.NO_TARGET:
        angles = numbers(reply, 2)
        if angles is not None and not (abs(angles[0]) <= 2 * math.tau and 0 <= angles[1] <= math.tau):
            angles = None  # damaged on the line
        if angles is not None:
            horizontal_rad, zenith_rad = angles
        whole = numbers(reply, 8)
        if whole is not None and not (whole[6] <= _FARTHEST_M and abs(whole[7]) <= MOST_MS):
            whole = None
        if status.usable and (angles is None or whole is None or whole[6] <= 0):
            status = Status.ANGLE_ONLY if angles is not None else Status.ERROR
        elif status.usable and whole is not None:
            distance_m, time_ms = whole[6], int(whole[7])
        if status is Status.ANGLE_ONLY and (horizontal_rad, zenith_rad) == (0.0, 0.0):
            status = Status.NO_TARGET
    return FullMeasurement(horizontal_rad, zenith_rad, distance_m, time_ms, status, code, reply.first_byte_ns)


class Readings:
    """Makes readings of measurements.

    Attributes
    ----------
    prism
        Number of the prism that is tracked.
    latency_ns
        From a measurement to the fastest answer; taken off the times of answers without a distance.
    """

    def __init__(self, prism: int, latency_ns: int) -> None:
        self.prism = prism
        self.latency_ns = latency_ns
        self._given: Status | None = None
        self._given_ns = 0

    def with_distance(self, measured: FullMeasurement, stamp: Stamp) -> Reading:
        """Return the reading of a distance that was taken at a time."""
        self._given = measured.status
        return self._reading(measured, stamp)

    def without(self, measured: FullMeasurement) -> Reading | None:
        """Return the reading that tells why there is no distance; None if that was told just now."""
        if measured.status is self._given and measured.first_byte_ns - self._given_ns < REPEAT_NS:
            return None
        self._given, self._given_ns = measured.status, measured.first_byte_ns
        measured = measured._replace(distance_m=None, time_ms=None)
        return self._reading(measured, Stamp(max(measured.first_byte_ns - self.latency_ns, 0), 0))

    def _reading(self, measured: FullMeasurement, stamp: Stamp) -> Reading:
        return Reading(
            at_ns=stamp.at_ns,
            sigma_ns=stamp.sigma_ns,
            prism=self.prism,
            horizontal_angle_rad=measured.horizontal_angle_rad,
            zenith_angle_rad=measured.zenith_angle_rad,
            slope_distance_m=measured.distance_m,
            status=measured.status,
            raw_status=measured.code,
            instrument_time_ns=None if measured.time_ms is None else measured.time_ms * 1_000_000,
            received_ns=measured.first_byte_ns,
        )
