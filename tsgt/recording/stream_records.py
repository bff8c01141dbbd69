"""What the master adds to the measurements on the stream: greeting, poses, status, events.

docs/reference/stream.md and configs/schema/stream.schema.json are generated from these classes and their
docstrings (``make generated``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from pydantic import Field

import tsgt
from tsgt.model import ROBOT_FRAME, WORLD_FRAME, ClockSample, Row4, Status, Vector3, check_instants

PROTOCOL_VERSION = 1

CAPABILITIES = ("measurement", "point", "pose", "clock", "beacon", "status", "event")

Kind = Literal["interpolated", "predicted", "smoothed"]
Reason = Literal["", "outage", "station_status", "degenerate_geometry", "uncertain", "residual", "tilt"]

# Named here because pydantic looks the names of annotations up when the program runs.
PositionOrNone = Vector3 | None
QuaternionOrNone = Row4 | None
CovarianceOrNone = Annotated[tuple[float, ...], Field(min_length=36, max_length=36)] | None


@dataclass(frozen=True, slots=True, kw_only=True)
class HelloRecord:
    """The first line that a reader gets.

    Attributes
    ----------
    type
        Always ``hello``.
    protocol
        Version of the stream's format. It changes when a reader of the old one would misunderstand the new one;
        new types of lines and new keys do not change it.
    version
        Version of the software that serves the stream.
    capabilities
        Types of lines that may follow.
    """

    type: Literal["hello"] = "hello"
    protocol: int = PROTOCOL_VERSION
    version: str = tsgt.__version__
    capabilities: tuple[str, ...] = CAPABILITIES


@dataclass(frozen=True, slots=True, kw_only=True)
class StationShare:
    """What one station gave to a pose, or why it gave nothing.

    Attributes
    ----------
    id
        Number of the station, from 1.
    prism
        Number of the prism that it tracks, from 1.
    age_s
        From the prism's last usable measurement, before the pose or with it, to the pose, in s; null before
        the first one.
    residual_m
        Distance in m between its prism as measured and the same prism of the fitted layout; null when there
        is no fit. Unless interpolated: the middle one of three measurements near the pose.
    reason
        Why this prism has no position at the pose: ``outage`` or ``station_status``; empty when it has one. A pose that
        is not interpolated can be valid without it.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    id: int
    prism: int
    age_s: float | None
    residual_m: float | None
    reason: Reason


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseRecord:
    """The pose of the robot at one epoch, or why there is none.

    Attributes
    ----------
    type
        Always ``pose``.
    stamp_ns
        Time of the pose on the master's Unix clock in ns.
    frame
        Frame that the pose is given in.
    child_frame
        Frame whose pose it is.
    position_m
        Origin of ``child_frame`` in ``frame``, [x, y, z] in m; null when it cannot be computed.
    orientation_xyzw
        Rotation that takes coordinates in ``child_frame`` to ``frame``, as a Hamilton unit quaternion
        [x, y, z, w] with w >= 0; null when it cannot be computed.
    covariance
        Covariance of the pose, 6x6 row by row, order x, y, z (m), rotation about the fixed axes x, y, z (rad) of
        ``frame``; null when it cannot be computed.
    velocity_mps
        Velocity of the origin of ``child_frame``, [x, y, z] in m/s, in ``frame``; null when it cannot be
        computed.
    angular_velocity_radps
        Angular velocity [x, y, z] in rad/s, in ``child_frame``; null when it cannot be computed.
    estimator
        Name of the estimator that made it.
    kind
        ``interpolated`` between measurements (estimator ``linear``), ``predicted`` from those that had come before the
        pose, at once, or ``smoothed`` with those on both sides of it, a lag later.
    valid
        Whether the pose may be used. An invalid pose is sent too, so that a reader knows why it has none.
    reason
        Why it is not valid: ``outage`` (a prism without measurements for too long), ``station_status`` (the
        instrument reported an error), ``degenerate_geometry`` (prisms in a line or at one place), ``residual``
        (the prisms miss their layout by too much), ``uncertain`` (all prisms are there, but the pose is not known well
        enough), ``tilt`` (the robot would lean too far: mirrored layout or
        swapped prisms). Empty when valid.
    residual_m
        Root mean square over the prisms of their distance in m from the fitted layout; null when there is no
        fit.
    stations
        One entry per prism of the layout: the station that tracks it.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    type: Literal["pose"] = "pose"
    stamp_ns: int
    frame: str = WORLD_FRAME
    child_frame: str = ROBOT_FRAME
    position_m: PositionOrNone
    orientation_xyzw: QuaternionOrNone
    covariance: CovarianceOrNone
    velocity_mps: PositionOrNone
    angular_velocity_radps: PositionOrNone
    estimator: str
    kind: Kind
    valid: bool
    reason: Reason
    residual_m: float | None
    stations: tuple[StationShare, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class StationStatus:
    """How one station does.

    Attributes
    ----------
    id
        Number of the station, from 1.
    measurements
        How many of its measurements have come since the master started.
    usable
        How many of them could enter a pose.
    age_s
        From its last measurement to this record, in s; null before the first one.
    status
        What the instrument said of its last measurement; null before the first one.
    prism
        Number of the prism that it is told to track; null when that is not known.
    locked
        Whether it had a target at its last measurement; null before the first one.
    answering
        Whether it answered the last request; null before the first one.
    last_heard_s
        From its last radio message to this record, in s; null before the first one.
    rate_hz
        Distinct measurements per second over the last ten seconds; null before the first one.
    loss
        Share of the last fifty requests that it did not answer, 0 to 1; null before the first request.
    rssi_dbm
        Strength of its last radio message in dBm; null before the first one.
    snr_db
        Ratio of its last radio message to the noise in dB; null before the first one.
    clock_offset_ns
        Its clock against the master's now, in ns, positive when the station is ahead; null before the first
        synchronisation.
    clock_bound_ns
        The offset is within this of the truth, in ns; null before the first synchronisation.
    stamp_bound_ns
        The time of its newest measurement is within this of the truth, in ns; null before the first one.
    joined
        Whether it has joined the present session of the master; null with the protocol classic.
    outstanding
        How many measurements are known to have been made and have not come yet; null with the protocol classic.
    missed_slots
        How many of its slots it had to leave empty because its computer was late; null with the protocol classic.
    rejected_beacons
        How many beacons it received at a time at which they cannot have been sent, as when somebody holds them back;
        null with the protocol classic.
    outside_lag_window
        How many of its measurements came so late that the poses of their time had been smoothed for good; they count at the
        desk only. Null with the estimator linear.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    id: int
    measurements: int
    usable: int
    age_s: float | None
    status: Status | None
    prism: int | None = None
    locked: bool | None = None
    answering: bool | None = None
    last_heard_s: float | None = None
    rate_hz: float | None = None
    loss: float | None = None
    rssi_dbm: float | None = None
    snr_db: float | None = None
    clock_offset_ns: int | None = None
    clock_bound_ns: int | None = None
    stamp_bound_ns: int | None = None
    joined: bool | None = None
    outstanding: int | None = None
    missed_slots: int | None = None
    rejected_beacons: int | None = None
    outside_lag_window: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusRecord:
    """How the master and its stations do, now and then.

    Attributes
    ----------
    type
        Always ``status``.
    stamp_ns
        Time of the record on the master's Unix clock in ns.
    poses
        How many poses, valid or not, have been made since the master started.
    valid_poses
        How many of them were valid.
    stations
        One entry per station.
    protocol
        Name of the protocol that is spoken with them: ``classic`` or ``superframe``; null when there is no radio, as in
        a replay.
    authenticated
        Whether a key keeps others from taking part; ``classic`` has none. Null when there is no radio.
    frame_ms
        How long a frame lasts, from beacon to beacon, mean over the last ones, in ms; null with ``classic``.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    type: Literal["status"] = "status"
    stamp_ns: int
    poses: int
    valid_poses: int
    stations: tuple[StationStatus, ...]
    protocol: Literal["classic", "superframe"] | None = None
    authenticated: bool | None = None
    frame_ms: float | None = None

    def __post_init__(self) -> None:
        """Refuse instants that no clock shows."""
        check_instants(self.stamp_ns)


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockRecord:
    """What a synchronisation found of a station's clock, with the raw exchanges that it rests on.

    Attributes
    ----------
    type
        Always ``clock``.
    stamp_ns
        When it was found, on the master's Unix clock in ns.
    station
        Number of the station, from 1.
    filter
        Name of the filter: ``regression`` or ``paper``.
    offset_ns
        The station's clock against the master's at ``stamp_ns``, in ns; positive: the station is ahead.
    frequency_ppm
        By how much the station's clock gains on the master's, in 1e-6; positive: the station runs fast. 0 where the
        filter does not know.
    sigma_ns
        One sigma of the offset at ``stamp_ns``, in ns.
    bound_ns
        The offset at ``stamp_ns`` is within this of the truth, in ns.
    restarted
        Whether everything known of the clock before was thrown away: first synchronisation, restart, step.
    samples
        All exchanges of this synchronisation.
    rejected
        How many of them the filter left out.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    type: Literal["clock"] = "clock"
    stamp_ns: int
    station: int
    filter: str
    offset_ns: int
    frequency_ppm: float
    sigma_ns: int
    bound_ns: int
    restarted: bool
    samples: tuple[ClockSample, ...]
    rejected: int

    def __post_init__(self) -> None:
        """Refuse instants that no clock shows."""
        check_instants(self.stamp_ns)


