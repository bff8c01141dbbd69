"""Classes of IMUs with the figures of their data sheets.

A value is one standard deviation over devices or over missions, unless it says otherwise. A class is no product: where the
sheets of its members differ, the value lies between them, and where they are silent it is an assumption, which is marked.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from tsgt.config import IMU_NOISE

if TYPE_CHECKING:
    from tsgt.model import ImuNoise

_DEG = math.radians(1.0)
_G = 9.80665
_MG = 1e-3 * _G


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuModel:
    """Properties of a class of IMUs."""

    rate_hz: float
    noise: ImuNoise
    gyro_scale_misalignment: float
    """Error of each entry of the gyro's matrix of scale factors and misalignment."""
    accelerometer_scale_misalignment: float
    """The same of the accelerometer."""
    gyro_g_sensitivity: float
    """Entries of the matrix that takes specific force to an error of the angular rate, in rad/s per m/s^2."""
    gyro_bias_per_k: float
    """Temperature coefficient of the gyro's bias in rad/s/K."""
    accelerometer_bias_per_k: float
    """The same of the accelerometer in m/s^2/K."""
    gyro_scale_per_k: float
    """Temperature coefficient of the gyro's scale factors in 1/K."""
    accelerometer_scale_per_k: float
    """The same of the accelerometer."""
    gyro_range_radps: float
    """Limit of the angular rate on each axis; beyond it the values saturate. Not random."""
    accelerometer_range_mps2: float
    """The same of the specific force."""
    gyro_resolution_radps: float
    """Step of the values. Not random."""
    accelerometer_resolution_mps2: float
    """The same of the specific force."""
    clock_skew_ppm: float
    """Skew of the device's clock."""
    clock_skew_ppm_per_k: float
    """Temperature coefficient of the skew."""
    clock_resolution_ns: int
    """Step of the device's timestamps. Not random."""
    warm_up_k: float
    """Temperature rise after switching on, in the end. Not random."""
    warm_up_time_s: float
    """Time constant of the warm-up. Not random."""


INDUSTRIAL: Final = ImuModel(
    rate_hz=200.0,
    noise=IMU_NOISE["industrial"],
    gyro_scale_misalignment=7e-4,
    accelerometer_scale_misalignment=7e-4,
    gyro_g_sensitivity=0.001 * _DEG / _G,
    gyro_bias_per_k=0.0005 * _DEG,
    accelerometer_bias_per_k=0.02 * _MG,
    gyro_scale_per_k=1e-5,
    accelerometer_scale_per_k=1e-5,
    gyro_range_radps=450 * _DEG,
    accelerometer_range_mps2=10 * _G,
    gyro_resolution_radps=1e-6,
    accelerometer_resolution_mps2=1e-5,
    clock_skew_ppm=10.0,
    clock_skew_ppm_per_k=0.05,
    clock_resolution_ns=1_000,
    warm_up_k=5.0,
    warm_up_time_s=600.0,
)
"""Calibrated over temperature in the factory: VectorNav VN-100, Xsens MTi-630 and MTi-300, MicroStrain GX5, ADIS1647x.

Noise: :data:`tsgt.config.IMU_NOISE`. Sources, typical values. VN-100 (user manual UM001, section 2): gyro 0.0035 deg/s/sqrt(Hz), accelerometer
0.14 mg/sqrt(Hz), alignment 0.05 deg (9e-4), 16 g, binary output of 32-bit floats with a clock of 1 ns since startup. MTi-630
(600-series data sheet MT1603P): 0.007 deg/s/sqrt(Hz), 60 ug/sqrt(Hz), g-sensitivity 0.001 deg/s/g, non-orthogonality 0.05 deg, 10 g, bias
repeatability over a year 0.5 deg/s and 5 mg. MTi-300 (Movella, May 2023): 0.01 deg/s/sqrt(Hz), 60 ug/sqrt(Hz),
0.003 deg/s/g, 450 deg/s. The bias walks give an Allan deviation after some minutes of the order of the sheets' bias instabilities (5 to
10 deg/h) times a margin. Assumed: what temperature calibration leaves, and the clock.
"""

CONSUMER: Final = ImuModel(
    rate_hz=200.0,
    noise=IMU_NOISE["consumer"],
    gyro_scale_misalignment=7e-3,
    accelerometer_scale_misalignment=7e-3,
    gyro_g_sensitivity=0.03 * _DEG / _G,
    gyro_bias_per_k=0.015 * _DEG,
    accelerometer_bias_per_k=0.2 * _MG,
    gyro_scale_per_k=3e-4,
    accelerometer_scale_per_k=2e-5,
    gyro_range_radps=500 * _DEG,
    accelerometer_range_mps2=6 * _G,
    gyro_resolution_radps=500 * _DEG / 32768,
    accelerometer_resolution_mps2=6 * _G / 32768,
    clock_skew_ppm=50.0,
    clock_skew_ppm_per_k=0.3,
    clock_resolution_ns=39_062,
    warm_up_k=5.0,
    warm_up_time_s=300.0,
)
"""A chip inside a lidar or a camera, uncalibrated: Bosch BMI088, TDK ICM-20948.

Noise: :data:`tsgt.config.IMU_NOISE`. Sources, typical values. BMI088 (data sheet BST-BMI088-DS001): gyro 0.014 deg/s/sqrt(Hz), offset 1 deg/s,
0.015 deg/s/K, sensitivity tolerance 1 %, 0.03 %/K, cross axis 1 %, g-sensitivity at most 0.1 deg/s/g; accelerometer 160 to 190 ug/sqrt(Hz),
offset 20 mg, 0.2 mg/K, 0.002 %/K, cross axis 0.5 %; 16 bits, ranges of 500 deg/s and 6 g; clock ticks of 39.0625 us.
ICM-20948 (data sheet DS-000189): gyro 0.015 deg/s/sqrt(Hz), 5 deg/s, 1.5 %, cross axis 2 %; accelerometer 230 ug/sqrt(Hz), 0.5 %, cross
axis 2 %, 25 mg, 0.8 mg/K. Assumed: bias walks, warm-up, and a clock from a quartz (the chips' own oscillators are worse).
"""

IMU_MODELS: Final = {"industrial": INDUSTRIAL, "consumer": CONSUMER}
