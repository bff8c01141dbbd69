"""Start of a trajectory with an IMU from one, two and three stations, without any prior knowledge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from harness.inertial.inertial_drive import DEG, imu_parameters, inertial_drive

from tsgt.errors import GeometryError
from tsgt.geometry import log_so3
from tsgt.geometry.inertial import Gravity, InertialSetup, Mounting, contiguous
from tsgt.geometry.inertial.initialisation import HeadingSearch, search_heading

IMU = imu_parameters()
DRIVE = inertial_drive(24.0, seed=12)


def search(stations: int, start_s: float, end_s: float, *, still: bool = False) -> HeadingSearch:
    """Search over a part of the drive; ``still``: the robot stays where it is at the start."""
    drive = DRIVE
    if still:
        rest = np.zeros(len(drive.position), np.intp)
        drive = replace(drive, position=drive.position[rest], rotation=drive.rotation[rest])
    observations = drive.measure(stations=stations)
    observations = observations.select((observations.time_s > start_s) & (observations.time_s < end_s))
    reference = drive.layout.mean(axis=0)
    mounted = replace(observations, layout=Mounting.of(IMU, reference).in_imu(drive.layout - reference))
    return search_heading(
        mounted, InertialSetup(contiguous(drive.samples(IMU), IMU.noise), IMU.noise), Gravity.of(IMU)
    )


@pytest.mark.parametrize(("stations", "limit_deg"), [(3, 0.3), (2, 0.5), (1, 2.0)])
def test_heading_is_found_from_nothing(stations: int, limit_deg: float) -> None:
    """Ten seconds of driving tell the rotation, whatever it is, with one station too."""
    found = search(stations, 1.0, 11.0)
    assert found.determined
    knots = found.solution.knots
    rotation = DRIVE.pose_at(knots.time_s)[1] @ Mounting.of(IMU, np.zeros(3)).rotation
    errors = np.linalg.norm(log_so3(np.swapaxes(rotation, 1, 2) @ knots.rotation), axis=1)
    assert errors.max() < limit_deg * DEG


@pytest.mark.slow
def test_one_station_does_not_tell_the_heading_of_a_stationary_robot() -> None:
    """All headings explain the measurements of one prism at rest; two prisms tell it."""
    assert not search(1, 1.0, 11.0, still=True).determined
    assert search(2, 1.0, 11.0, still=True).determined


def test_too_few_measurements() -> None:
    """A start needs several measurements."""
    with pytest.raises(GeometryError, match="a start needs 8 measurements, 5"):
        search(1, 1.0, 3.0)
