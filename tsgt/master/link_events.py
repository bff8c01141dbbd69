"""What a link reports to the publisher: one frozen dataclass per event. Sans-I/O."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from tsgt.model import PolarMeasurement
    from tsgt.radio.superframe import InstrumentCondition
    from tsgt.recording import BeaconRecord, ClockRecord
    from tsgt.timesync.two_way import ClockEstimate


@dataclass(frozen=True, slots=True)
class _OfStation:
    """An event that only has a station."""

    station: int


@dataclass(frozen=True, slots=True)
class StationResponded:
    """A station answered a request or replied in its slot."""

    station: int
    rssi_dbm: float
    snr_db: float


class NoResponse(_OfStation):
    """A station did not answer a request, or its slot stayed empty."""


class ReplyReceived(_OfStation):
    """A reply that may carry measurements; reported before them."""


@dataclass(frozen=True, slots=True)
class MeasurementReceived:
    """A new measurement."""

    measurement: PolarMeasurement


@dataclass(frozen=True, slots=True)
class TrackedPrism:
    """The prism that a station reports to track; None: it does not track."""

    station: int
    prism: int | None


@dataclass(frozen=True, slots=True)
class TrackingResult:
    """Whether a station tracks the prism that it was commanded to track."""

    station: int
    prism: int
    tracks: bool


@dataclass(frozen=True, slots=True)
class SuperframeState:
    """The state of a station in the protocol superframe; see :class:`~tsgt.recording.StationStatus`."""

    station: int
    joined: bool
    outstanding: int
    missed_slots: int
    rejected_beacons: int
    condition: InstrumentCondition


class ClockStepped(_OfStation):
    """A station's clock was stepped or reset."""


@dataclass(frozen=True, slots=True)
class ClockUpdate:
    """The result of a synchronisation."""

    record: ClockRecord


@dataclass(frozen=True, slots=True)
class BeaconSent:
    """A beacon of the protocol superframe was transmitted."""

    record: BeaconRecord


@dataclass(frozen=True, slots=True)
class BeaconTimeRejected:
    """A station received ``count`` beacons at impossible times."""

    station: int
    count: int


class LinkDelayAnomaly(_OfStation):
    """The measured link delay to a station is impossible."""


@dataclass(frozen=True, slots=True)
class MasterEvent:
    """An event of the master itself, published as it is."""

    event: str
    message: str


LinkEvent = (
    StationResponded
    | NoResponse
    | ReplyReceived
    | MeasurementReceived
    | TrackedPrism
    | TrackingResult
    | SuperframeState
    | ClockStepped
    | ClockUpdate
    | BeaconSent
    | BeaconTimeRejected
    | LinkDelayAnomaly
    | MasterEvent
)

Report = Callable[[LinkEvent], None]


def _no_clock(_station: int, _now_ns: int) -> ClockEstimate | None:
    return None


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkStatus:
    """What a status record states about the link; see :class:`~tsgt.recording.StatusRecord`."""

    protocol: Literal["classic", "superframe"] | None = None
    authenticated: bool | None = None
    frame_ms: float | None = None
    clock: Callable[[int, int], ClockEstimate | None] = _no_clock
    """Returns the estimate of a station's clock at an instant on the master's Unix clock; None before the first one."""


NO_LINK = LinkStatus()  # status without a radio
