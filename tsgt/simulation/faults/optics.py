"""Faults of optics and power in the field: heat shimmer, rain, another robot's prisms, reflections, a battery that runs down."""

from __future__ import annotations

import asyncio
import math
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from tsgt.geometry import exp_so3, transform_points
from tsgt.simulation.faults.catalogue import RELOCK_DELAY_S, FaultKind, log_uniform
from tsgt.simulation.faults.targets import target_station
from tsgt.simulation.instrument.optical_disturbances import HeatShimmer, Multipath, Rain

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from tsgt.simulation.faults.catalogue import Fault
    from tsgt.simulation.instrument import SimulatedTotalStation
    from tsgt.simulation.instrument.optical_disturbances import OpticalDisturbance
    from tsgt.simulation.mission import Mission

_NOON_STRUCTURE: Final = (1e-13, 6e-13)
_HOURS: Final = (8.0, 18.0)
_CORRELATION_S: Final = (0.2, 0.6)

_RAIN_MMPH: Final = (2.0, 50.0)
_LOCK_LOSSES_HZ: Final = 0.05  # by drops on the optics, in the heaviest rain
_LOCK_LOSS_S: Final = (0.1, 3.0)

_ROBOTS_APART_M: Final = (2.0, 8.0)

_MULTIPATH_M: Final = (0.01, 3.0)
_MIRROR_M: Final = (0.1, 3.0)  # from the prism to the reflecting surface

_SLOWEST: Final = 4.0
_DEAD_SHARE: Final = 0.2
_NEARLY_EMPTY_PERCENT: Final = (15.0, 35.0)
_EMPTY_PERCENT: Final = 2.0
_NEW_PERCENT: Final = 95.0
_FADING_STEP_S: Final = 1.0


