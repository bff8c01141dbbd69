"""Faults of a mission: drawn from the seed, injected at their times, removed before the fault-free tail.

In: kinds of faults, a random generator, a running mission. Out: `draw_faults` gives the faults, `inject_fault` applies one;
`imu_conditions` and `odometry_conditions` give those of IMU and wheels, whose samples are simulated before the mission.
"""

from tsgt.simulation.faults.catalogue import (
    FAST_SYNC_CYCLES,
    FAULT_FREE_START_S,
    FAULT_FREE_TAIL_S,
    FIELD_DAY_FAULTS,
    IMU_FAULTS,
    ODOMETRY_FAULTS,
    Fault,
    FaultKind,
    draw_faults,
    parse_faults,
)
from tsgt.simulation.faults.computers import NTP_SLEW_PPM
from tsgt.simulation.faults.imu_conditions import KNOCK_DISPLACEMENT_M, KNOCK_ROTATION_RAD, imu_conditions
from tsgt.simulation.faults.injection import inject_fault, relock_instruments
from tsgt.simulation.faults.odometry_conditions import odometry_conditions
from tsgt.simulation.faults.tripods import rollovers

__all__ = [
    "FAST_SYNC_CYCLES",
    "FAULT_FREE_START_S",
    "FAULT_FREE_TAIL_S",
    "FIELD_DAY_FAULTS",
    "IMU_FAULTS",
    "KNOCK_DISPLACEMENT_M",
    "KNOCK_ROTATION_RAD",
    "NTP_SLEW_PPM",
    "ODOMETRY_FAULTS",
    "Fault",
    "FaultKind",
    "draw_faults",
    "imu_conditions",
    "inject_fault",
    "odometry_conditions",
    "parse_faults",
    "relock_instruments",
    "rollovers",
]