@dataclass(frozen=True, slots=True, kw_only=True)
class BeaconRecord:
    """A beacon of the protocol superframe has gone out.

    The stations journal when they received it; so measurements that only a journal has can be put on the master's clock.

    Attributes
    ----------
    type
        Always ``beacon``.
    stamp_ns
        When its transmission had ended (TxDone), on the master's Unix clock in ns.
    stamp_sigma_ns
        One sigma of that, in ns; large where the radio's interrupt was lost.
    session
        Random number of the master's session.
    counter
        Number of the beacon in the session, from 0.
    """

    type: Literal["beacon"] = "beacon"
    stamp_ns: int
    stamp_sigma_ns: int
    session: int
    counter: int

    def __post_init__(self) -> None:
        """Refuse instants that no clock shows."""
        check_instants(self.stamp_ns, self.stamp_sigma_ns)


@dataclass(frozen=True, slots=True, kw_only=True)
class EventRecord:
    """Something that happened once and that a reader may want to act on.

    Attributes
    ----------
    type
        Always ``event``.
    stamp_ns
        When it happened, on the master's Unix clock in ns.
    event
        Stable name of what happened.
    message
        The same for people, one line.
    station
        Number of the station that it is about, from 1; null when it is about none.
    count
        How many, where the event counts something; else null.
    """

    type: Literal["event"] = "event"
    stamp_ns: int
    event: str
    message: str
    station: int | None = None
    count: int | None = None

    def __post_init__(self) -> None:
        """Refuse instants that no clock shows."""
        check_instants(self.stamp_ns)
