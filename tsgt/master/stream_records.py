"""What the master adds to the measurements on the stream: greeting, poses, status, events.

docs/reference/stream.md and configs/schema/stream.schema.json are generated from these classes and their
docstrings (``make generated``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from pydantic import Field

import tsgt
from tsgt.model import ROBOT_FRAME, WORLD_FRAME, Row4, Status, Vector3, check_instants

PROTOCOL_VERSION = 1

CAPABILITIES = ("measurement", "point", "pose", "status", "event")

Kind = Literal["interpolated", "predicted", "smoothed"]
Reason = Literal["", "outage", "station_status", "degenerate_geometry", "residual", "tilt"]

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
        is no fit.
    reason
        Why this prism has no position at the pose: ``outage`` or ``station_status``; empty when it has one.
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
        ``interpolated`` between measurements, ``predicted`` beyond the last one, or ``smoothed`` with measurements
        on both sides.
    valid
        Whether the pose may be used. An invalid pose is sent too, so that a reader knows why it has none.
    reason
        Why it is not valid: ``outage`` (a prism without measurements for too long), ``station_status`` (the
        instrument reported an error), ``degenerate_geometry`` (prisms in a line or at one place), ``residual``
        (the prisms miss their layout by too much), ``tilt`` (the robot would lean too far: mirrored layout or
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
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    id: int
    measurements: int
    usable: int
    age_s: float | None
    status: Status | None


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
    """

    type: Literal["status"] = "status"
    stamp_ns: int
    poses: int
    valid_poses: int
    stations: tuple[StationStatus, ...]

    def __post_init__(self) -> None:
        """Refuse instants that no clock shows."""
        check_instants(self.stamp_ns)


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
