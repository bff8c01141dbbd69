"""What operators set up wrongly, until they have found it: key, radio, station numbers, constants, a second master."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from tsgt.config import MAX_STATION_NUMBERS
from tsgt.radio.superframe.wire import KEY_BYTES
from tsgt.simulation.faults.catalogue import FaultKind
from tsgt.simulation.faults.targets import target_station
from tsgt.simulation.mission import SetupMistake

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    import numpy as np

    from tsgt.simulation.faults.catalogue import Fault
    from tsgt.simulation.mission import Mission

_ROUND_PRISM_MM: Final = 34.4


async def _mistake(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    station, numbers = target_station(fault), list(mission.station_logs)
    mistakes = {
        FaultKind.WRONG_KEY: SetupMistake(key=rng.bytes(KEY_BYTES)),
        FaultKind.OTHER_SPREADING_FACTOR: SetupMistake(spreading_factor=8),
        FaultKind.OTHER_PROTOCOL: SetupMistake(other_protocol=True),
        FaultKind.UNKNOWN_STATION: SetupMistake(
            station=MAX_STATION_NUMBERS["superframe" if mission.superframe else "classic"]
        ),
        FaultKind.SAME_STATION: SetupMistake(station=numbers[(numbers.index(station) + 1) % len(numbers)]),
        FaultKind.PRISM_CONSTANT: SetupMistake(prism_constant_mm=_ROUND_PRISM_MM),
    }
    await mission.make_mistake(station, mistakes[fault.kind], fault.at_s + fault.duration_s)


async def _second_master(mission: Mission, fault: Fault, _rng: np.random.Generator) -> None:
    await mission.run_second_master(fault.duration_s)


MISTAKE_INJECTORS: Final[
    Mapping[FaultKind, Callable[[Mission, Fault, np.random.Generator], Awaitable[None]]]
] = {
    FaultKind.WRONG_KEY: _mistake,
    FaultKind.OTHER_SPREADING_FACTOR: _mistake,
    FaultKind.OTHER_PROTOCOL: _mistake,
    FaultKind.UNKNOWN_STATION: _mistake,
    FaultKind.SAME_STATION: _mistake,
    FaultKind.PRISM_CONSTANT: _mistake,
    FaultKind.SECOND_MASTER: _second_master,
}
