"""Tripods that sink, are kicked, turn in the sun, or are set up elsewhere; and robots that roll over."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Final

import numpy as np

from tsgt.simulation.faults.catalogue import FaultKind, log_uniform
from tsgt.simulation.faults.targets import target_station
from tsgt.simulation.world import STOP_S, Rollover

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Mapping

    from tsgt.simulation.faults.catalogue import Fault
    from tsgt.simulation.mission import Mission

SINK_MPS: Final = 0.005 / 3600
"""A tripod on soft ground sinks by 5 mm in an hour; a fault sinks up to :data:`SINK_FACTOR` times faster, as a mission takes minutes."""

SINK_FACTOR: Final = 60.0

SUN_RADPS: Final = (10e-6 / 60, 100e-6 / 60)
"""Rotation of a tripod about the vertical with the sun on one leg, minimum and maximum."""

KICK_M: Final = (0.001, 0.050)
KICK_RAD: Final = (0.0001, 0.005)

_STEP_S = 1.0  # of slow movements
_RESOLUTION_S = (
    1e-6  # virtual time has whole nanoseconds, so that the rest of a duration may be too short to pass
)
_SUN_TILT_RADPS = 10e-6 / 60  # within the compensator's range for hours
_LEVEL_RAD = 0.3e-3  # tilt of a tripod that was levelled by its bubble
_BEYOND_COMPENSATOR_RAD = 3e-3
_NOT_LEVEL_PROBABILITY = 0.3
_DROP_SHARE = 0.3  # of the vertical in the displacement by a kick
_SET_UP_S: Final = (4.0, 15.0)
_SET_UP_M: Final = (0.3, 4.0)
_HEIGHT_M = 0.2
_RECALIBRATED_PROBABILITY = 0.7

_ROLL_S: Final = (1.0, 2.0)
_ROLL_RAD: Final = (math.radians(90.0), math.radians(180.0))
_ROLLED_BACK_S = 1.0  # lies at least that long


async def _sink(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    sink_mps = SINK_MPS * SINK_FACTOR ** rng.random()
    while (left_s := fault.at_s + fault.duration_s - mission.now_s) > _RESOLUTION_S:
        await asyncio.sleep(step_s := min(_STEP_S, left_s))
        mission.move_station(target_station(fault), (0.0, 0.0, -sink_mps * step_s), 0.0)


async def _sun(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    turn_radps = rng.choice([-1.0, 1.0]) * log_uniform(rng, SUN_RADPS)
    direction_rad = rng.uniform(0.0, math.tau)
    tilt_radps = _SUN_TILT_RADPS * math.cos(direction_rad), _SUN_TILT_RADPS * math.sin(direction_rad)
    instrument = mission.instruments[target_station(fault)]
    while (left_s := fault.at_s + fault.duration_s - mission.now_s) > _RESOLUTION_S:
        await asyncio.sleep(step_s := min(_STEP_S, left_s))
        across, along = instrument.tilt_rad
        instrument.tilt_rad = across + tilt_radps[0] * step_s, along + tilt_radps[1] * step_s
        mission.move_station(target_station(fault), (0.0, 0.0, 0.0), turn_radps * step_s)


async def _kick(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    """Displace, turn and tilt a tripod at once; beyond the compensator's range, somebody levels it again at the end."""
    instrument = mission.instruments[target_station(fault)]
    direction = rng.standard_normal(3) * (1.0, 1.0, _DROP_SHARE)
    shift_m = log_uniform(rng, KICK_M) * direction / np.linalg.norm(direction)
    turn_rad = rng.choice([-1.0, 1.0]) * log_uniform(rng, KICK_RAD)
    mission.move_station(target_station(fault), shift_m.tolist(), turn_rad)
    instrument.tilt_rad = _LEVEL_RAD * rng.uniform(-1, 1), _LEVEL_RAD * rng.uniform(-1, 1)
    if rng.random() < _NOT_LEVEL_PROBABILITY:
        level, instrument.tilt_rad = instrument.tilt_rad, (_BEYOND_COMPENSATOR_RAD, 0.0)
        await asyncio.sleep(fault.duration_s)
        instrument.tilt_rad = level


async def _move(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    """Carry an instrument to another place, where it has another zero; it measures again, and is calibrated at the end or never."""
    instrument = mission.instruments[target_station(fault)]
    instrument.blocked = True
    await asyncio.sleep(min(rng.uniform(*_SET_UP_S), fault.duration_s))
    bearing_rad, away_m = rng.uniform(0.0, math.tau), rng.uniform(*_SET_UP_M)
    shift_m = away_m * math.cos(bearing_rad), away_m * math.sin(bearing_rad), _HEIGHT_M * rng.uniform(-1, 1)
    mission.move_station(target_station(fault), shift_m, rng.uniform(-math.pi, math.pi))
    instrument.tilt_rad = _LEVEL_RAD * rng.uniform(-1, 1), _LEVEL_RAD * rng.uniform(-1, 1)
    instrument.blocked = False
    if instrument.on:
        instrument.lock_manually(mission.prisms[target_station(fault)])
    await mission.sleep_until(fault.at_s + fault.duration_s)
    if rng.random() < _RECALIBRATED_PROBABILITY:
        await mission.recalibrate()


def rollovers(faults: Iterable[Fault]) -> tuple[Rollover, ...]:
    """Return the rollovers among the faults, without those that begin before another one is over or have no time to end."""
    found: list[Rollover] = []
    for fault in faults:
        if fault.kind != FaultKind.ROBOT_ROLLOVER:
            continue
        rng = np.random.default_rng(fault.seed)
        angle_rad = float(rng.choice([-1.0, 1.0]) * rng.uniform(*_ROLL_RAD))
        each = Rollover(fault.at_s, float(rng.uniform(*_ROLL_S)), fault.at_s + fault.duration_s, angle_rad)
        free_s = found[-1].until_s + 2 * STOP_S if found else 0.0
        if each.at_s >= free_s and fault.duration_s >= 2 * each.roll_s + _ROLLED_BACK_S:
            found.append(each)
    return tuple(found)


TRIPOD_INJECTORS: Final[
    Mapping[FaultKind, Callable[[Mission, Fault, np.random.Generator], Awaitable[None]]]
] = {
    FaultKind.TRIPOD_SINK: _sink,
    FaultKind.TRIPOD_KICK: _kick,
    FaultKind.TRIPOD_SUN: _sun,
    FaultKind.STATION_MOVED: _move,
}
