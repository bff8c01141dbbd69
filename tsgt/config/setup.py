"""Set-up files, as written by ``tsgt calibrate``."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from tsgt.config.base import Model, NotNegative, Number, NumberKey, Place, rigid
from tsgt.model import Matrix4


class TargetFit(Model):
    """Residuals of one target."""

    target: Number
    """Number of the target."""
    residual_mm: NotNegative | None = None
    """Distance between its positions measured by the station and by station 1, in the solved frame; none if rejected."""
    leave_one_out_mm: NotNegative | None = None
    """The same with the frame solved from the other targets only; none if these are too few."""


class StationFrame(Model):
    """Frame of one station."""

    T_station1_station: Annotated[Matrix4, AfterValidator(rigid)]
    """Rigid transform, 4x4 row by row, from the station's frame to that of station 1, in m."""
    rms_mm: NotNegative | None = None
    """Root mean square of the target residuals."""
    targets: tuple[TargetFit, ...] = ()
    """Targets of the solution, for reports."""
    latency_ms: Annotated[float, Field(ge=-1e6, le=1e6)] | None = None
    """Latency from the measurement to its timestamp by ``tsgt calibrate motion``; replaces that of the configuration."""


class StationFramesFile(Model):
    """Station frames, written by ``tsgt calibrate targets`` or ``motion``."""

    kind: Literal["station_frames"]
    """Kind of this file."""
    stations: dict[NumberKey, StationFrame]
    """One table per station, named by its number."""


class PrismEntry(Model):
    """Position of one prism on the robot."""

    position_m: Place
    """Centre in the robot frame, [x, y, z]."""
    sigma_m: tuple[NotNegative, NotNegative, NotNegative] | None = None
    """One sigma of each coordinate."""


class PrismLayoutFile(Model):
    """Prism layout, written by ``tsgt calibrate prisms``."""

    kind: Literal["prism_layout"]
    """Kind of this file."""
    prisms: dict[NumberKey, PrismEntry]
    """One table per prism, named by its number."""
