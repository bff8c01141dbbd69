"""Targets in view of a simulated station: prisms, foil targets, and the scenario's faults."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from tsgt.config import level_frame
from tsgt.geometry import cartesian_to_polar, invert, transform_points
from tsgt.simulation.instrument.telescope import Lock
from tsgt.simulation.instrument.visibility import STEP_S, PrismVisibility, angular_separation_rad
from tsgt.station.geocom import ReturnCode

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.config import ScenarioConfig, SimulatedStation
    from tsgt.simulation.instrument.telescope import Telescope
    from tsgt.simulation.instrument.visibility import PolarDirection, PrismTrack
    from tsgt.simulation.world import World

BEAM_M: Final = 0.05
BEAM_RAD: Final = 0.0005
"""Beam radius: a target within BEAM_M plus BEAM_RAD times the distance of the line of sight reflects."""

FOREIGN_PRISMS: Final = 1000
"""Targets with higher numbers are no prisms of the robot."""

FAULT_CODES: Final = {
    "tilt": ReturnCode.TMC_ANGLE_OK,
    "wrong_distance": ReturnCode.TMC_DIST_PPM,
    "angle_only": ReturnCode.TMC_ANGLE_OK,
}
"""Return code of a distance during a fault of the scenario; "tilt" suppresses the angles as well."""


class TargetObservation(NamedTuple):
    """What reflects at the time of a distance measurement.

    Attributes
    ----------
    point
        Position of the target in the frame of the station, (3,) in m; None: no target.
    """

    point: NDArray[np.float64] | None
    prism: int | None  # None: a foil target
    followed: bool  # whether the telescope is locked on it
    direction: PolarDirection  # direction of the telescope
    code: ReturnCode  # GeoCOM return code; of the failure if there is no target


class TargetsInView:
    """Prisms and foil targets around a station."""

    def __init__(self, station: SimulatedStation, scenario: ScenarioConfig, world: World) -> None:
        faults = [fault for fault in scenario.faults if fault.station == station.station]
        self._faults = [fault for fault in faults if fault.status != "no_target"]
        # An occlusion hides all prisms of the robot from this station.
        spans_s = world.occlusions_s.get(station.station, np.empty((0, 2))).tolist()
        spans_s += [[fault.start_s, fault.end_s] for fault in faults if fault.status == "no_target"]
        occluded_s = [(from_s, to_s) for from_s, to_s in spans_s]
        self.prisms = {
            prism.prism: PrismVisibility(station, partial(_prism_at, world, row), occluded_s, prism.prism)
            for row, prism in enumerate(scenario.prisms)
        }
        self._station = station
        self._foils_m = scenario.targets_m
        self.foils = self._foils_from(station)  # foil targets in the frame of the station, each (3,) in m

    def move(self, station: SimulatedStation) -> None:
        """See everything from where this station says, and as the world is from now on."""
        self._station = station
        self.foils = self._foils_from(station)
        for visibility in self.prisms.values():
            visibility.move(station)

    def add(self, track: PrismTrack, from_s: float, to_s: float, target_id: int) -> int:
        """Add another prism, or its image in a mirror, that is in sight for a while; return its number here."""
        number = max(*self.prisms, FOREIGN_PRISMS) + 1
        hidden_s = ((-math.inf, from_s - STEP_S), (to_s, math.inf))  # in sight at once, whatever the step
        self.prisms[number] = PrismVisibility(self._station, track, hidden_s, target_id)
        return number

    def _foils_from(self, station: SimulatedStation) -> list[NDArray[np.float64]]:
        T_station_station1 = invert(np.array(level_frame(station)))
        return [transform_points(T_station_station1, np.array(target)) for target in self._foils_m]

    def fault_at(self, world_s: float) -> str | None:
        """Return the scenario's fault at an instant, occlusions excluded."""
        if not self._faults:
            return None
        return next((f.status for f in self._faults if f.start_s <= world_s < f.end_s), None)

    def observe(self, world_s: float, telescope: Telescope, *, foil: bool) -> TargetObservation:
        """Return the reflecting target at an instant to which the telescope has advanced: a prism, or with ``foil`` a foil target."""
        direction = telescope.direction()

        def nothing(code: ReturnCode) -> TargetObservation:
            return TargetObservation(None, None, followed=False, direction=direction, code=code)

        fault = self.fault_at(world_s)
        if fault is not None:
            return nothing(FAULT_CODES[fault])
        if telescope.lock is Lock.PREDICTED:
            return nothing(ReturnCode.TMC_ANGLE_OK)
        if telescope.blocked or telescope.moving:
            return nothing(ReturnCode.TMC_DIST_ERROR)
        if foil:
            for point in self.foils:
                if _in_beam(point, direction):
                    return TargetObservation(
                        point, None, followed=False, direction=direction, code=ReturnCode.OK
                    )
        elif telescope.lock is Lock.IN and telescope.prism is not None:
            point = self.prisms[telescope.prism].point_at(world_s)
            return TargetObservation(
                point, telescope.prism, followed=True, direction=direction, code=ReturnCode.OK
            )
        else:
            for prism, visibility in self.prisms.items():
                point = visibility.point_at(world_s)
                if visibility.visible_at(world_s) and _in_beam(point, direction):
                    return TargetObservation(
                        point, prism, followed=False, direction=direction, code=ReturnCode.OK
                    )
        return nothing(ReturnCode.TMC_DIST_ERROR)

    def power_search(
        self,
        world_s: float,
        way_rad: tuple[float, float],
        height_rad: tuple[float, float],
        range_m: tuple[float, float],
        target_id: int | None,
    ) -> tuple[int, float] | None:
        """Return the first prism that PowerSearch meets and the angle turned until then; None: there is none.

        Parameters
        ----------
        way_rad
            Initial horizontal direction and angle to turn; positive: clockwise.
        height_rad
            Zenith angle of the centre of the search strip, and half its height.
        range_m
            Accepted distances.
        target_id
            Number of the only prism accepted; None: all.
        """
        start_rad, turn_rad = way_rad
        met: list[tuple[float, int]] = []
        for prism, visibility in self.prisms.items():
            horizontal, zenith = visibility.direction_at(world_s)
            until_rad = math.copysign(1.0, turn_rad) * (horizontal - start_rad) % math.tau
            inside = until_rad <= abs(turn_rad) and abs(zenith - height_rad[0]) <= height_rad[1]
            if inside and target_id in (None, visibility.target_id) and not visibility.lost_at(world_s):
                distance_m = float(np.linalg.norm(visibility.point_at(world_s)))
                if range_m[0] <= distance_m <= range_m[1]:
                    met.append((until_rad, prism))
        return (min(met)[1], min(met)[0]) if met else None


def _prism_at(world: World, row: int, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the track of a prism of the robot, which rests before and after the world's duration."""
    return world.prism_at(np.minimum(np.maximum(times_s, 0.0), world.duration_s), row)


def direction_to(point: NDArray[np.float64]) -> PolarDirection:
    """Return the direction of a point in the frame of the station."""
    horizontal, zenith, _ = cartesian_to_polar(point)
    return float(horizontal), float(zenith)


def _in_beam(point: NDArray[np.float64], direction: PolarDirection) -> bool:
    """Whether a point reflects a beam in this direction."""
    distance_m = float(np.linalg.norm(point))
    offset_m = math.hypot(*angular_separation_rad(direction_to(point), direction)) * distance_m
    return offset_m < BEAM_M + BEAM_RAD * distance_m
