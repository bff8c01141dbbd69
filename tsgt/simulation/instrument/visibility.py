"""Visibility of a prism from a station: its direction, and whether a telescope can track it there."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.config import level_frame
from tsgt.geometry import cartesian_to_polar, invert, transform_points

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from tsgt.config import SimulatedStation

STEP_S = 0.02
"""Time resolution of the trackability test."""

MAX_TURN_RATE_RADPS = math.radians(45.0)
"""Maximum turn rate: limit of MOT_SetVelocity in the TPS1200 manual."""

HALF_FIELD_OF_VIEW_RAD = math.radians(0.75)
"""Half the ATR field of view: 1.66 gon wide, by the TPS1200 manual."""

REDUCED_HALF_FIELD_OF_VIEW_RAD = HALF_FIELD_OF_VIEW_RAD / 3
"""The same with reduced field of view: a ninth of the area."""

SERVO_LOOKAHEAD_S = 0.1
"""Interval over which the drives extrapolate with constant angular speed; an assumption. A prism outside the field of view
after it is lost.
"""

MIN_TRACKING_DISTANCE_M = 1.5
"""Minimum distance of target recognition, by the TS12P manual."""

_BLOCK = 512
_SERVO_LOOKAHEAD_STEPS = round(SERVO_LOOKAHEAD_S / STEP_S)

PolarDirection = tuple[float, float]
"""Horizontal and zenith angle in rad."""

if TYPE_CHECKING:
    PrismTrack = Callable[[NDArray[np.float64]], NDArray[np.float64]]
    """Positions of a prism in ``station1``, (N, 3) in m, at N instants in s from the start of the world."""


class PrismVisibility:
    """One prism as one station sees it, computed in blocks on request.

    ``target_id``: the number by which an instrument recognises it, if the prisms are active ones.
    """

    def __init__(
        self,
        station: SimulatedStation,
        track: PrismTrack,
        occluded_s: Sequence[tuple[float, float]],
        target_id: int,
    ) -> None:
        self._track = track
        self._occluded_s = occluded_s
        self.target_id = target_id
        self._T_station_station1 = invert(np.array(level_frame(station)))
        self._blocks: dict[int, _Block] = {}

    def move(self, station: SimulatedStation) -> None:
        """See the prism from where this station says; forget what was computed ahead."""
        self._T_station_station1 = invert(np.array(level_frame(station)))
        self._blocks.clear()

    def point_at(self, world_s: float) -> NDArray[np.float64]:
        """Return the position in the frame of the station, (3,) in m, at an instant in s from the start."""
        point: NDArray[np.float64] = self._points(np.array([world_s]))[0]
        return point

    def direction_at(self, world_s: float) -> PolarDirection:
        """Return the direction at the last step not after an instant in s from the start."""
        step = math.floor(world_s / STEP_S)
        return self._block(step).directions[step % _BLOCK]

    def speed_at(self, world_s: float) -> float:
        """Return the angular speed across the line of sight in rad/s."""
        return (
            math.hypot(
                *angular_separation_rad(
                    self.direction_at(world_s), self.direction_at(world_s - SERVO_LOOKAHEAD_S)
                )
            )
            / SERVO_LOOKAHEAD_S
        )

    def lost_at(self, world_s: float) -> bool:
        """Whether it cannot be tracked at an instant: occluded, too close, or too fast."""
        step = math.floor(world_s / STEP_S)
        return bool(self._block(step).lost[step % _BLOCK])

    def visible_at(self, world_s: float) -> bool:
        """Whether it is not occluded at an instant in s from the start."""
        return not any(from_s <= world_s < to_s for from_s, to_s in self._occluded_s)

    def first_lost(self, from_s: float, to_s: float) -> float | None:
        """Return the first instant of an interval at which it cannot be tracked, to a step; None: there is none."""
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
        return transform_points(self._T_station_station1, self._track(times_s))

    def _block(self, step: int) -> _Block:
        number = step // _BLOCK
        block = self._blocks.get(number)
        if block is None:
            if len(self._blocks) > 1:
                del self._blocks[min(self._blocks)]
            block = self._blocks[number] = self._compute(number)
        return block

    def _compute(self, number: int) -> _Block:
        before = 2 * _SERVO_LOOKAHEAD_STEPS
        steps = number * _BLOCK + np.arange(-before, _BLOCK, dtype=np.float64)
        times_s = steps * STEP_S
        points = self._points(times_s)
        distance_m = np.linalg.norm(points, axis=1)
        unit = points / np.maximum(distance_m, 1e-9)[:, None]
        now, then, earlier = (
            unit[before:],
            unit[_SERVO_LOOKAHEAD_STEPS:-_SERVO_LOOKAHEAD_STEPS],
            unit[:-before],
        )
        speed_radps = np.linalg.norm(now - then, axis=1) / SERVO_LOOKAHEAD_S
        miss_rad = np.linalg.norm(now - 2 * then + earlier, axis=1)
        lost = speed_radps > MAX_TURN_RATE_RADPS
        lost |= miss_rad > HALF_FIELD_OF_VIEW_RAD
        lost |= distance_m[before:] < MIN_TRACKING_DISTANCE_M
        for from_s, to_s in self._occluded_s:
            lost |= (from_s <= times_s[before:]) & (times_s[before:] < to_s)
        horizontal, zenith, _ = cartesian_to_polar(points[before:])
        directions = list(zip(horizontal.tolist(), zenith.tolist(), strict=True))
        return _Block(lost.astype(np.uint8).tobytes(), directions)


class _Block:
    """Consecutive steps: whether the prism is lost, and its direction."""

    __slots__ = ("directions", "lost")

    def __init__(self, lost: bytes, directions: list[PolarDirection]) -> None:
        self.lost = lost
        self.directions = directions


def angular_separation_rad(one: PolarDirection, other: PolarDirection) -> tuple[float, float]:
    """Return the separation of two directions across and up, in rad on the sphere; both positive."""
    across = abs(math.remainder(one[0] - other[0], math.tau)) * math.sin(other[1])
    return across, abs(one[1] - other[1])
