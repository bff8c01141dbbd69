"""Faults of computers in the field: slow SD cards, suspension, and what NTP does to a clock."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from tsgt.simulation.faults.catalogue import FaultKind
from tsgt.simulation.faults.targets import target_computer, target_station
from tsgt.simulation.kernel import DriftingClock
from tsgt.simulation.mission import station_name

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    import numpy as np

    from tsgt.simulation.faults.catalogue import Fault
    from tsgt.simulation.mission import Mission

NTP_SLEW_PPM: Final = 500.0
"""At most as fast the kernel slews a clock for NTP."""

_DISK_STALL_S: Final = (0.2, 6.0)
_DISK_WORKS_S: Final = 1.0  # mean time between two stalls
_NTP_AFTER_BOOT_S: Final = (1.0, 15.0)


async def _slow_disk(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    disk = mission.computers[target_computer(fault)].disk
    ends_s = fault.at_s + fault.duration_s
    while (now_s := mission.now_s) < ends_s:
        until_s = min(now_s + rng.uniform(*_DISK_STALL_S), ends_s)
        disk.stall(round(now_s * 1e9), round(until_s * 1e9))
        await mission.sleep_until(until_s)
        await asyncio.sleep(rng.exponential(_DISK_WORKS_S))


async def _suspend(mission: Mission, fault: Fault, _rng: np.random.Generator) -> None:
    await mission.suspend(target_station(fault), fault.duration_s)


async def _ntp_boot_step(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    station = target_station(fault)
    await mission.reboot(station, fault.at_s, fault.duration_s)
    await asyncio.sleep(rng.uniform(*_NTP_AFTER_BOOT_S))
    clock = mission.computers[station_name(station)].clock
    clock.step(mission.clock.realtime_ns() - clock.realtime_ns())


async def _ntp_slew(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    clock = mission.computers[station_name(target_station(fault))].clock
    if not isinstance(clock, DriftingClock) or target_station(fault) in mission.drifting:
        return
    mission.drifting.add(target_station(fault))
    ppm = NTP_SLEW_PPM * rng.choice([-1.0, 1.0])
    clock.change_drift(ppm)
    await asyncio.sleep(fault.duration_s)
    clock.change_drift(-ppm)
    mission.drifting.discard(target_station(fault))


COMPUTER_INJECTORS: Final[
    Mapping[FaultKind, Callable[[Mission, Fault, np.random.Generator], Awaitable[None]]]
] = {
    FaultKind.SLOW_DISK: _slow_disk,
    FaultKind.SUSPEND: _suspend,
    FaultKind.NTP_BOOT_STEP: _ntp_boot_step,
    FaultKind.NTP_SLEW: _ntp_slew,
}
