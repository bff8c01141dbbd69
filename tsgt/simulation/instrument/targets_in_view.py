"""What there is to be seen from one simulated station: prisms, foil targets, and the faults that the scenario has."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from tsgt.config import level_frame
from tsgt.geometry import cartesian_to_polar, invert, transform_points
from tsgt.simulation.instrument.telescope import Lock
from tsgt.simulation.instrument.visibility import Sight, apart_rad
from tsgt.station.geocom import ReturnCode

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.config import ScenarioConfig, SimulatedStation
    from tsgt.simulation.instrument.telescope import Telescope
    from tsgt.simulation.instrument.visibility import Direction2
    from tsgt.simulation.world import World

BEAM_M: Final = 0.05
BEAM_RAD: Final = 0.0005
"""A prism or target so far beside the crosshairs still reflects: by so much, and by so much more per metre."""

FAULT_CODES: Final = {
    "tilt": ReturnCode.TMC_ANGLE_OK,
    "wrong_distance": ReturnCode.TMC_DIST_PPM,
    "angle_only": ReturnCode.TMC_ANGLE_OK,
}
"""What becomes of a distance that is due; as long as it is tilted too far it gives no angles either."""


class Seen(NamedTuple):
    """What the telescope was at when a distance was due.

    Attributes
    ----------
    point
        What reflects, in the frame of the station, (3,) in m; None: nothing.
    prism
        Its number; None for a target.
    followed
        Whether the telescope followed it.
    direction
        Where the telescope pointed.
    code
        Why there is nothing.
    """

    point: NDArray[np.float64] | None
    prism: int | None
    followed: bool
    direction: Direction2
    code: ReturnCode


class Scenery:
    """Prisms and targets around a station.

    Parameters
    ----------
    station
        Which of the scenario's stations it is.
    scenario
        Prisms, targets and faults.
    world
        The truth.

    Attributes
    ----------
    sights
        By the prisms' numbers.
    targets
        Foil targets in the frame of the station, each (3,) in m.
    """

    def __init__(self, station: SimulatedStation, scenario: ScenarioConfig, world: World) -> None:
        faults = [fault for fault in scenario.faults if fault.station == station.station]
        self._faults = [fault for fault in faults if fault.status != "no_target"]
        # What hides its prism from a station hides the whole robot.
        spans_s = world.occlusions_s.get(station.station, np.empty((0, 2))).tolist()
        spans_s += [[fault.start_s, fault.end_s] for fault in faults if fault.status == "no_target"]
        hidden_s = [(from_s, to_s) for from_s, to_s in spans_s]
        self.sights = {
            prism.prism: Sight(station, world, row, hidden_s) for row, prism in enumerate(scenario.prisms)
        }
        T_station_station1 = invert(np.array(level_frame(station)))
        self.targets = [
            transform_points(T_station_station1, np.array(target)) for target in scenario.targets_m
        ]

    def fault_at(self, world_s: float) -> str | None:
        """Return the fault of an instant; hidden prisms are none."""
        if not self._faults:
            return None
        return next((f.status for f in self._faults if f.start_s <= world_s < f.end_s), None)

    def look(self, world_s: float, telescope: Telescope, *, foil: bool) -> Seen:
        """See what reflects at an instant to which the telescope has advanced: a prism, or with ``foil`` a target."""
        direction = telescope.direction()

        def nothing(code: ReturnCode) -> Seen:
            return Seen(None, None, followed=False, direction=direction, code=code)

        fault = self.fault_at(world_s)
        if fault is not None:
            return nothing(FAULT_CODES[fault])
        if telescope.lock is Lock.PREDICTED:
            return nothing(ReturnCode.TMC_ANGLE_OK)
        if telescope.blocked or telescope.moving:
            return nothing(ReturnCode.TMC_DIST_ERROR)
        if foil:
            for point in self.targets:
                if _in_beam(point, direction):
                    return Seen(point, None, followed=False, direction=direction, code=ReturnCode.OK)
        elif telescope.lock is Lock.IN and telescope.prism is not None:
            point = self.sights[telescope.prism].point_at(world_s)
            return Seen(point, telescope.prism, followed=True, direction=direction, code=ReturnCode.OK)
        else:
            for prism, sight in self.sights.items():
                point = sight.point_at(world_s)
                if sight.visible_at(world_s) and _in_beam(point, direction):
                    return Seen(point, prism, followed=False, direction=direction, code=ReturnCode.OK)
        return nothing(ReturnCode.TMC_DIST_ERROR)

    def met_on_the_way(
        self,
        world_s: float,
        way_rad: tuple[float, float],
        height_rad: tuple[float, float],
        range_m: tuple[float, float],
        only: int | None,
    ) -> tuple[int, float] | None:
        """Return the first prism that PowerSearch comes across, and how far it has turned until then; None: none.

        Parameters
        ----------
        world_s
            When.
        way_rad
            Horizontal direction that it starts at, and how far it turns; positive: clockwise.
        height_rad
            Zenith angle of the middle and half the height of the strip that it sees.
        range_m
            Between these distances a reflection is taken for a prism.
        only
            The only prism that counts; None: all.
        """
        start_rad, turn_rad = way_rad
        met: list[tuple[float, int]] = []
        for prism, sight in self.sights.items():
            horizontal, zenith = sight.direction_at(world_s)
            until_rad = math.copysign(1.0, turn_rad) * (horizontal - start_rad) % math.tau
            inside = until_rad <= abs(turn_rad) and abs(zenith - height_rad[0]) <= height_rad[1]
            if inside and only in (None, prism) and not sight.lost_at(world_s):
                distance_m = float(np.linalg.norm(sight.point_at(world_s)))
                if range_m[0] <= distance_m <= range_m[1]:
                    met.append((until_rad, prism))
        return (min(met)[1], min(met)[0]) if met else None


def direction_of(point: NDArray[np.float64]) -> Direction2:
    """Return the direction of a point in the frame of the station."""
    horizontal, zenith, _ = cartesian_to_polar(point)
    return float(horizontal), float(zenith)


def _in_beam(point: NDArray[np.float64], direction: Direction2) -> bool:
    """Tell whether a point reflects what is sent out in a direction."""
    distance_m = float(np.linalg.norm(point))
    beside_m = math.hypot(*apart_rad(direction_of(point), direction)) * distance_m
    return beside_m < BEAM_M + BEAM_RAD * distance_m
