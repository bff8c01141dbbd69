"""How measurements become poses: the part that a master's configuration and a scenario share."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from tsgt.config.base import Model, NotNegative, Positive


class PipelineConfig(Model):
    """How measurements become poses."""

    estimator: Literal["linear"] = "linear"
    """Name of the estimator."""
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
    """One sigma of the robot's acceleration between two measurements, per axis; goes into the covariance."""
    angular_acceleration_sigma_radps2: NotNegative = 0.15
    """One sigma of its angular acceleration, per axis; goes into the covariance."""
