"""What the master receives in a slot: a reply's timing, and its content in SI units on the master's clock."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from tsgt.model import Status
    from tsgt.radio.commands import Command
    from tsgt.radio.superframe.wire import CommandResponse, SingleMeasurement, StatusReport


class ReplyTiming(NamedTuple):
    """Instants of a reply and of its frame, on the master's CLOCK_MONOTONIC."""

    counter: int  # of the frame
    sent_ns: int  # TxDone of the beacon
    sent_sigma_ns: int
    slot_ns: int  # start of the station's slot
    received_ns: int  # RxDone of the reply
    received_sigma_ns: int
    lateness_ns: int  # RxDone minus its nominal instant
    payload_bytes: int
    granted_bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class TimedMeasurement:
    """A measurement with its timestamp, rounded to 0.37 microradians and 0.1 mm (1 mm beyond 1.6 km)."""

    sequence: int  # in full
    prism: int
    measured_ns: int  # on the master's CLOCK_MONOTONIC; negative before the start of that clock
    sigma_ns: int  # standard deviation of measured_ns
    bound_ns: int  # maximum error of measured_ns
    status: Status
    horizontal_angle_rad: float
    zenith_angle_rad: float
    slope_distance_m: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceivedReply:
    """Content of an authentic reply."""

    station: int
    measurements: tuple[TimedMeasurement, ...] = ()  # the new ones, by ascending sequence number
    repeated: int = 0  # number of measurements that had been received before
    joined: bool = False  # the station joined this session with this reply
    status_report: StatusReport | None = None
    command: Command | None = None  # completed by this reply, with its response or measurement; set once
    response: CommandResponse | None = None
    single_measurement: SingleMeasurement | None = None
    rejected_beacons: int = 0  # for an impossible time, since the station's last report
    link_delay_anomaly: bool = (
        False  # the measured link delay is impossible: packets may be delayed on purpose
    )
    lateness_ns: int = 0  # RxDone minus its nominal instant
