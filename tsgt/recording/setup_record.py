"""The record ``setup`` of the stream: everything that stays the same while poses come, until it is sent again."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field

from tsgt.model import (
    WORLD_FRAME,
    FiniteNumbers,
    Matrix4,
    Parameters,
    ReferencePoint,
    Row4,
    SetupCovariance,
    StationParameters,
    Vector3,
    check_instants,
)
from tsgt.recording.stream_records import ValidityLimits

if TYPE_CHECKING:
    from collections.abc import Iterable

SETUP_START = b'{"type":"setup",'
"""Start of every line with this record as it is written."""

_FRAME_COMPONENTS = ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")

Covariance = tuple[float, ...]
CovarianceOrNone = Annotated[Covariance, Field(min_length=36, max_length=36)] | None
Corner = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class SetupStation(FiniteNumbers):
    """The frame of one station, and what it tracks."""

    id: int
    """Number of the station, from 1."""
    position_m: Vector3
    """Origin of its frame in ``frame``, [x, y, z] in m."""
    orientation_xyzw: Row4
    """Rotation that takes coordinates in its frame to ``frame``, as a Hamilton unit quaternion [x, y, z, w] with w >= 0."""
    covariance: CovarianceOrNone
    """Covariance of that frame as calibrated, 6x6 row by row, order x, y, z (m), rotation about the fixed axes x, y, z
    (rad) of ``frame`` through its origin; zero for the station that defines ``frame``. Null where unknown: poses then
    take it as exact."""
    instrument: str | None = None
    """Kind of instrument; null where unknown: the radio does not carry it."""
    latency_s: float
    """From a measurement to its stamp, in s: subtract it from ``stamp_ns``. Positive: the stamp is late."""
    prism: int
    """Number of the prism that it tracks by configuration; what it tracks at the moment is in ``status``."""
    prism_constant_m: float
    """Added to its slope distances after the atmospheric correction, in m."""
    atmospheric_ppm: float
    """Atmospheric correction of its raw slope distances in ppm."""
    vertical_index_rad: float
    """Vertical index error, which is subtracted from its zenith angles, in rad."""
    collimation_rad: float
    """Collimation error in rad; divided by sin(zenith angle), it is added to its horizontal angles."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SetupPrism(FiniteNumbers):
    """One prism on the robot."""

    id: int
    """Number of the prism, from 1."""
    station: int | None
    """Number of the first station that tracks it; null where none does."""
    position_m: Vector3
    """Its centre in the frame ``robot``, [x, y, z] in m; not in the frame of the reference point."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SetupGeofence(FiniteNumbers):
    """One geofence."""

    name: str
    """Its name in events."""
    allowed_side: Literal["inside", "outside"]
    """Side of the polygon on which the robot may be."""
    polygon_m: tuple[Corner, ...]
    """Corners [x, y] in order in ``frame``, in m; the last is joined to the first."""
    margin_m: float
    """Required distance of the reference point from the boundary, in m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SetupRecord(FiniteNumbers):
    """The set-up in force: to each reader after ``hello``, and to all whenever it changes."""

    omitted_if_none: ClassVar[frozenset[str]] = frozenset({"no_poses"})

    type: Literal["setup"] = "setup"
    stamp_ns: int
    """Since when it has been in force, on the master's Unix clock in ns."""
    frame: str = WORLD_FRAME
    """Reference frame of the poses and of everything here that names no other."""
    child_frame: str
    """Frame whose pose is sent: the name of the reference point."""
    reference_point: ReferencePoint
    """That frame in the frame ``robot``."""
    estimator: str
    """Name of the estimator."""
    protocol: Literal["classic", "superframe"] | None = None
    """Name of the radio protocol; null without a radio, as for an import."""
    authenticated: bool | None = None
    """Whether the radio is authenticated with a key; null without a radio."""
    rate_hz: float
    """Epochs per second: poses of each series."""
    lag_s: float | None
    """Lag of the final smoothed poses in s; null with the estimator linear, which has none."""
    smoothed_delays_s: tuple[float, ...]
    """Delays in s at which smoothed poses are sent before the final ones: ``delay_s`` of these poses."""
    limits: ValidityLimits
    """As in ``hello``."""
    stations: tuple[SetupStation, ...]
    """One entry per station."""
    prisms: tuple[SetupPrism, ...]
    """One entry per prism."""
    geofences: tuple[SetupGeofence, ...] = ()
    """One entry per geofence; empty in a replay of a recording without this record."""
    imu: bool
    """Whether the robot has an IMU that poses may rest on."""
    recording: str | None = None
    """File name of the recording, in the folder that the master's configuration names; null without one."""
    no_poses: str | None = None
    """Why no poses are computed with it: the master is not calibrated, and stations and prisms are empty. Else absent."""

    def __post_init__(self) -> None:
        """Reject times outside 64 bits."""
        check_instants(self.stamp_ns)

    @classmethod
    def of(
        cls,
        parameters: Parameters,
        stamp_ns: int,
        *,
        protocol: Literal["classic", "superframe"] | None = None,
        authenticated: bool | None = None,
        geofences: Iterable[SetupGeofence] = (),
        recording: str | None = None,
    ) -> SetupRecord:
        """Return the set-up of the parameters in force, with what they do not contain."""
        pipeline = parameters.pipeline
        continuous = pipeline.estimator == "continuous"
        trackers = {station.prism: station.station for station in reversed(parameters.stations)}
        return cls(
            stamp_ns=stamp_ns,
            child_frame=parameters.reference_point.name,
            reference_point=parameters.reference_point,
            estimator=pipeline.estimator,
            protocol=protocol,
            authenticated=authenticated,
            rate_hz=1e9 / pipeline.period_ns,
            lag_s=pipeline.lag_ns / 1e9 if continuous else None,
            smoothed_delays_s=tuple(delay_ns / 1e9 for delay_ns in pipeline.smoothed_delays_ns)
            if continuous
            else (),
            limits=ValidityLimits.of(parameters),
            stations=()
            if parameters.no_poses is not None
            else tuple(_station(each, parameters.setup_covariance) for each in parameters.stations),
            prisms=tuple(
                SetupPrism(id=each.prism, station=trackers.get(each.prism), position_m=each.position_m)
                for each in parameters.prisms
            ),
            geofences=tuple(geofences),
            imu=parameters.imu is not None,
            recording=recording,
            no_poses=parameters.no_poses,
        )


