"""Faults of the IMU as conditions of its samples, which are simulated before the mission."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from tsgt.simulation.faults.catalogue import FaultKind, log_uniform
from tsgt.simulation.imu import (
    DeviceClockJump,
    Dropout,
    Knock,
    LateBurst,
    Saturation,
    Silence,
    StuckValues,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tsgt.simulation.faults.catalogue import Fault
    from tsgt.simulation.imu import ImuCondition

_DROPOUT_PROBABILITIES: Final = (0.01, 0.1, 0.5)
_JUMP_S: Final = (0.002, 120.0)
# Below what driving and shaking reach, so that values are clipped again and again.
_RATE_LIMIT_RADPS: Final = (0.05, 0.4)
_FORCE_LIMIT_MPS2: Final = (9.0, 12.0)
KNOCK_ROTATION_RAD: Final = math.radians(1.0)
KNOCK_DISPLACEMENT_M: Final = 0.020


def imu_conditions(faults: Iterable[Fault]) -> tuple[ImuCondition, ...]:
    """Return the conditions of the faults of the IMU among these."""
    found = (_condition(fault, np.random.default_rng(fault.seed)) for fault in faults)
    return tuple(condition for condition in found if condition is not None)


def _condition(fault: Fault, rng: np.random.Generator) -> ImuCondition | None:
    match fault.kind:
        case FaultKind.IMU_DROPOUT:
            return Dropout(fault.at_s, fault.duration_s, float(rng.choice(_DROPOUT_PROBABILITIES)))
        case FaultKind.IMU_SILENCE:
            return Silence(fault.at_s, fault.duration_s)
        case FaultKind.IMU_STUCK:
            return StuckValues(fault.at_s, fault.duration_s)
        case FaultKind.IMU_CLOCK_JUMP:
            size_s = log_uniform(rng, _JUMP_S)
            return DeviceClockJump(fault.at_s, float(rng.choice((-1.0, 1.0))) * size_s)
        case FaultKind.IMU_LATE_BURST:
            return LateBurst(fault.at_s, fault.duration_s)
        case FaultKind.IMU_SATURATION:
            limits = rng.uniform(*_RATE_LIMIT_RADPS), rng.uniform(*_FORCE_LIMIT_MPS2)
            return Saturation(fault.at_s, fault.duration_s, *limits)
        case FaultKind.IMU_KNOCK:
            rotation, displacement = rng.standard_normal((2, 3))
            rotation *= KNOCK_ROTATION_RAD / np.linalg.norm(rotation)
            displacement *= KNOCK_DISPLACEMENT_M / np.linalg.norm(displacement)
            return Knock(fault.at_s, tuple(rotation.tolist()), tuple(displacement.tolist()))
        case _:
            return None
