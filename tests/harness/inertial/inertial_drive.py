"""A robot with an IMU that is shaken as it drives: exact motion, inertial samples and prism measurements of it.

The motion is piecewise linear on a fine grid, and so are the samples: each is the sum of the grid's increments of angle and
velocity, as an ideal device would form it. Nothing here uses the estimator's code but its arrays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation, Slerp

from tsgt.geometry.inertial import InertialSamples
from tsgt.geometry.trajectory import Observations
from tsgt.geometry.trajectory.measurement_factors import line_of_sight_axes
from tsgt.model import ImuNoise, ImuParameters
from tsgt.simulation.scenario_files import find_scenario
from tsgt.simulation.world import scenario_world

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

GRID_S = 0.001
GRAVITY_MPS2 = 9.81
EARTH_RATE_RADPS = 7.292115e-5
SHAKING_HZ = (8.0, 60.0)
SHAKING_RATE_RADPS, SHAKING_FORCE_MPS2 = 0.06, 1.5  # rms of each axis while it drives
DEG = np.pi / 180

# Data sheets of the class VN-100, MTi-630, ADIS1647x, and of the class BMI088, ICM-209xx.
GRADES = {
    "industrial": ImuNoise(
        gyro_noise_density=0.005 * DEG,
        accelerometer_noise_density=80e-6 * GRAVITY_MPS2,
        gyro_bias_walk=0.0005 * DEG,
        accelerometer_bias_walk=8e-6 * GRAVITY_MPS2,
        gyro_bias_radps=0.15 * DEG,
        accelerometer_bias_mps2=3e-3 * GRAVITY_MPS2,
    ),
    "consumer": ImuNoise(
        gyro_noise_density=0.014 * DEG,
        accelerometer_noise_density=190e-6 * GRAVITY_MPS2,
        gyro_bias_walk=0.002 * DEG,
        accelerometer_bias_walk=30e-6 * GRAVITY_MPS2,
        gyro_bias_radps=0.7 * DEG,
        accelerometer_bias_mps2=20e-3 * GRAVITY_MPS2,
    ),
}


def imu_parameters(grade: str = "industrial") -> ImuParameters:
    """Return an IMU that is mounted askew, half a metre from the robot's origin."""
    return ImuParameters(
        position_m=(0.21, -0.12, 0.43),
        orientation_xyzw=tuple(Rotation.from_rotvec([0.02, -0.035, 1.60]).as_quat().tolist()),  # type: ignore[arg-type]
        noise=GRADES[grade],
        gravity_mps2=GRAVITY_MPS2,
    )


