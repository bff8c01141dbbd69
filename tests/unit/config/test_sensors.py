"""Configuration of the IMU."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import pytest
from pydantic import ValidationError

from tsgt.config import (
    IMU_NOISE,
    ImuConfig,
    ImuNoiseConfig,
    load_imu_mounting,
    normal_gravity_mps2,
    setup_covariance,
)
from tsgt.errors import ConfigError
from tsgt.model import SetupCovariance

if TYPE_CHECKING:
    from pathlib import Path

MOUNTING = """
kind = "imu_mounting"
position_m = [0.2, -0.1, 0.4]
orientation_xyzw = [0.0, 0.0, 0.6, 0.8]
latency_ms = 4.3
gyro_matrix = [[1.01, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
[covariance]
components = ["imu.x", "imu.latency"]
matrix = [[1e-6, 0.0], [0.0, 1e-7]]
"""


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
        {"position_m": None},
        {"mounting": "imu.toml"},
        {"mounting": "imu.toml", "position_m": None, "orientation_xyzw": None, "latency_ms": 1.0},
    ],
)
def test_impossible_configuration_is_rejected(changes: dict[str, Any]) -> None:
    """When it is read."""
    with pytest.raises(ValidationError):
        config(**changes)


def test_file_replaces_the_mounting(tmp_path: Path) -> None:
    """Position, orientation, latency and gyro matrix are those of the file, all else is as configured."""
    (tmp_path / "imu.toml").write_text(MOUNTING)
    mounting = load_imu_mounting(tmp_path / "imu.toml")
    without = config(mounting=tmp_path / "imu.toml", position_m=None, orientation_xyzw=None)
    found = mounting.applied(without.parameters())
    assert found.position_m == (0.2, -0.1, 0.4)
    assert found.orientation_xyzw == (0.0, 0.0, 0.6, 0.8)
    assert found.latency_ns == 4_300_000
    assert found.gyro_matrix[0] == (1.01, 0.0, 0.0)
    assert found.gravity_mps2 == 9.81
    assert mounting.covariance is not None
    assert mounting.covariance.components == ("imu.x", "imu.latency")


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [("0.6, 0.8", "0.6, 0.9", "unit quaternion"), ("imu.latency", "imu.mass", "no quantity of this file")],
)
def test_impossible_mounting_is_rejected(tmp_path: Path, old: str, new: str, problem: str) -> None:
    """When it is read."""
    (tmp_path / "imu.toml").write_text(MOUNTING.replace(old, new))
    with pytest.raises(ConfigError, match=problem):
        load_imu_mounting(tmp_path / "imu.toml")


def test_covariance_of_the_imu_joins_those_of_stations_and_prisms() -> None:
    """Alone it is left out: it would say that the others are exact."""
    imu, prism = (
        SetupCovariance(components=(name,), matrix=((value,),))
        for name, value in (("imu.x", 4.0), ("prism1.x", 1.0))
    )
    found = setup_covariance(None, prism, station_numbers=[1], prism_numbers=[1], imu=imu)
    assert found is not None
    assert found.components == ("prism1.x", "imu.x")
    assert found.matrix == ((1.0, 0.0), (0.0, 4.0))
    assert setup_covariance(None, None, station_numbers=[1], prism_numbers=[1], imu=imu) is None
