"""Bounded histories that the page draws, each sent to it once and whole to a new reader. Sans-I/O."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tsgt.model import Vector3

TRAIL_POINTS = 1500
TRAIL_STEP_M = 0.15
TRAIL_INTERVAL_S = 2.0
"""The trail gets a point when the robot has moved by the step, and one at least in this time: half an hour at rest, and
some 200 m on the move."""

RESIDUAL_INTERVAL_S = 0.5
RESIDUAL_POINTS = 600  # five minutes

EVENTS = 100


class History:
    """The newest items of a series, numbered from 0."""

    def __init__(self, capacity: int) -> None:
        self._items: deque[Any] = deque(maxlen=capacity)
        self._count = 0

    @property
    def count(self) -> int:
        """Number of items ever added: the cursor behind the newest one."""
        return self._count

    def add(self, item: Any) -> None:
        """Add an item; the oldest makes room."""
        self._items.append(item)
        self._count += 1

    def clear(self) -> None:
        """Drop all items. A number is left out, so that a reader that has them sees a gap and drops them as well."""
        self._items.clear()
        self._count += 1

    def since(self, cursor: int) -> dict[str, Any]:
        """Return the items from a cursor on, as far as they are kept, with the number of the first."""
        fresh = min(self._count - cursor, len(self._items))
        return {
            "first": self._count - fresh,
            "items": [self._items[i] for i in range(len(self._items) - fresh, len(self._items))],
        }


class Trail(History):
    """Where the robot was: points [x, y, z] in m, and null where the trail is interrupted."""

    def __init__(self) -> None:
        super().__init__(TRAIL_POINTS)
        self._last: Vector3 | None = None
        self._last_s = -math.inf

    def point(self, position: Vector3, now_s: float) -> None:
        """Take a valid position."""
        if self._last is not None:
            moved = math.dist(self._last, position) >= TRAIL_STEP_M
            if not moved and now_s - self._last_s < TRAIL_INTERVAL_S:
                return
        self._last, self._last_s = position, now_s
        self.add([round(each, 2) for each in position])

    def interrupt(self) -> None:
        """Take note that there is no valid position."""
        if self._last is not None:
            self._last = None
            self.add(None)

    def clear(self) -> None:
        """Drop all points: the next one is in another frame."""
        super().clear()
        self._last = None


class Residuals(History):
    """Residuals of the prisms against their layout: [time in s, {prism: mm}]."""

    def __init__(self) -> None:
        super().__init__(RESIDUAL_POINTS)
        self._last_s = -math.inf

    def point(self, by_prism_m: dict[int, float], now_s: float) -> None:
        """Take the residuals of a pose, in m."""
        if by_prism_m and now_s - self._last_s >= RESIDUAL_INTERVAL_S:
            self._last_s = now_s
            self.add(
                [
                    round(now_s, 2),
                    {prism: round(1e3 * residual, 1) for prism, residual in by_prism_m.items()},
                ]
            )


class Share:
    """Share of the valid ones among the poses of the last minute, in steps of a second."""

    SPAN_S = 60

    def __init__(self) -> None:
        self._seconds: deque[list[int]] = deque()  # [second, poses, valid ones]

    def count(self, now_s: float, *, valid: bool) -> None:
        """Take a pose."""
        second = math.floor(now_s)
        if not self._seconds or self._seconds[-1][0] != second:
            self._seconds.append([second, 0, 0])
            self._drop_old(now_s)
        self._seconds[-1][1] += 1
        self._seconds[-1][2] += valid

    def value(self, now_s: float) -> float | None:
        """Return the share, 0 to 1; None without poses."""
        self._drop_old(now_s)
        poses = sum(each[1] for each in self._seconds)
        return sum(each[2] for each in self._seconds) / poses if poses else None

    def _drop_old(self, now_s: float) -> None:
        while self._seconds and self._seconds[0][0] < now_s - self.SPAN_S:
            self._seconds.popleft()
