"""Configuration of the IMU."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pydantic import ValidationError

from tsgt.config import IMU_NOISE, ImuConfig, ImuNoiseConfig, normal_gravity_mps2


def config(**changes: Any) -> ImuConfig:
    """Return a configuration, gravity given unless changed."""
    values: dict[str, Any] = {
        "command": ("/bin/imu",),
        "position_m": (0.1, 0.2, 0.3),
        "orientation_xyzw": (0.0, 0.0, 0.0, 1.0),
        "gravity_mps2": 9.81,
    }
    return ImuConfig(**values | changes)


@pytest.mark.parametrize(
    ("latitude_deg", "height_m", "gravity_mps2"),
    # WGS 84 at the equator and the poles, 45 degrees; the free-air gradient is -3.086e-6 per m.
    [
        (0.0, 0.0, 9.7803253359),
        (90.0, 0.0, 9.8321849379),
        (-90.0, 0.0, 9.8321849379),
        (45.0, 0.0, 9.806197769),
        (45.0, 1000.0, 9.803113),
    ],
)
def test_normal_gravity(latitude_deg: float, height_m: float, gravity_mps2: float) -> None:
    """As tabulated."""
    assert normal_gravity_mps2(latitude_deg, height_m) == pytest.approx(gravity_mps2, abs=1e-6)


def test_parameters_are_in_si_units() -> None:
    """Latency in ns, gravity from the latitude, noise of the preset."""
    found = config(gravity_mps2=None, latitude_deg=45.0, latency_ms=-1.5).parameters()
    assert found.latency_ns == -1_500_000
    assert found.gravity_mps2 == pytest.approx(9.8062, abs=1e-4)
    assert found.tilt_sigma_rad == pytest.approx(1e-4)
    assert found.noise == IMU_NOISE["industrial"]


def test_noise_of_the_data_sheet_replaces_that_of_the_preset() -> None:
    """Only what is given."""
    found = ImuNoiseConfig(preset="consumer", gyro_bias_radps=0.001).noise()
    assert found.gyro_bias_radps == 0.001
    assert found.gyro_noise_density == pytest.approx(math.radians(0.014))


@pytest.mark.parametrize(
    "changes",
    [
        {"gravity_mps2": None},
        {"latitude_deg": 45.0},
        {"orientation_xyzw": (0.0, 0.0, 0.0, 2.0)},
        {"command": ()},
        {"gravity_mps2": -9.81},
    ],
)
def test_impossible_configuration_is_rejected(changes: dict[str, Any]) -> None:
    """When it is read."""
    with pytest.raises(ValidationError):
        config(**changes)
