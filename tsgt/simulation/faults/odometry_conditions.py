"""Faults of the wheel odometry as conditions of its samples, which are simulated before the mission."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from tsgt.simulation.faults.catalogue import FaultKind
from tsgt.simulation.imu import Silence, StuckValues
from tsgt.simulation.wheel_odometry import WheelSlip

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tsgt.simulation.faults.catalogue import Fault
    from tsgt.simulation.wheel_odometry import OdometryCondition

_SLIDING: Final = (0.5, 0.95)
_SPINNING: Final = (1.05, 2.5)


def odometry_conditions(faults: Iterable[Fault]) -> tuple[OdometryCondition, ...]:
    """Return the conditions of the faults of the wheel odometry among these."""
    found = (_condition(fault, np.random.default_rng(fault.seed)) for fault in faults)
    return tuple(condition for condition in found if condition is not None)


def _condition(fault: Fault, rng: np.random.Generator) -> OdometryCondition | None:
    match fault.kind:
        case FaultKind.ODOMETRY_SILENCE:
            return Silence(fault.at_s, fault.duration_s)
        case FaultKind.ODOMETRY_STUCK:
            return StuckValues(fault.at_s, fault.duration_s)
        case FaultKind.ODOMETRY_SLIP:
            factors = 0.0, rng.uniform(*_SLIDING), rng.uniform(*_SPINNING)
            return WheelSlip(fault.at_s, fault.duration_s, float(rng.choice(factors)))
        case _:
            return None
