"""The status of a station's client, as its control socket reports it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import tsgt
from tsgt.model import FiniteNumbers, Status, check_instants
from tsgt.recording.journal import InstrumentRecord  # noqa: TC001 (pydantic resolves annotations at run time)

Mode = Literal["tracking", "direct"]

ProtocolName = Literal["classic", "superframe"]


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkStatus:
    """The radio link's part; ``master_received_ns``: RxDone of the master's last packet, station's Unix clock."""

    protocol: ProtocolName
    master_received_ns: int | None
    rssi_dbm: float | None
    snr_db: float | None
    unknown_packets: int = 0
    authenticated: bool | None = None
    joined: bool | None = None
    queued: int | None = None
    missed_slots: int | None = None
    rejected_beacons: int | None = None
    refused: int | None = None
    clock_bound_ns: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class LastMeasurement(FiniteNumbers):
    """The last measurement of the instrument.

    Attributes
    ----------
    age_s
        Time from the measurement to this record.
    prism
        Null for a single measurement of a target.
    horizontal_angle_rad, zenith_angle_rad
        0 where the instrument reported none.
    slope_distance_m
        As the instrument gave it: with the prism constant that it adds itself, see ``settings``; null where it reported
        none.
    """

    age_s: float
    prism: int | None
    horizontal_angle_rad: float
    zenith_angle_rad: float
    slope_distance_m: float | None
    status: Status


@dataclass(frozen=True, slots=True, kw_only=True)
class ClientStatus(FiniteNumbers):
    """The current status of a station's client.

    Attributes
    ----------
    version
        Software version.
    stamp_ns
        Time of the record on the station's own Unix clock, which need not be right.
    instrument
        Name and serial number of the instrument; null while disconnected.
    activity
        Current activity of the instrument; empty where it does not report one.
    problem
        Action required of the operator, or the connection error; empty for none.
    battery_percent
        Null where the instrument does not report it.
    settings
        Identity and settings of the instrument as read back and journalled; null where unknown.
    mode
        ``tracking``, or ``direct`` for single measurements of targets.
    prism
        The tracked prism, or the one tracked before direct mode.
    locked
        Whether the last measurement had a target, so that its angles are valid; null before the first.
    last
        Null before the first measurement.
    measurements
        Number of measurements since the client started.
    rate_hz
        Measurement rate over the last ten seconds.
    journal
        Path of the journal.
    journal_ok
        Whether the disk accepted the last write.
    journal_waiting
        Number of lines still to be written; they pile up while the disk is full.
    journal_lost
        Number of lines lost because the queue was full.
    master_heard_s
        Time since the master's last packet for this station; null before the first.
    rssi_dbm, snr_db
        Signal strength and signal-to-noise ratio of that packet.
    unknown_packets
        Number of packets from other senders since the master's last one. If it grows while the master stays silent, the
        master uses another protocol or another key.
    radio_ok
        Whether the radio is open and worked when last used.
    protocol
        ``classic`` or ``superframe``; the fields below are null for ``classic``.
    authenticated
        Whether there is a key; without one anybody can take part.
    joined
        Whether a master has confirmed this station in its session.
    queued
        Number of measurements still to be delivered.
    missed_slots
        Number of slots missed or overrun because this computer was late.
    rejected_beacons
        Number of beacons whose arrival contradicts their time of transmission: delayed by an adversary, or a clock was
        set.
    refused
        Number of beacons whose authentication failed: the master has another key, or somebody forges beacons.
    clock_bound_ns
        Bound on the error of the master's time; null before the first synchronisation.
    """

    type: Literal["client_status"] = "client_status"
    version: str = tsgt.__version__
    stamp_ns: int
    station: int
    instrument: str | None
    activity: str
    problem: str
    battery_percent: int | None
    settings: InstrumentRecord | None
    mode: Mode
    prism: int
    locked: bool | None
    last: LastMeasurement | None
    measurements: int
    rate_hz: float
    journal: str
    journal_ok: bool
    journal_waiting: int
    journal_lost: int
    master_heard_s: float | None
    rssi_dbm: float | None
    snr_db: float | None
    unknown_packets: int
    radio_ok: bool
    protocol: ProtocolName
    authenticated: bool | None
    joined: bool | None
    queued: int | None
    missed_slots: int | None
    rejected_beacons: int | None
    refused: int | None
    clock_bound_ns: int | None

    def __post_init__(self) -> None:
        """Reject instants that no clock shows."""
        check_instants(self.stamp_ns)
