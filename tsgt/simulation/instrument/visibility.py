"""What a simulated total station could see of a prism: where it is, and whether a telescope could follow it there."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.config import level_frame
from tsgt.geometry import cartesian_to_polar, invert, transform_points

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.config import SimulatedStation
    from tsgt.simulation.world import World

STEP_S = 0.02
"""How finely is looked whether the telescope can follow."""

HEAD_SPEED_RADPS = math.radians(45.0)
"""No faster than this the telescope turns: the limit of MOT_SetVelocity in the manual of the TPS1200."""

FIELD_RAD = math.radians(0.75)
"""Half the field of view of the target recognition: 1.66 gon wide, by the manual of the TPS1200."""

NARROW_FIELD_RAD = FIELD_RAD / 3
"""The same when it is reduced: a ninth of the area."""

SERVO_S = 0.1
"""How far ahead the drives aim, with constant angular speed; an assumption. A prism that is outside the field of view
then is lost."""

LEAST_DISTANCE_M = 1.5
"""Closer than this the target recognition does not work, by the manual of the TS12P."""

_BLOCK = 512
_SERVO_STEPS = round(SERVO_S / STEP_S)

Direction2 = tuple[float, float]
"""Horizontal and zenith angle in rad."""


class Sight:
    """One prism as one station sees it, at any time; computed block by block when asked for.

    Before the start of the world and after its end everything stands still.

    Parameters
    ----------
    station
        Who looks.
    world
        The truth.
    row
        Row of the prism in the world's layout.
    hidden_s
        When something is in the way, from and to in s from the start.
    """

    def __init__(
        self,
        station: SimulatedStation,
        world: World,
        row: int,
        hidden_s: Sequence[tuple[float, float]],
    ) -> None:
        self._world = world
        self._row = row
        self._hidden_s = hidden_s
        self._T_station_station1 = invert(np.array(level_frame(station)))
        self._blocks: dict[int, _Block] = {}

    def point_at(self, world_s: float) -> NDArray[np.float64]:
        """Return the prism in the frame of the station, (3,) in m, at an instant in s from the start."""
        point: NDArray[np.float64] = self._points(np.array([world_s]))[0]
        return point

    def direction_at(self, world_s: float) -> Direction2:
        """Return the direction of the prism at the step before or at an instant in s from the start."""
        step = math.floor(world_s / STEP_S)
        return self._block(step).directions[step % _BLOCK]

    def speed_at(self, world_s: float) -> float:
        """Return how fast it moves across the line of sight, in rad/s."""
        return (
            math.hypot(*apart_rad(self.direction_at(world_s), self.direction_at(world_s - SERVO_S))) / SERVO_S
        )

    def lost_at(self, world_s: float) -> bool:
        """Tell whether no telescope could follow it at an instant: it is hidden, too close, or too fast."""
        step = math.floor(world_s / STEP_S)
        return bool(self._block(step).lost[step % _BLOCK])

    def visible_at(self, world_s: float) -> bool:
        """Tell whether nothing is in the way at an instant in s from the start."""
        return not any(from_s <= world_s < to_s for from_s, to_s in self._hidden_s)

    def first_lost(self, from_s: float, to_s: float) -> float | None:
        """Return the first instant at which no telescope could follow it, to a step; None if there is none."""
        step, last = math.floor(from_s / STEP_S), math.floor(to_s / STEP_S)
        while step <= last:
            index = step % _BLOCK
            end = min(_BLOCK, index + last - step + 1)
            found = self._block(step).lost.find(1, index, end)
            if found >= 0:
                return max(from_s, (step - index + found) * STEP_S)
            step += end - index
        return None

    def _points(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        inside_s = np.minimum(np.maximum(times_s, 0.0), self._world.duration_s)
        return transform_points(self._T_station_station1, self._world.prism_at(inside_s, self._row))

    def _block(self, step: int) -> _Block:
        number = step // _BLOCK
        block = self._blocks.get(number)
        if block is None:
            if len(self._blocks) > 1:
                del self._blocks[min(self._blocks)]
            block = self._blocks[number] = self._make(number)
        return block

    def _make(self, number: int) -> _Block:
        before = 2 * _SERVO_STEPS
        steps = number * _BLOCK + np.arange(-before, _BLOCK, dtype=np.float64)
        times_s = steps * STEP_S
        points = self._points(times_s)
        distance_m = np.linalg.norm(points, axis=1)
        unit = points / np.maximum(distance_m, 1e-9)[:, None]
        now, then, earlier = unit[before:], unit[_SERVO_STEPS:-_SERVO_STEPS], unit[:-before]
        speed_radps = np.linalg.norm(now - then, axis=1) / SERVO_S
        miss_rad = np.linalg.norm(now - 2 * then + earlier, axis=1)
        lost = speed_radps > HEAD_SPEED_RADPS
        lost |= miss_rad > FIELD_RAD
        lost |= distance_m[before:] < LEAST_DISTANCE_M
        for from_s, to_s in self._hidden_s:
            lost |= (from_s <= times_s[before:]) & (times_s[before:] < to_s)
        horizontal, zenith, _ = cartesian_to_polar(points[before:])
        directions = list(zip(horizontal.tolist(), zenith.tolist(), strict=True))
        return _Block(lost.astype(np.uint8).tobytes(), directions)


class _Block:
    """A stretch of time in steps: whether the prism is lost, and its direction."""

    __slots__ = ("directions", "lost")

    def __init__(self, lost: bytes, directions: list[Direction2]) -> None:
        self.lost = lost
        self.directions = directions


def apart_rad(one: Direction2, other: Direction2) -> tuple[float, float]:
    """Return by how much two directions differ, across and up, as angles on the sphere in rad; both positive."""
    across = abs(math.remainder(one[0] - other[0], math.tau)) * math.sin(other[1])
    return across, abs(one[1] - other[1])
