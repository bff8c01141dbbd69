"""What the master receives in a slot: a reply's timing, and its content in SI units on the master's clock."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from tsgt.model import Status
    from tsgt.radio.commands import Command
    from tsgt.radio.superframe.wire import CommandResponse, SingleMeasurement, StatusReport


class ReplyTiming(NamedTuple):
    """Instants of a reply and of its frame, on the master's CLOCK_MONOTONIC.

    Attributes
    ----------
    counter
        Of the frame.
    sent_ns, sent_sigma_ns
        TxDone of the beacon.
    slot_ns
        Start of the station's slot.
    received_ns, received_sigma_ns
        RxDone of the reply.
    lateness_ns
        RxDone minus its nominal instant.
    payload_bytes, granted_bytes
        Length of the reply, and of the longest one that was granted.
    """

    counter: int
    sent_ns: int
    sent_sigma_ns: int
    slot_ns: int
    received_ns: int
    received_sigma_ns: int
    lateness_ns: int
    payload_bytes: int
    granted_bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class TimedMeasurement:
    """A measurement with its timestamp.

    Attributes
    ----------
    sequence
        Full sequence number.
    measured_ns
        On the master's CLOCK_MONOTONIC; may be negative, before the start of that clock.
    sigma_ns
        Standard deviation of ``measured_ns``.
    bound_ns
        Maximum error of ``measured_ns``.
    horizontal_angle_rad, zenith_angle_rad, slope_distance_m
        Rounded to the resolution of the air interface: 0.37 microradians, 0.1 mm (1 mm beyond 1.6 km).
    """

    sequence: int
    prism: int
    measured_ns: int
    sigma_ns: int
    bound_ns: int
    status: Status
    horizontal_angle_rad: float
    zenith_angle_rad: float
    slope_distance_m: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceivedReply:
    """Content of an authentic reply.

    Attributes
    ----------
    measurements
        The new ones, in ascending order of sequence numbers.
    repeated
        Number of measurements received before.
    joined
        The station joined this session with this reply.
    command, response, single_measurement
        The command that this reply completes, with its response or measurement; set once per command.
    rejected_beacons
        Beacons that the station has rejected for an impossible time since its last report.
    link_delay_anomaly
        The measured link delay is impossible: packets may be delayed on purpose.
    lateness_ns
        RxDone minus its nominal instant.
    """

    station: int
    measurements: tuple[TimedMeasurement, ...] = ()
    repeated: int = 0
    joined: bool = False
    status_report: StatusReport | None = None
    command: Command | None = None
    response: CommandResponse | None = None
    single_measurement: SingleMeasurement | None = None
    rejected_beacons: int = 0
    link_delay_anomaly: bool = False
    lateness_ns: int = 0
