"""Faults of an IMU as conditions of its samples, and errors of its set-up. Times in s from the start of the mission."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, assert_never

import numpy as np

from tsgt.geometry import exp_so3, quaternion_from_rotation
from tsgt.model import ImuParameters
from tsgt.simulation.imu.arrival import hold_back
from tsgt.simulation.imu.samples import DeviceSamples, Mounting

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.config import ImuSetupErrorConfig
    from tsgt.simulation.imu.samples import ImuTruth


@dataclass(frozen=True, slots=True)
class Dropout:
    """Samples are lost at random; they are counted."""

    at_s: float
    duration_s: float
    probability: float


@dataclass(frozen=True, slots=True)
class Silence:
    """The device delivers nothing, and continues to count."""

    at_s: float
    duration_s: float


@dataclass(frozen=True, slots=True)
class StuckValues:
    """The device repeats its last values; counter and clock run on."""

    at_s: float
    duration_s: float


@dataclass(frozen=True, slots=True)
class DeviceClockJump:
    """The clock of the device jumps, positive: forwards, and stays so; back to zero at most, where it begins."""

    at_s: float
    jump_s: float


@dataclass(frozen=True, slots=True)
class LateBurst:
    """Samples are held back and arrive in one burst at the end."""

    at_s: float
    duration_s: float


@dataclass(frozen=True, slots=True)
class Saturation:
    """The motion exceeds a measuring range that is set too small."""

    at_s: float
    duration_s: float
    angular_rate_radps: float
    specific_force_mps2: float


@dataclass(frozen=True, slots=True)
class Knock:
    """The IMU is displaced on the robot, and stays so."""

    at_s: float
    rotation_rad: tuple[float, float, float]  # about the axes of the IMU
    displacement_m: tuple[float, float, float]  # along the robot's axes

    def knocked(self, mounting: Mounting) -> Mounting:
        """Return the mounting afterwards."""
        return Mounting(
            mounting.R_robot_imu @ exp_so3(np.array(self.rotation_rad)),
            mounting.position_m + np.array(self.displacement_m),
        )


ImuCondition = Dropout | Silence | StuckValues | DeviceClockJump | LateBurst | Saturation | Knock


def apply_conditions(
    samples: DeviceSamples, conditions: Sequence[ImuCondition], generator: np.random.Generator
) -> DeviceSamples:
    """Apply conditions to samples in the order of time; a knock is part of the motion and has no effect here."""
    for condition in sorted(conditions, key=lambda each: each.at_s):
        match condition:
            case Dropout():
                lost = _during(samples, condition) & (generator.random(len(samples)) < condition.probability)
                samples = samples.select(~lost)
            case Silence():
                samples = samples.select(~_during(samples, condition))
            case StuckValues():
                samples = _stuck(samples, _during(samples, condition))
            case DeviceClockJump():
                later = samples.end_s >= condition.at_s
                least_ns = -int(samples.device_ns[later].min(initial=np.iinfo(np.int64).max))
                jump_ns = max(round(condition.jump_s * 1e9), least_ns)
                samples = replace(samples, device_ns=samples.device_ns + np.where(later, jump_ns, 0))
            case LateBurst():
                until_s = condition.at_s + condition.duration_s
                samples = replace(samples, arrival_s=hold_back(samples.arrival_s, condition.at_s, until_s))
            case Saturation():
                samples = _saturated(samples, condition)
            case Knock():
                pass
            case _:
                assert_never(condition)
    return samples


def _during(
    samples: DeviceSamples, condition: Dropout | Silence | StuckValues | Saturation
) -> NDArray[np.bool_]:
    return (samples.end_s >= condition.at_s) & (samples.end_s < condition.at_s + condition.duration_s)


def _stuck(samples: DeviceSamples, rows: NDArray[np.bool_]) -> DeviceSamples:
    if not rows.any():
        return samples
    source = np.arange(len(samples))
    source[rows] = max(0, int(np.argmax(rows)) - 1)
    return replace(
        samples,
        angular_rate_radps=samples.angular_rate_radps[source],
        specific_force_mps2=samples.specific_force_mps2[source],
    )


def _saturated(samples: DeviceSamples, condition: Saturation) -> DeviceSamples:
    rows = _during(samples, condition)[:, None]

    def clipped(values: NDArray[np.float64], limit: float) -> NDArray[np.float64]:
        return np.where(rows, np.clip(values, -limit, limit), values)

    return replace(
        samples,
        angular_rate_radps=clipped(samples.angular_rate_radps, condition.angular_rate_radps),
        specific_force_mps2=clipped(samples.specific_force_mps2, condition.specific_force_mps2),
    )


def apply_setup_errors(samples: DeviceSamples, errors: ImuSetupErrorConfig) -> DeviceSamples:
    """Apply what the program that reads the IMU does wrong."""
    rate, force = samples.angular_rate_radps, samples.specific_force_mps2
    if errors.axes_swapped:
        # A rotation like that between axes north-east-down and axes east-north-up.
        rate, force = (each[:, [1, 0, 2]] * (1.0, 1.0, -1.0) for each in (rate, force))
    if errors.degrees:
        rate = np.degrees(rate)
    if errors.gravity_inverted:
        force = -force
    return replace(samples, angular_rate_radps=rate, specific_force_mps2=force)


def configured_parameters(truth: ImuTruth, errors: ImuSetupErrorConfig) -> ImuParameters:
    """Return the parameters in the configuration of the master: exact as after a calibration without errors, plus these errors."""
    axis = np.full(3, math.radians(errors.rotation_deg) / math.sqrt(3.0))
    qx, qy, qz, qw = quaternion_from_rotation(truth.mounting.R_robot_imu @ exp_so3(axis)).tolist()
    x, y, z = truth.mounting.position_m.tolist()
    first, second, third = ((a, b, c) for a, b, c in np.linalg.inv(truth.gyro_matrix).tolist())
    return ImuParameters(
        position_m=(x + errors.position_mm / 1e3, y, z),
        orientation_xyzw=(qx, qy, qz, qw),
        latency_ns=round(truth.latency_s * 1e9 + errors.latency_ms * 1e6),
        gyro_matrix=(first, second, third),
        noise=truth.noise,
        gravity_mps2=float(np.linalg.norm(truth.gravity_mps2)),
    )
