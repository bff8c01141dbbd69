"""What the set-up files of the day hold, as ``tsgt calibrate`` writes them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from tsgt.config.base import Model, NotNegative, Number, NumberKey, Place, rigid
from tsgt.model import Matrix4


class TargetFit(Model):
    """How well one target fits the solved frame."""

    target: Number
    """Number of the target."""
    residual_mm: NotNegative | None = None
    """Where the station sees it less where station 1 does, in the solved frame; a rejected target has none."""
    leave_one_out_mm: NotNegative | None = None
    """The same with the frame solved from the other targets alone; none where these were too few."""


class StationFrame(Model):
    """Where one station stands."""

    T_station1_station: Annotated[Matrix4, AfterValidator(rigid)]
    """Rigid transform, 4x4 row by row, from the station's frame to that of station 1, in m."""
    rms_mm: NotNegative | None = None
    """By how much its targets missed those of station 1, root mean square, as the calibration found it."""
    targets: tuple[TargetFit, ...] = ()
    """The targets that it was solved from, for reports."""
    latency_ms: Annotated[float, Field(ge=-1e6, le=1e6)] | None = None
    """From the measurement to its time stamp, as ``tsgt calibrate motion`` found it; instead of the configuration's."""


class StationFramesFile(Model):
    """Where the stations stand: written by ``tsgt calibrate targets`` or ``motion``."""

    kind: Literal["station_frames"]
    """What this file is."""
    stations: dict[NumberKey, StationFrame]
    """One table per station, named by its number."""


class PrismEntry(Model):
    """Where one prism sits on the robot."""

    position_m: Place
    """Its centre in the frame of the robot, [x, y, z]."""
    sigma_m: tuple[NotNegative, NotNegative, NotNegative] | None = None
    """One sigma of each coordinate, as the calibration found it."""


class PrismLayoutFile(Model):
    """Where the prisms sit on the robot: written by ``tsgt calibrate prisms``."""

    kind: Literal["prism_layout"]
    """What this file is."""
    prisms: dict[NumberKey, PrismEntry]
    """One table per prism, named by its number."""
