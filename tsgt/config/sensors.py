"""Configuration of the robot's own sensors: IMU and wheel odometry."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from tsgt.config.base import Argument, Model, Place, Positive, RelativePath
from tsgt.model import ImuNoise, ImuParameters, OdometryParameters, Row4, Vector3

Ratio = Annotated[float, Field(gt=0, le=50)]
Speed = Annotated[float, Field(gt=0, le=10_000)]

_G = 9.80665
_DEG = math.radians(1.0)

IMU_NOISE: dict[str, ImuNoise] = {
    # VectorNav VN-100, Xsens MTi-300 and MTi-630, ADIS1647x: between the figures of their data sheets.
    "industrial": ImuNoise(
        gyro_noise_density=0.005 * _DEG,
        accelerometer_noise_density=80e-6 * _G,
        gyro_bias_walk=0.0005 * _DEG,
        accelerometer_bias_walk=8e-6 * _G,
        gyro_bias_radps=0.15 * _DEG,
        accelerometer_bias_mps2=3e-3 * _G,
        gyro_scale_misalignment=1e-4,
        accelerometer_scale_misalignment=7e-4,
    ),
    # Chips in lidars and cameras: Bosch BMI088, TDK ICM-20948.
    "consumer": ImuNoise(
        gyro_noise_density=0.014 * _DEG,
        accelerometer_noise_density=190e-6 * _G,
        gyro_bias_walk=0.002 * _DEG,
        accelerometer_bias_walk=30e-6 * _G,
        gyro_bias_radps=0.7 * _DEG,
        accelerometer_bias_mps2=20e-3 * _G,
        gyro_scale_misalignment=1e-3,  # Once calibrated: 0.03 %/K as it warms up
        accelerometer_scale_misalignment=7e-3,
    ),
}
"""Noise of two classes of IMUs."""

_MOUNTING_KEYS = ("position_m", "orientation_xyzw", "latency_ms", "gyro_matrix")

Density = Annotated[float, Field(gt=0, le=1e3)] | None


class ImuNoiseConfig(Model):
    """Noise of the IMU, one sigma per axis: a class of devices, and what its data sheet states otherwise."""

    preset: Literal["industrial", "consumer"] = "industrial"
    """Class of the device: calibrated over temperature in the factory, or a chip."""
    gyro_noise_density_radps_per_sqrt_hz: Density = None
    """White noise of the angular rate; default: the preset's."""
    accelerometer_noise_density_mps2_per_sqrt_hz: Density = None
    """White noise of the specific force; default: the preset's."""
    gyro_bias_walk_radps_per_sqrt_s: Density = None
    """Random walk of the gyro's bias; default: the preset's."""
    accelerometer_bias_walk_mps2_per_sqrt_s: Density = None
    """Random walk of the accelerometer's bias; default: the preset's."""
    gyro_bias_radps: Density = None
    """Bias of the gyro after switching on; default: the preset's."""
    accelerometer_bias_mps2: Density = None
    """Bias of the accelerometer after switching on; default: the preset's."""
    gyro_scale_misalignment: Density = None
    """Error of each entry of ``gyro_matrix``, of its calibration and by temperature since; default: the preset's."""
    accelerometer_scale_misalignment: Density = None
    """Scale error and misalignment of the accelerometer's axes; default: the preset's."""

    def noise(self) -> ImuNoise:
        """Return the noise in SI units."""
        preset = IMU_NOISE[self.preset]
        return ImuNoise(
            gyro_noise_density=self.gyro_noise_density_radps_per_sqrt_hz or preset.gyro_noise_density,
            accelerometer_noise_density=self.accelerometer_noise_density_mps2_per_sqrt_hz
            or preset.accelerometer_noise_density,
            gyro_bias_walk=self.gyro_bias_walk_radps_per_sqrt_s or preset.gyro_bias_walk,
            accelerometer_bias_walk=self.accelerometer_bias_walk_mps2_per_sqrt_s
            or preset.accelerometer_bias_walk,
            gyro_bias_radps=self.gyro_bias_radps or preset.gyro_bias_radps,
            accelerometer_bias_mps2=self.accelerometer_bias_mps2 or preset.accelerometer_bias_mps2,
            gyro_scale_misalignment=self.gyro_scale_misalignment or preset.gyro_scale_misalignment,
            accelerometer_scale_misalignment=self.accelerometer_scale_misalignment
            or preset.accelerometer_scale_misalignment,
        )


