"""What happens to daemons and computers in the hours of a field day: edited configurations, a master that sleeps, a full disk."""

from __future__ import annotations

import asyncio
import errno
from typing import TYPE_CHECKING, Final

from tsgt.config import ReferencePointConfig
from tsgt.simulation.faults.catalogue import FaultKind
from tsgt.simulation.faults.targets import target_computer
from tsgt.simulation.mission import MasterEdit, SetupMistake

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    import numpy as np

    from tsgt.simulation.faults.catalogue import Fault
    from tsgt.simulation.mission import Mission

_OTHER_CHANNEL_MHZ: Final = 907.4
_RESTART_S: Final = 2.0  # the restart that takes an edit back ends with the fault
_CONSTANT_MM: Final = 0.3
_LIDAR: Final = ReferencePointConfig(
    name="lidar", position_m=(0.25, 0.0, 0.62), orientation_xyzw=(0.0, 0.0, 0.0, 1.0)
)


def draw_edit(mission: Mission, rng: np.random.Generator) -> MasterEdit:
    """Draw what an operator changes in the master's configuration: one thing."""
    other = "linear" if mission.parameters.pipeline.estimator == "continuous" else "continuous"
    edits = [
        MasterEdit(pipeline={"rate_hz": float(rng.choice([5.0, 10.0, 25.0]))}),
        MasterEdit(pipeline={"smoothed_delays_s": (0.5, 2.0)}),
        MasterEdit(pipeline={"outage_limit_s": 0.7, "lag_s": 2.0}),
        MasterEdit(reference_point=_LIDAR),
        MasterEdit(prism_constants_by_mm=float(rng.uniform(-_CONSTANT_MM, _CONSTANT_MM))),
        MasterEdit(frequency_mhz=_OTHER_CHANNEL_MHZ),
    ]
    if mission.imu is None:
        edits.append(MasterEdit(pipeline={"estimator": other}))
        edits.append(MasterEdit(without_station=int(rng.choice(list(mission.station_logs)))))
    return edits[rng.integers(len(edits))]


async def _config_edit(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    until_s = fault.at_s + fault.duration_s - _RESTART_S
    if fault.station is None:
        await mission.edit_master(draw_edit(mission, rng), until_s)
        return
    numbers = list(mission.station_logs)
    other = numbers[(numbers.index(fault.station) + 1) % len(numbers)]
    mistakes = [
        SetupMistake(frequency_mhz=_OTHER_CHANNEL_MHZ),
        SetupMistake(prism=mission.prisms[other]),
    ]
    await mission.make_mistake(fault.station, mistakes[rng.integers(len(mistakes))], until_s)


async def _master_suspend(mission: Mission, fault: Fault, _rng: np.random.Generator) -> None:
    await mission.suspend_master(fault.duration_s)


async def _long_disk_full(mission: Mission, fault: Fault, _rng: np.random.Generator) -> None:
    disk = mission.computers[target_computer(fault)].disk
    disk.fail_writes(errno.ENOSPC, round(fault.at_s * 1e9), round((fault.at_s + fault.duration_s) * 1e9))
    await asyncio.sleep(fault.duration_s)
    disk.write_error = None


OPERATION_INJECTORS: Final[
    Mapping[FaultKind, Callable[[Mission, Fault, np.random.Generator], Awaitable[None]]]
] = {
    FaultKind.CONFIG_EDIT: _config_edit,
    FaultKind.MASTER_SUSPEND: _master_suspend,
    FaultKind.LONG_DISK_FULL: _long_disk_full,
}
