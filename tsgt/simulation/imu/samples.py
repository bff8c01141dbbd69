"""What a simulated IMU gives, as arrays, and the truth about it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from tsgt.model import ImuNoise, ImuParameters


@dataclass(frozen=True, slots=True)
class Mounting:
    """Where the IMU is on the robot."""

    R_robot_imu: NDArray[np.float64]  # (3, 3)
    position_m: NDArray[np.float64]  # (3,) origin of its axes in frame ``robot``


@dataclass(frozen=True, slots=True)
class DeviceSamples:
    """N samples as a device delivers them, in the order of delivery.

    ``end_s`` and ``duration_s`` are the truth; a program that reads the device sees the other arrays.
    """

    counter: NDArray[np.int64]  # (N,) numbers of the samples; lost ones are counted
    device_ns: NDArray[np.int64]  # (N,) end of each interval on the clock of the device, from its start
    arrival_s: NDArray[
        np.float64
    ]  # (N,) arrival at the host on true time, in s from the start of the mission
    end_s: NDArray[np.float64]  # (N,) true end of each interval, in s from the start of the mission
    duration_s: NDArray[np.float64]  # (N,) true length of each interval
    angular_rate_radps: NDArray[np.float64]  # (N, 3) in the axes of the IMU
    specific_force_mps2: NDArray[np.float64]  # (N, 3)
    temperature_c: NDArray[np.float64]  # (N,)

    def __len__(self) -> int:
        return len(self.end_s)

    def select(self, rows: slice | NDArray[np.intp] | NDArray[np.bool_]) -> DeviceSamples:
        """Return the samples of some rows."""
        return DeviceSamples(*(getattr(self, each.name)[rows] for each in fields(self)))


@dataclass(frozen=True, slots=True)
class ImuTruth:
    """The truth about a simulated IMU; an angular rate is ``gyro_matrix`` times the true one, plus bias and noise."""

    mounting: Mounting
    latency_s: float  # from the end of an interval to its earliest arrival
    gyro_matrix: NDArray[np.float64]  # (3, 3) at the start
    accelerometer_matrix: NDArray[np.float64]  # (3, 3) at the start
    gyro_bias_radps: NDArray[np.float64]  # (N, 3) at each sample, without the effect of specific force
    accelerometer_bias_mps2: NDArray[np.float64]  # (N, 3)
    gravity_mps2: NDArray[np.float64]  # (3,) in frame ``station1``
    earth_rate_radps: NDArray[np.float64]  # (3,) in frame ``station1``
    noise: ImuNoise


@dataclass(frozen=True, slots=True)
class SimulatedImuRun:
    """All samples of an IMU in a mission, the truth, and the parameters in the configuration of the master."""

    samples: DeviceSamples
    truth: ImuTruth
    parameters: ImuParameters  # exact unless the scenario has errors of the set-up
