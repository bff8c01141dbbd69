"""Whether a tuned motion prior suits live estimation."""

from __future__ import annotations

from dataclasses import replace

from tsgt.analysis.motion_plausibility import implausibilities
from tsgt.model import MotionPrior

PRIOR = MotionPrior()


def test_configured_prior_is_plausible() -> None:
    """The default describes the robots of the scenarios."""
    assert implausibilities(PRIOR, moving_s=300.0) == []


def test_vibration_endless_manoeuvres_and_short_drives_are_named() -> None:
    """Each deviation has its reason, with the value."""
    shaking = replace(PRIOR, acceleration_correlation_time_s=0.04)
    (reason,) = implausibilities(shaking, moving_s=300.0)
    assert "acceleration is correlated over 0.04 s" in reason
    assert "vibration" in reason
    endless = replace(PRIOR, angular_acceleration_correlation_time_s=10.0)
    (reason,) = implausibilities(endless, moving_s=300.0)
    assert "angular acceleration is correlated over 10 s" in reason
    rocket = replace(PRIOR, acceleration_sigma_mps2=(9.0, 9.0, 1.0))
    (reason,) = implausibilities(rocket, moving_s=300.0)
    assert "9 m/s^2" in reason
    (reason,) = implausibilities(PRIOR, moving_s=20.0)
    assert "moved for 20 s only" in reason