def _station(station: StationParameters, known: SetupCovariance | None) -> SetupStation:
    x, y, z = (row[3] for row in station.T_station1_station[:3])
    return SetupStation(
        id=station.station,
        position_m=(x, y, z),
        orientation_xyzw=_quaternion_xyzw(station.T_station1_station),
        covariance=_frame_covariance(station.station, known),
        latency_s=station.latency_ns / 1e9,
        prism=station.prism,
        prism_constant_m=station.prism_constant_m,
        atmospheric_ppm=station.atmospheric_ppm,
        vertical_index_rad=station.vertical_index_rad,
        collimation_rad=station.collimation_rad,
    )


def _frame_covariance(station: int, known: SetupCovariance | None) -> Covariance | None:
    """Return the covariance of a station's frame; a component that is not in the joint one is exact."""
    if f"station{station}" == WORLD_FRAME:
        return (0.0,) * 36
    rows = {} if known is None else {name: row for row, name in enumerate(known.components)}
    at = [rows.get(f"station{station}.{component}") for component in _FRAME_COMPONENTS]
    if known is None or not any(row is not None for row in at):
        return None
    return tuple(0.0 if i is None or j is None else known.matrix[i][j] for i in at for j in at)


def _quaternion_xyzw(T: Matrix4) -> Row4:
    """Return the rotation of a rigid transform as a unit quaternion with w >= 0 (Shepperd's method).

    In plain Python, as geometry is a layer above.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row[:3] for row in T[:3])
    # Four times the products of the largest component with each: only that one is divided by.
    products = max(
        (1 + xx - yy - zz, yx + xy, zx + xz, zy - yz),
        (yx + xy, 1 - xx + yy - zz, zy + yz, xz - zx),
        (zx + xz, zy + yz, 1 - xx - yy + zz, yx - xy),
        (zy - yz, xz - zx, yx - xy, 1 + xx + yy + zz),
        key=lambda row: math.hypot(*row),
    )
    norm = math.copysign(math.hypot(*products), products[3])
    x, y, z, w = (product / norm for product in products)
    return (x, y, z, abs(w))
