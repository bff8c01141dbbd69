"""The stream of poses for programs of yours, on the robot or on another computer.

In: the master's UNIX socket, or a relay (`relay_wire` is its protocol). Out: typed records; poses know their age, and a
stale one is never handed out as new. The standard library alone, so that a small computer loads it in some ten
milliseconds; `records` has the fields. `links` and `decoder` are sans-I/O, `pump` has the connection, and `blocking` and
`asynchronous` are the two faces.
"""

from typing import TYPE_CHECKING, Any

from tsgt.client.blocking import Stream
from tsgt.client.decoder import ProtocolVersionError
from tsgt.client.points import measured_point
from tsgt.client.records import (
    PROTOCOL_VERSION,
    DiskStatus,
    Event,
    Gap,
    Hello,
    ImuStatus,
    Measurement,
    OdometryStatus,
    Pose,
    Record,
    RecordingStatus,
    ReferencePoint,
    Setup,
    SetupGeofence,
    SetupPrism,
    SetupStation,
    StationShare,
    StationStatus,
    Status,
    ValidityLimits,
    monotonic_ns,
)
from tsgt.client.relay_wire import AuthenticationError
from tsgt.client.stream import LIVE, default_max_age_s

if TYPE_CHECKING:
    from tsgt.client.asynchronous import AsyncStream

__all__ = [
    "LIVE",
    "PROTOCOL_VERSION",
    "AsyncStream",
    "AuthenticationError",
    "DiskStatus",
    "Event",
    "Gap",
    "Hello",
    "ImuStatus",
    "Measurement",
    "OdometryStatus",
    "Pose",
    "ProtocolVersionError",
    "Record",
    "RecordingStatus",
    "ReferencePoint",
    "Setup",
    "SetupGeofence",
    "SetupPrism",
    "SetupStation",
    "StationShare",
    "StationStatus",
    "Status",
    "Stream",
    "ValidityLimits",
    "default_max_age_s",
    "measured_point",
    "monotonic_ns",
]


def __getattr__(name: str) -> Any:
    """Load asyncio, which takes longer than all the rest, only for those who use it."""
    if name == "AsyncStream":
        from tsgt.client.asynchronous import AsyncStream  # noqa: PLC0415 (as above)

        return AsyncStream
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