@dataclass(frozen=True)
class InertialDrive:
    """The motion of the robot's origin on the grid, from the time 0."""

    position: FloatArray  # (N, 3) in frame ``station1``
    rotation: Rotation  # N
    layout: FloatArray  # (P, 3) in the robot frame
    frames: FloatArray  # (S, 4, 4) ``T_station1_station``

    @property
    def time_s(self) -> FloatArray:
        """(N,) times of the grid."""
        return np.arange(len(self.position), dtype=np.float64) * GRID_S

    def pose_at(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Position of the origin, (M, 3), and rotation, (M, 3, 3)."""
        position = np.stack([np.interp(time_s, self.time_s, each) for each in self.position.T], axis=1)
        return position, Slerp(self.time_s, self.rotation)(time_s).as_matrix()

    def measure(
        self, *, stations: int = 3, rate_hz: float = 2.5, noise: float = 1.0, seed: int = 0
    ) -> Observations:
        """Measure each prism by its own station, with noise in range, angles and time."""
        rng = np.random.default_rng([seed, 1])
        end_s = self.time_s[-1] - 0.01
        times, which = [], []
        for station in range(stations):
            each_s = np.arange(rng.uniform(0.0, 1 / rate_hz), end_s - 0.05, 1 / rate_hz)
            times.append(each_s + rng.normal(scale=0.004, size=len(each_s)).clip(-0.01, 0.01) + 0.01)
            which.append(np.full(len(each_s), station))
        order = np.argsort(np.concatenate(times))
        time_s, rows = np.concatenate(times)[order], np.concatenate(which)[order]
        position, rotation = self.pose_at(time_s + noise * rng.normal(scale=3e-4, size=len(time_s)))
        world = position + np.einsum("nij,nj->ni", rotation, self.layout[rows])
        frames = self.frames[rows]
        points = np.einsum("nji,nj->ni", frames[:, :3, :3], world - frames[:, :3, 3])
        sigmas = np.tile([0.002, 0.0011, 0.0011], (len(points), 1))
        axes, _ = line_of_sight_axes(points)
        points += noise * np.einsum("nji,nj->ni", axes, sigmas * rng.normal(size=points.shape))
        polar = np.ones(len(points), np.bool_)
        return Observations(
            time_s,
            np.full(len(points), 6e-4),
            points,
            sigmas,
            polar,
            rows,
            rows,
            self.frames,
            self.layout,
        )

    def samples(
        self, imu: ImuParameters, *, rate_hz: float = 200.0, noise: float = 1.0, seed: int = 0
    ) -> InertialSamples:
        """Sample an IMU whose gyro matrix is known: white noise, biases at switching on and their walks."""
        rng = np.random.default_rng([seed, 2])
        step = round(1.0 / rate_hz / GRID_S)
        mounting = Rotation.from_quat(imu.orientation_xyzw)
        rotation = self.rotation * mounting
        origin = self.position + self.rotation.apply(np.array(imu.position_m))
        # The Earth turns: a latitude of 45 degrees, and an azimuth that nobody knows.
        earth = EARTH_RATE_RADPS * np.array([np.cos(0.785) * 0.54, np.cos(0.785) * 0.84, np.sin(0.785)])
        angle = (rotation[:-1].inv() * rotation[1:]).as_rotvec() + rotation[:-1].inv().apply(earth) * GRID_S
        gained = np.diff(origin, n=2, axis=0) / GRID_S + np.array([0.0, 0.0, GRAVITY_MPS2]) * GRID_S
        gained = np.concatenate([rotation[1:-1].inv().apply(gained), np.zeros((1, 3))])
        count = (len(angle) - 1) // step
        # An increment of velocity happens at a point of the grid: half of a sample's last one belongs to the next.
        first = np.concatenate([gained[:1], gained[:-1]])
        shared = 0.5 * (first + gained)[: count * step]
        rate, force = (
            each[: count * step].reshape(count, step, 3).sum(axis=1) / (step * GRID_S)
            for each in (angle, shared)
        )
        step_s = step * GRID_S
        sheet = imu.noise

        def errors(density: float, walk: float, bias: float) -> FloatArray:
            white = rng.normal(scale=density / np.sqrt(step_s), size=rate.shape)
            walked = np.cumsum(rng.normal(scale=walk * np.sqrt(step_s), size=rate.shape), axis=0)
            total: FloatArray = noise * (white + walked + rng.normal(scale=bias, size=3))
            return total

        rate = rate + errors(sheet.gyro_noise_density, sheet.gyro_bias_walk, sheet.gyro_bias_radps)
        force = force + errors(
            sheet.accelerometer_noise_density, sheet.accelerometer_bias_walk, sheet.accelerometer_bias_mps2
        )
        return InertialSamples(
            np.arange(1, count + 1, dtype=np.float64) * step_s, np.full(count, step_s), rate, force
        )

    def shaken(self, imu: ImuParameters, seed: int = 0) -> InertialDrive:
        """Return the motion of a robot that the ground shakes about its IMU while it drives."""
        rng = np.random.default_rng([seed, 3])
        sos = butter(2, np.array(SHAKING_HZ) * 2 * GRID_S, "band", output="sos")
        count = len(self.position)
        rate, force = (sosfiltfilt(sos, rng.standard_normal((count, 3)), axis=0) for _ in range(2))
        speed = np.linalg.norm(np.gradient(self.position[:, :2], GRID_S, axis=0), axis=1)
        moving = np.minimum(1.0, speed / 0.5)[:, None]
        turn = sosfiltfilt(sos, np.cumsum(rate, axis=0), axis=0)
        turn *= moving * SHAKING_RATE_RADPS * GRID_S / np.diff(turn, axis=0).std()
        shift = sosfiltfilt(sos, np.cumsum(np.cumsum(force, axis=0), axis=0), axis=0)
        shift *= moving * SHAKING_FORCE_MPS2 * GRID_S**2 / np.diff(shift, n=2, axis=0).std()
        lever = np.array(imu.position_m)
        rotation = self.rotation * Rotation.from_rotvec(turn)
        origin = self.position + self.rotation.apply(lever + shift)
        return replace(self, position=origin - rotation.apply(lever), rotation=rotation)


def inertial_drive(duration_s: float, *, scenario: str = "dynamic", seed: int = 0) -> InertialDrive:
    """Drive through a scenario."""
    config = find_scenario(scenario)
    world = scenario_world(
        config, duration_s + 1.0, np.random.default_rng(seed).spawn(4 + len(config.stations))[0]
    )
    time_s = np.arange(round(duration_s / GRID_S) + 1, dtype=np.float64) * GRID_S
    pose = world.pose_at(time_s)
    frames = np.tile(np.eye(4), (len(config.stations), 1, 1))
    for row, station in enumerate(config.stations):
        frames[row, :3, :3] = Rotation.from_euler("z", station.yaw_deg, degrees=True).as_matrix()
        frames[row, :3, 3] = station.position_m
    layout = np.array([each.position_m for each in config.prisms])
    return InertialDrive(pose[:, :3, 3], Rotation.from_matrix(pose[:, :3, :3]), layout, frames)


def standing_from(drive: InertialDrive, at_s: float, *, until_s: float) -> InertialDrive:
    """Return the drive of a robot that slows down within a second and then stands."""
    time_s = np.arange(round(until_s / GRID_S)) * GRID_S
    since_s = np.clip(time_s - at_s, 0.0, 1.0)
    driven_s = np.minimum(time_s, at_s) + since_s - since_s**3 + 0.5 * since_s**4
    position = np.stack([np.interp(driven_s, drive.time_s, each) for each in drive.position.T], axis=1)
    return replace(drive, position=position, rotation=Slerp(drive.time_s, drive.rotation)(driven_s))
