"""How a station's client does, as it tells whoever asks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import tsgt
from tsgt.model import Status, check_instants
from tsgt.recording.journal import InstrumentRecord  # noqa: TC001 (pydantic looks it up when the program runs)

Mode = Literal["tracking", "direct"]

ProtocolName = Literal["classic", "superframe"]


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkStatus:
    """How a station's client does over the radio; fields as in :class:`ClientStatus`.

    Attributes
    ----------
    heard_ns
        RxDone of the last packet of the master for this station, on its Unix clock; None before the first one.
    """

    protocol: ProtocolName
    heard_ns: int | None
    rssi_dbm: float | None
    snr_db: float | None
    unknown_packets: int = 0
    authenticated: bool | None = None
    joined: bool | None = None
    queued: int | None = None
    late: int | None = None
    doubted: int | None = None
    refused: int | None = None
    clock_bound_ns: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class LastMeasurement:
    """What the instrument gave last.

    Attributes
    ----------
    age_s
        From the measurement to this record, in s.
    prism
        Number of the prism that was tracked; null for a single measurement of a target.
    horizontal_angle_rad, zenith_angle_rad
        As the instrument gave them, in rad; 0 where it gave none.
    slope_distance_m
        As the instrument gave it, in m, without prism constant; null where it gave none.
    status
        The instrument's verdict.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    age_s: float
    prism: int | None
    horizontal_angle_rad: float
    zenith_angle_rad: float
    slope_distance_m: float | None
    status: Status


@dataclass(frozen=True, slots=True, kw_only=True)
class ClientStatus:
    """How a station's client does at this moment.

    Attributes
    ----------
    type
        Always ``client_status``.
    version
        Of the program.
    stamp_ns
        Time of the record on the station's own Unix clock in ns, which need not be right.
    station
        Number of the station, from 1.
    instrument
        Name and number of the instrument; null while there is no connection to it.
    activity
        What the instrument is doing, in a few words; empty where it does not say.
    problem
        What a person should see to, as the instrument says; without a connection why there is none. Empty when there is
        nothing.
    battery_percent
        Charge of the instrument's battery; null where it does not say.
    settings
        What is known of the instrument and of its settings, as read back from it and journalled; null where nothing is.
    mode
        ``tracking`` a prism, or ``direct``: single measurements of targets.
    prism
        Number of the prism that is tracked, or was before direct mode.
    locked
        Whether there was a target at the last measurement; null before the first one.
    last
        The last measurement; null before the first one.
    measurements
        How many have been read since the client started.
    rate_hz
        Measurements of the last ten seconds, per second.
    journal
        Path of the journal.
    journal_ok
        Whether the disk took the last line that was to be written.
    journal_waiting
        How many lines are not in the journal yet; a disk that is full lets them pile up.
    journal_lost
        How many lines will never be, because too many were waiting already.
    master_heard_s
        From the last packet of the master for this station to this record, in s; null before the first one.
    rssi_dbm
        Strength of that packet in dBm; null before the first one.
    snr_db
        Its ratio to the noise in dB; null before the first one.
    unknown_packets
        How many packets of anybody have come since the master's last one. If it is not heard and these become more, it
        speaks another protocol, or has another key.
    radio_ok
        Whether the radio is open and answered when it was used last.
    protocol
        What is spoken over the radio, ``classic`` or ``superframe``. The protocol classic has none of the following,
        and they are null.
    authenticated
        Whether there is a key; without one anybody can take part.
    joined
        Whether a master has confirmed this station in its session.
    queued
        How many measurements are still to be delivered.
    late
        In how many of its slots the station was silent, or overran, because its computer was late.
    doubted
        How many beacons came at a time at which they cannot have been sent: somebody holds packets back, or a clock
        has been set.
    refused
        How many packets looked like a beacon with a wrong code: the master has another key, or somebody forges beacons.
    clock_bound_ns
        How well the master's time is known, in ns; null where it is not yet.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

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
    late: int | None
    doubted: int | None
    refused: int | None
    clock_bound_ns: int | None

    def __post_init__(self) -> None:
        """Refuse instants that no clock shows."""
        check_instants(self.stamp_ns)
