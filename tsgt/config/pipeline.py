"""How measurements become poses: the part that a master's configuration and a scenario share."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from tsgt.config.base import Model, NotNegative, Positive

# No narrower and no wider than what the estimator takes: see MotionPrior.
Acceleration = Annotated[float, Field(ge=1e-6, le=1e6)]
PerAxis = tuple[Acceleration, Acceleration, Acceleration]
Lasting = Annotated[float, Field(ge=1e-3, le=1e4)]


class MotionConfig(Model):
    """How the robot moves, as the estimator ``continuous`` expects it; `tsgt process` prints what suits a recording."""

    acceleration_sigma_mps2: PerAxis = (0.4, 0.4, 0.2)
    """One sigma of the acceleration of the prisms' middle along x, y, z of station 1."""
    acceleration_correlation_time_s: Lasting = 0.8
    """How long an acceleration lasts."""
    angular_acceleration_sigma_radps2: PerAxis = (0.15, 0.15, 0.2)
    """One sigma of the angular acceleration about x, y, z of the robot."""
    angular_acceleration_time_s: Lasting = 0.4
    """How long an angular acceleration lasts."""


class PipelineConfig(Model):
    """How measurements become poses."""

    estimator: Literal["linear", "continuous"] = "continuous"
    """Name of the estimator: straight lines between measurements, or one smooth trajectory through all of them."""
    rate_hz: Annotated[float, Field(ge=0.01, le=1000)] = 20.0
    """Poses per second."""
    outage_limit_s: Positive = 1.0
    """Two measurements of one prism further apart than this leave the time between them without pose."""
    transport_limit_s: Positive = 2.0
    """A measurement that has not arrived this long after it was made is not waited for."""
    residual_limit_mm: Positive = 50.0
    """A pose whose prisms miss their layout by more than this (root mean square) is not valid."""
    tilt_limit_deg: Annotated[float, Field(gt=0, le=180)] = 90.0
    """A pose whose robot leans further than this is not valid: mirrored layout or swapped prisms."""
    acceleration_sigma_mps2: NotNegative = 0.3
    """One sigma of the robot's acceleration between two measurements, per axis; for `linear`."""
    angular_acceleration_sigma_radps2: NotNegative = 0.15
    """One sigma of its angular acceleration, per axis; for `linear`."""
    motion: MotionConfig = MotionConfig()
    """How the robot moves; for `continuous`."""
    noise_scale: Annotated[float, Field(ge=0.001, le=1000)] = 1.0
    """What the noise of all instruments is multiplied by; for `continuous`."""
    lag_s: Annotated[float, Field(gt=0, le=60)] = 3.0
    """How long a live pose waits for late measurements until it is smoothed for good; for `continuous`."""
    position_sigma_limit_mm: Positive = 100.0
    """A pose whose position is known worse than this (one sigma) is not valid; for `continuous`."""
    rotation_sigma_limit_deg: Annotated[float, Field(gt=0, le=180)] = 5.0
    """A pose whose rotation is known worse than this (one sigma) is not valid; for `continuous`."""
