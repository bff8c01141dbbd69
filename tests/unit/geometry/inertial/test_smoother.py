"""Whole recordings with an IMU: accuracy and stated uncertainty with three, two and one stations."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.inertial.inertial_drive import DEG, imu_parameters, inertial_drive

from tsgt.errors import GeometryError
from tsgt.geometry import log_so3
from tsgt.geometry.inertial import fit_inertial_trajectory, smoother
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.geometry.inertial import InertialFit
    from tsgt.geometry.trajectory import Observations

IMU = imu_parameters()
DRIVE = inertial_drive(50.0, seed=12).shaken(IMU)
SAMPLES = DRIVE.samples(IMU)
CENTROID = DRIVE.layout.mean(axis=0)


def measure(stations: int) -> Observations:
    """Return measurements with the layout from the centroid."""
    observations = DRIVE.measure(stations=stations)
    return replace(observations, layout=observations.layout - CENTROID)


def fit(stations: int, prior: MotionPrior | None = None) -> InertialFit:
    """Fit the whole drive."""
    return fit_inertial_trajectory(measure(stations), SAMPLES, IMU, reference_m=CENTROID, gyro_only=prior)


def errors_of(found: InertialFit) -> tuple[FloatArray, FloatArray]:
    """Errors of poses 20 times a second, (N, 6), and their normalised squares, (N,)."""
    knots_s = found.trajectory.knots.time_s
    time_s = np.arange(np.ceil(knots_s[0]) + 1, np.floor(knots_s[-1]) - 1, 0.05)
    states, covariance = found.trajectory.at(time_s)
    position, rotation = DRIVE.pose_at(time_s)
    turned = log_so3(np.swapaxes(rotation, 1, 2) @ states.rotation)
    errors = np.concatenate([states.position - position - rotation @ CENTROID, turned], axis=1)
    return errors, np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariance), errors)


@pytest.mark.parametrize(
    ("stations", "prior", "limit_mm", "limit_deg"),
    [(3, None, 1.1, 0.05), (2, None, 1.3, 0.06), (1, None, 2.2, 0.15), (3, MotionPrior(), 2.0, 0.05)],
    ids=["3 stations", "2 stations", "1 station", "gyro only"],
)
def test_accuracy(stations: int, prior: MotionPrior | None, limit_mm: float, limit_deg: float) -> None:
    """A shaken robot, from nothing: no pose is known before."""
    errors, normalised = errors_of(fit(stations, prior))
    rms = np.sqrt((errors.reshape(-1, 2, 3) ** 2).sum(axis=2).mean(axis=0))
    assert rms[0] < limit_mm / 1e3
    assert rms[1] < limit_deg * DEG
    assert 1.5 < normalised.mean() < 8
    assert (normalised > 22.5).mean() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("stations", "overlap_s"), [(2, 12.0), (1, 2.0)])
def test_segments_give_the_result_of_the_whole(
    stations: int, overlap_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Measurements outside the overlap carry next to no information; one prism needs all for its heading."""
    whole = fit(stations)
    monkeypatch.setattr(smoother, "SEGMENT_S", 18.0)
    monkeypatch.setattr(smoother, "OVERLAP_S", overlap_s)
    parts = fit(stations)
    time_s = np.arange(2.0, 48.0, 0.3)
    (expected, covariance), (found, _) = whole.trajectory.at(time_s), parts.trajectory.at(time_s)
    sigma_m = np.sqrt(np.einsum("nii->ni", covariance)[:, :3])
    assert (np.abs(found.position - expected.position) / sigma_m).max() < 0.3
    assert len(parts.squared_distances) == len(whole.squared_distances)


def test_outage_of_all_stations_is_bridged() -> None:
    """Ten seconds without any measurement have knots of their own, and poses with an honest uncertainty."""
    observations = measure(3)
    gone = (observations.time_s > 20.0) & (observations.time_s < 30.0)
    found = fit_inertial_trajectory(observations.select(~gone), SAMPLES, IMU, reference_m=CENTROID)
    assert np.diff(found.trajectory.knots.time_s).max() < 0.51
    errors, normalised = errors_of(found)
    assert np.linalg.norm(errors[:, :3], axis=1).max() < 0.08
    assert normalised.mean() < 8


def test_stationary_robot_with_one_station() -> None:
    """One prism on a robot at rest does not tell its heading: an error, not a guess."""
    observations = measure(1)
    still = observations.select(np.zeros(40, np.intp))
    still = replace(still, time_s=observations.time_s[:40])
    quiet = SAMPLES.select(np.zeros(4000, np.intp))
    quiet = replace(quiet, end_s=SAMPLES.end_s[:4000], angular_rate_radps=0.0 * quiet.angular_rate_radps)
    with pytest.raises(GeometryError, match="heading"):
        fit_inertial_trajectory(still, quiet, IMU, reference_m=CENTROID)
