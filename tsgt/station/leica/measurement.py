"""Decodes full measurements of a Leica instrument and converts them to readings. Sans-I/O."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

from tsgt.model import Status
from tsgt.station.geocom import Outcome, outcome_of
from tsgt.station.instrument import Reading
from tsgt.station.leica.identity import numeric_values

if TYPE_CHECKING:
    from tsgt.station.geocom import Reply

STATUS_INTERVAL_NS: Final = 500_000_000  # an unchanged status without a distance is reported at this interval

MAX_TIME_MS: Final = 2**32  # the instrument's time has 32 bits

_MAX_DISTANCE_M: Final = 20_000.0

STATUS: Final = {
    Outcome.USABLE: Status.OK,
    Outcome.LOW_ACCURACY: Status.LOW_ACCURACY,
    Outcome.ANGLE_ONLY: Status.ANGLE_ONLY,
    Outcome.NO_TARGET: Status.NO_TARGET,
    Outcome.NO_VALUES: Status.NO_TARGET,
    Outcome.TILT: Status.TILT,
    Outcome.WRONG_DISTANCE: Status.WRONG_DISTANCE,
}
"""Outcomes of a measurement as a status; any other is an error."""


class Timestamp(NamedTuple):
    """Time of a distance on the host's clock, and its standard error."""

    at_ns: int
    sigma_ns: int


class FullMeasurement(NamedTuple):
    """A decoded reply to TMC_GetFullMeas.

    Attributes
    ----------
    horizontal_angle_rad, zenith_angle_rad
        0 without angles.
    distance_m, time_ms
        Distance and the instrument's time of it; None without a distance.
    code
        The instrument's return code.
    first_byte_ns
        Arrival of the reply.
    """

    horizontal_angle_rad: float
    zenith_angle_rad: float
    distance_m: float | None
    time_ms: int | None
    status: Status
    code: int
    first_byte_ns: int

    @property
    def instrument_time_ns(self) -> int | None:
        """The instrument's time of the distance, in ns."""
        return None if self.time_ms is None else self.time_ms * 1_000_000


def decode_full_measurement(reply: Reply) -> FullMeasurement:
    """Decode a reply to TMC_GetFullMeas, complete or not."""
    code = reply.code
    status = STATUS.get(outcome_of(code, has_values=bool(reply.values)), Status.ERROR)
    horizontal_rad = zenith_rad = 0.0
    distance_m = time_ms = None
    if status.has_target or status is Status.NO_TARGET:
        angles = numeric_values(reply, 2)
        if angles is not None and not (abs(angles[0]) <= 2 * math.tau and 0 <= angles[1] <= math.tau):
            angles = None  # damaged on the line
        if angles is not None:
            horizontal_rad, zenith_rad = angles
        full = numeric_values(reply, 8)
        if full is not None and not (full[6] <= _MAX_DISTANCE_M and abs(full[7]) <= MAX_TIME_MS):
            full = None
        if status.usable and (angles is None or full is None or full[6] <= 0):
            status = Status.ANGLE_ONLY if angles is not None else Status.ERROR
        elif status.usable and full is not None:
            distance_m, time_ms = full[6], int(full[7])
        if status is Status.ANGLE_ONLY and (horizontal_rad, zenith_rad) == (0.0, 0.0):
            status = Status.NO_TARGET
    return FullMeasurement(horizontal_rad, zenith_rad, distance_m, time_ms, status, code, reply.first_byte_ns)


def not_aimed(reply: Reply) -> FullMeasurement:
    """Return the result of a measurement for which the telescope has not found its target."""
    return FullMeasurement(0.0, 0.0, None, None, Status.NO_TARGET, reply.code, reply.first_byte_ns)


class ReadingFactory:
    """Converts measurements of the tracked prism to readings.

    ``latency_ns``: time from a measurement to the fastest reply; subtracted from the arrival of replies without a
    distance.
    """

    def __init__(self, prism: int, latency_ns: int) -> None:
        self.prism = prism
        self.latency_ns = latency_ns
        self._status: Status | None = None
        self._status_ns = 0

    def with_distance(self, measured: FullMeasurement, time: Timestamp) -> Reading:
        """Return the reading of a distance taken at a time."""
        self._status = measured.status
        return reading_of(measured, self.prism, time.at_ns, time.sigma_ns)

    def without_distance(self, measured: FullMeasurement) -> Reading | None:
        """Return the reading with the reason for a missing distance; None if it was reported just now."""
        if measured.status is self._status and measured.first_byte_ns - self._status_ns < STATUS_INTERVAL_NS:
            return None
        self._status, self._status_ns = measured.status, measured.first_byte_ns
        measured = measured._replace(distance_m=None, time_ms=None)
        return reading_of(measured, self.prism, max(measured.first_byte_ns - self.latency_ns, 0))


def reading_of(measured: FullMeasurement, prism: int | None, at_ns: int, sigma_ns: int = 0) -> Reading:
    """Return the reading of a measurement; parameters as in :class:`~tsgt.station.instrument.Reading`."""
    return Reading(
        at_ns=at_ns,
        sigma_ns=sigma_ns,
        prism=prism,
        horizontal_angle_rad=measured.horizontal_angle_rad,
        zenith_angle_rad=measured.zenith_angle_rad,
        slope_distance_m=measured.distance_m,
        status=measured.status,
        raw_status=measured.code,
        instrument_time_ns=measured.instrument_time_ns,
        received_ns=measured.first_byte_ns,
    )