class ImuConfig(Model):
    """IMU of the robot, read by a program."""

    command: Annotated[tuple[Argument, ...], Field(min_length=1)]
    """Program that reads the IMU, with its arguments; see the reference of its lines. An absolute path in the field."""
    name: str = "imu"
    """Name of the IMU's frame."""
    mounting: RelativePath | None = None
    """File of kind ``imu_mounting``, written by ``tsgt calibrate imu``, instead of the next four keys."""
    position_m: Place | None = None
    """Origin of its axes in the robot frame, [x, y, z]. For the drive that calibrates it any will do."""
    orientation_xyzw: Row4 | None = None
    """Unit quaternion [x, y, z, w] that rotates coordinates in its axes into the robot frame."""
    latency_ms: Annotated[float, Field(ge=-10_000, le=10_000)] | None = None
    """Latency from a sample to its timestamp, subtracted from it. Positive: the timestamp is late; default 0."""
    gyro_matrix: tuple[Vector3, Vector3, Vector3] | None = None
    """Scale factors and misalignment of the gyro: the angular rate is this matrix times the sample, less the bias; default: the
    identity."""
    noise: ImuNoiseConfig = ImuNoiseConfig()
    """Noise of the samples."""
    gravity_mps2: Annotated[float, Field(ge=9.7, le=9.9)] | None = None
    """Gravity where the robot drives, unless latitude and height are given."""
    latitude_deg: Annotated[float, Field(ge=-90, le=90)] | None = None
    """Latitude of the place, from which gravity follows."""
    height_m: Annotated[float, Field(ge=-500, le=9_000)] = 0.0
    """Height of the place above sea level."""
    tilt_sigma_mrad: Annotated[float, Field(ge=0, le=100)] = 0.1
    """One sigma, per axis, of the angle between the z axis of station 1 and the vertical."""
    stall_timeout_s: Positive = 2.0
    """The program is restarted if it prints no usable sample for this long."""

    @model_validator(mode="after")
    def _possible(self) -> ImuConfig:
        if (self.gravity_mps2 is None) == (self.latitude_deg is None):
            raise ValueError("give either gravity_mps2 or latitude_deg")
        given = [name for name in _MOUNTING_KEYS if getattr(self, name) is not None]
        if self.mounting is not None and given:
            raise ValueError(f"give either mounting or {given[0]}")
        if self.mounting is None and not {"position_m", "orientation_xyzw"} <= set(given):
            raise ValueError("give either mounting, or position_m and orientation_xyzw")
        self.parameters()
        return self

    def parameters(self) -> ImuParameters:
        """Return the parameters in SI units, at the robot's origin if a file has the mounting.

        Raises ValueError if there are none such.
        """
        gravity = self.gravity_mps2
        if gravity is None:
            gravity = normal_gravity_mps2(self.latitude_deg or 0.0, self.height_m)
        return ImuParameters(
            name=self.name,
            position_m=self.position_m or (0.0, 0.0, 0.0),
            orientation_xyzw=self.orientation_xyzw or (0.0, 0.0, 0.0, 1.0),
            latency_ns=round((self.latency_ms or 0.0) * 1e6),
            gyro_matrix=self.gyro_matrix or ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
            noise=self.noise.noise(),
            gravity_mps2=gravity,
            tilt_sigma_rad=self.tilt_sigma_mrad / 1e3,
        )


def normal_gravity_mps2(latitude_deg: float, height_m: float) -> float:
    """Return normal gravity of the ellipsoid WGS 84 at a latitude and a height above it.

    Somigliana's formula, and its series for small heights: NIMA TR8350.2 (2000), equations 4-1 and 4-3. Local anomalies
    are below 0.002 m/s^2 nearly everywhere.
    """
    sine2 = math.sin(math.radians(latitude_deg)) ** 2
    on_ellipsoid = 9.7803253359 * (1 + 0.00193185265241 * sine2) / math.sqrt(1 - 0.00669437999013 * sine2)
    a, f, m = 6_378_137.0, 1 / 298.257223563, 0.00344978650684
    return on_ellipsoid * (1 - 2 * (1 + f + m - 2 * f * sine2) * height_m / a + 3 * (height_m / a) ** 2)


class OdometryConfig(Model):
    """Wheel odometry of the robot, read by a program; it is used with the IMU."""

    command: Annotated[tuple[Argument, ...], Field(min_length=1)]
    """Program that reads the odometry, with its arguments; see the reference of its lines. An absolute path in the field."""
    position_m: Place = (0.0, 0.0, 0.0)
    """Point of the robot whose speed the wheels tell, in the robot frame, [x, y, z]: the centre of the axle that does not steer; of
    tracks, the middle between them."""
    orientation_xyzw: Row4 = (0.0, 0.0, 0.0, 1.0)
    """Unit quaternion [x, y, z, w] that rotates coordinates in the axes of the wheels (x forwards, z up) into the robot frame."""
    latency_ms: Annotated[float, Field(ge=-10_000, le=10_000)] = 0.0
    """Latency from a sample to its timestamp, subtracted from it. Positive: the timestamp is late."""
    speed_noise_mmps: Speed = 10.0
    """White noise of the speed of a sample."""
    scale_percent: Ratio = 2.0
    """One sigma of the speed's relative error that stays: load, tyres, a wrong radius."""
    slip_percent: Ratio = 3.0
    """One sigma of the speed's relative error that comes and goes."""
    slip_correlation_time_s: Annotated[float, Field(ge=0.1, le=3600)] = 5.0
    """How long slip lasts."""
    direction_deg: Annotated[float, Field(gt=0, le=25)] = 1.0
    """One sigma of the direction in which the robot goes straight ahead."""
    lateral_mmps: Speed = 20.0
    """One sigma of the mean velocity across the wheels over a second."""
    vertical_mmps: Speed = 30.0
    """One sigma of the mean velocity of the point along the z axis of the wheels over a second."""
    turning_mm: Annotated[float, Field(ge=0, le=10_000)] = 50.0
    """One sigma of the distance between `position_m` and the point that does not slide sideways in a turn."""
    stall_timeout_s: Positive = 2.0
    """The program is restarted if it prints no usable sample for this long."""

    def parameters(self) -> OdometryParameters:
        """Return the parameters in SI units. Raises ValueError if there are none such."""
        return OdometryParameters(
            position_m=self.position_m,
            orientation_xyzw=self.orientation_xyzw,
            latency_ns=round(self.latency_ms * 1e6),
            speed_noise_mps=self.speed_noise_mmps / 1e3,
            scale_sigma=self.scale_percent / 100,
            slip_sigma=self.slip_percent / 100,
            slip_correlation_time_s=self.slip_correlation_time_s,
            direction_sigma_rad=math.radians(self.direction_deg),
            lateral_sigma_mps=self.lateral_mmps / 1e3,
            vertical_sigma_mps=self.vertical_mmps / 1e3,
            turning_sigma_m=self.turning_mm / 1e3,
        )
