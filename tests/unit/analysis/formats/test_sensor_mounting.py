"""Files of kind ``sensor_mounting`` that ``tsgt compare`` writes and reads."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tsgt.analysis.formats import write_sensor_mounting
from tsgt.config import SensorMountingFile, load
from tsgt.errors import ConfigError
from tsgt.geometry import transform_from

if TYPE_CHECKING:
    from pathlib import Path


def test_mounting_is_read_back(tmp_path: Path) -> None:
    """With its sigmas; an unknown one is left out."""
    rotation = Rotation.from_euler("zyx", [2.0, 0.1, -0.3])
    T = transform_from(rotation.as_matrix(), np.array([0.35, 0.1, 0.6]))
    sigma = np.array([0.001, 0.002, 0.003, math.nan, 0.001, 0.001])
    path = tmp_path / "lidar.toml"
    write_sensor_mounting(path, T, sigma, offset_s=-0.0421, offset_sigma_s=2e-4, comment="written by a test")
    found = load(path, SensorMountingFile)
    assert found.position_m == (0.35, 0.1, 0.6)
    assert abs(np.dot(found.orientation_xyzw, rotation.as_quat())) == pytest.approx(1.0)
    assert found.position_sigma_mm == pytest.approx((1.0, 2.0, 3.0))
    assert found.rotation_sigma_deg is None
    assert (found.offset_ms, found.offset_sigma_ms) == pytest.approx((-42.1, 0.2))


def test_quaternion_of_another_length_is_an_error(tmp_path: Path) -> None:
    """As if w stood first in another convention's file with more columns."""
    path = tmp_path / "lidar.toml"
    path.write_text('kind = "sensor_mounting"\nposition_m = [0, 0, 0]\norientation_xyzw = [1, 1, 0, 0]\n')
    with pytest.raises(ConfigError, match="expected a unit quaternion"):
        load(path, SensorMountingFile)