async def _shimmer(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    if _is_disturbed_by(HeatShimmer, mission):
        return
    noon, hour, correlation_s = (
        log_uniform(rng, _NOON_STRUCTURE),
        rng.uniform(*_HOURS),
        rng.uniform(*_CORRELATION_S),
    )
    hour -= fault.at_s / 3600.0
    disturbances = [
        HeatShimmer(noon, hour, correlation_s, each) for each in rng.spawn(len(mission.instruments))
    ]
    await _disturb_all(mission, fault, disturbances)


async def _rain(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    if _is_disturbed_by(Rain, mission):
        return
    rate_mmph = log_uniform(rng, _RAIN_MMPH)
    generators = rng.spawn(len(mission.instruments))
    drops = [
        asyncio.create_task(_lose_locks(instrument, fault.duration_s, rate_mmph, each))
        for instrument, each in zip(mission.instruments.values(), generators, strict=True)
    ]
    await _disturb_all(
        mission, fault, [Rain(rate_mmph, each) for each in rng.spawn(len(mission.instruments))]
    )
    await asyncio.gather(*drops)


async def _lose_locks(
    instrument: SimulatedTotalStation, for_s: float, rate_mmph: float, rng: np.random.Generator
) -> None:
    mean_s = _RAIN_MMPH[1] / rate_mmph / _LOCK_LOSSES_HZ
    left_s = for_s
    while left_s > (until_s := rng.exponential(mean_s)):
        await asyncio.sleep(until_s)
        hidden_s = min(log_uniform(rng, _LOCK_LOSS_S), left_s - until_s)
        instrument.blocked = True
        await asyncio.sleep(hidden_s)
        instrument.blocked = False
        left_s -= until_s + hidden_s


def _is_disturbed_by(weather: type, mission: Mission) -> bool:
    """Whether there is such weather already: it does not add up."""
    return any(
        isinstance(each, weather)
        for instrument in mission.instruments.values()
        for each in instrument.disturbances
    )


async def _disturb_all(mission: Mission, fault: Fault, disturbances: Sequence[OpticalDisturbance]) -> None:
    pairs = list(zip(mission.instruments.values(), disturbances, strict=True))
    for instrument, disturbance in pairs:
        instrument.disturbances.append(disturbance)
    await asyncio.sleep(fault.duration_s)
    for instrument, disturbance in pairs:
        instrument.disturbances.remove(disturbance)


async def _second_robot(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    """Let another robot pass behind or before the robot, in line with a station; all instruments see its prisms."""
    station, until_s = target_station(fault), fault.at_s + fault.duration_s
    pose = mission.world.pose_at(np.array([fault.at_s]))[0]
    frame = next(each for each in mission.parameters.stations if each.station == station)
    line_of_sight = pose[:3, 3] - np.array(frame.T_station1_station)[:3, 3]
    line_of_sight[2] = 0.0
    apart_m = rng.choice([-1.0, 1.0]) * rng.uniform(*_ROBOTS_APART_M)
    meeting_m = pose[:3, 3] + apart_m * line_of_sight / np.linalg.norm(line_of_sight)
    # It drives as the robot does at another time, from another place and in another direction.
    other_s = rng.uniform(0.0, max(mission.world.duration_s - fault.duration_s, 0.0))
    turn = exp_so3(np.array([0.0, 0.0, rng.uniform(-math.pi, math.pi)]))
    start_m = mission.world.pose_at(np.array([other_s]))[0, :3, 3]

    def track(position_m: tuple[float, float, float], times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        points = _positions(mission, position_m, times_s - fault.at_s + other_s)
        placed: NDArray[np.float64] = meeting_m + (points - start_m) @ turn.T
        return placed

    for number, instrument in mission.instruments.items():
        added = {
            each.prism: instrument.add_prism(partial(track, each.position_m), fault.at_s, until_s, each.prism)
            for each in mission.parameters.prisms
        }
        if number == station:
            instrument.take_over(added[mission.prisms[station]])
    await asyncio.sleep(fault.duration_s)


async def _window(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    instrument = mission.instruments[target_station(fault)]
    if rng.random() < 0.5:
        multipath = Multipath(log_uniform(rng, _MULTIPATH_M))
        instrument.disturbances.append(multipath)
        await asyncio.sleep(fault.duration_s)
        instrument.disturbances.remove(multipath)
        return
    prism = mission.prisms[target_station(fault)]
    position_m = next(each.position_m for each in mission.parameters.prisms if each.prism == prism)
    towards = rng.uniform(0.0, math.tau)
    normal = np.array([math.cos(towards), math.sin(towards), 0.0])
    at_start = _positions(mission, position_m, np.array([fault.at_s]))[0]
    surface_m = at_start + log_uniform(rng, _MIRROR_M) * normal

    def image(times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        points = _positions(mission, position_m, times_s)
        mirrored: NDArray[np.float64] = points - 2.0 * ((points - surface_m) @ normal)[:, None] * normal
        return mirrored

    instrument.take_over(instrument.add_prism(image, fault.at_s, fault.at_s + fault.duration_s, prism))
    await asyncio.sleep(fault.duration_s)


async def _battery_fading(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    number = target_station(fault)
    instrument = mission.instruments[number]
    begin_percent = rng.uniform(*_NEARLY_EMPTY_PERCENT)
    fades_s = max((1 - _DEAD_SHARE) * fault.duration_s, _FADING_STEP_S)
    if instrument.battery_percent < begin_percent:
        return  # another one of its batteries runs down
    while instrument.on and (share := (mission.now_s - fault.at_s) / fades_s) < 1.0:
        instrument.battery_percent = begin_percent + share * (_EMPTY_PERCENT - begin_percent)
        instrument.slow_down(_SLOWEST**share)
        await asyncio.sleep(_FADING_STEP_S)
    instrument.switch_off()
    await asyncio.sleep(_DEAD_SHARE * fault.duration_s)
    instrument.battery_percent = _NEW_PERCENT
    instrument.slow_down(1.0)
    instrument.switch_on()
    await asyncio.sleep(rng.uniform(*RELOCK_DELAY_S))
    if instrument.on:
        instrument.lock_manually(mission.prisms[number])


def _positions(
    mission: Mission, position_m: tuple[float, float, float], times_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the positions of a prism of the robot in ``station1``, (N, 3), at any N instants."""
    inside_s = np.clip(times_s, 0.0, mission.world.duration_s)
    return transform_points(mission.world.pose_at(inside_s), np.array(position_m))


OPTICS_INJECTORS: Final[
    Mapping[FaultKind, Callable[[Mission, Fault, np.random.Generator], Awaitable[None]]]
] = {
    FaultKind.SHIMMER: _shimmer,
    FaultKind.RAIN: _rain,
    FaultKind.SECOND_ROBOT: _second_robot,
    FaultKind.WINDOW: _window,
    FaultKind.BATTERY_FADING: _battery_fading,
}
