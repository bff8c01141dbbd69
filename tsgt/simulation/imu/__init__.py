"""The robot's IMU in the simulated world. Sans-I/O.

In: the motion of the robot at any instant, a scenario's IMU, conditions (faults). Out: `DeviceSamples` as a device delivers
them, with counter, own clock and arrival, and `ImuTruth`.
"""

from tsgt.simulation.imu.conditions import (
    DeviceClockJump,
    Dropout,
    ImuCondition,
    Knock,
    LateBurst,
    Saturation,
    Silence,
    StuckValues,
)
from tsgt.simulation.imu.environment import Environment
from tsgt.simulation.imu.presets import IMU_MODELS, INDUSTRIAL
from tsgt.simulation.imu.program import DeviceProgram, ImuProgram
from tsgt.simulation.imu.samples import DeviceSamples, Mounting, SimulatedImuRun
from tsgt.simulation.imu.synthesis import ideal_samples, mounting_of, simulate_imu

__all__ = [
    "IMU_MODELS",
    "INDUSTRIAL",
    "DeviceClockJump",
    "DeviceProgram",
    "DeviceSamples",
    "Dropout",
    "Environment",
    "ImuCondition",
    "ImuProgram",
    "Knock",
    "LateBurst",
    "Mounting",
    "Saturation",
    "Silence",
    "SimulatedImuRun",
    "StuckValues",
    "ideal_samples",
    "mounting_of",
    "simulate_imu",
]
