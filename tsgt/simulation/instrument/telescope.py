"""Where a simulated total station's telescope points, and how it holds, loses and finds a prism.

Nothing happens by itself: whoever asks first lets it advance to the time he asks for. Times are seconds from the start of
the world.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import TYPE_CHECKING

from tsgt.simulation.instrument.visibility import FIELD_RAD, SERVO_S, STEP_S, apart_rad

if TYPE_CHECKING:
    from collections.abc import Mapping

    from tsgt.simulation.instrument.visibility import Direction2, Sight


class Lock(IntEnum):
    """As MOT_ReadLockStatus gives it."""

    OUT = 0
    IN = 1
    PREDICTED = 2


class Telescope:
    """Points somewhere, at rest or after a prism.

    Parameters
    ----------
    sights
        What there is to be seen, by the prisms' numbers.
    prediction_s
        How long it goes on with constant angular speed when it has lost a prism.
    now_s
        Time.

    Attributes
    ----------
    lock
        Whether it follows a prism.
    prism
        Which one it follows, or followed last.
    only
        The only prism that it takes notice of; None: of any.
    blocked
        Whether somebody stands in front of it; advance first.
    moving
        Whether it is on its way to somewhere, and sees nothing.
    field_rad
        Half of its field of view.
    """

    def __init__(self, sights: Mapping[int, Sight], *, prediction_s: float, now_s: float) -> None:
        self._sights = sights
        self._prediction_s = prediction_s
        self._now_s = now_s
        self._since_s = now_s
        self._direction: Direction2 = (0.0, math.pi / 2)
        self._speed_radps: Direction2 = (0.0, 0.0)
        self.lock = Lock.OUT
        self.prism: int | None = None
        self.only: int | None = None
        self.blocked = False
        self.moving = False
        self.field_rad = FIELD_RAD

    def advance(self, to_s: float) -> None:
        """Let time pass; never runs backwards."""
        while self._now_s < to_s:
            if self.lock is Lock.IN:
                self._follow_until(to_s)
            elif self.lock is Lock.PREDICTED:
                self._predict_until(to_s)
            else:
                self._now_s = to_s

    def direction(self) -> Direction2:
        """Return where it points now: horizontal and zenith angle in rad, without any error."""
        if self.lock is Lock.IN:
            assert self.prism is not None  # noqa: S101 (a lock has its prism)
            return self._sights[self.prism].direction_at(self._now_s)
        after_s = self._now_s - self._since_s if self.lock is Lock.PREDICTED else 0.0
        horizontal, zenith = self._direction
        across, up = self._speed_radps
        return (horizontal + across * after_s) % math.tau, min(max(zenith + up * after_s, 0.0), math.pi)

    def speed_radps(self) -> float:
        """Return how fast it turns about the plumb line now, in rad/s."""
        if self.lock is Lock.IN and self.prism is not None:
            sight = self._sights[self.prism]
            now, then = (sight.direction_at(self._now_s - s)[0] for s in (0.0, SERVO_S))
            return abs(math.remainder(now - then, math.tau)) / SERVO_S
        return abs(self._speed_radps[0]) if self.lock is Lock.PREDICTED else 0.0

    def turn_to(self, direction: Direction2) -> None:
        """Point there and rest; a lock is let go."""
        self.lock = Lock.OUT
        self._direction = direction

    def release(self) -> None:
        """Let go of a lock, and stay where it points."""
        self.turn_to(self.direction())

    def follow(self, prism: int) -> None:
        """Lock in on a prism."""
        self.lock, self.prism = Lock.IN, prism

    def nearest(self, across_rad: float, up_rad: float) -> int | None:
        """Return the prism that is seen nearest to where the telescope points, within a window.

        Parameters
        ----------
        across_rad, up_rad
            Half the width and the height of the window; the field of view is seen in any case.
        """
        if self.blocked:
            return None
        here = self.direction()
        least, found = math.inf, None
        for prism, sight in self._sights.items():
            if self.only not in (None, prism) or sight.lost_at(self._now_s):
                continue
            across, up = apart_rad(sight.direction_at(self._now_s), here)
            if across <= max(across_rad, self.field_rad) and up <= max(up_rad, self.field_rad):
                apart = math.hypot(across, up)
                if apart < least:
                    least, found = apart, prism
        return found

    def _follow_until(self, to_s: float) -> None:
        assert self.prism is not None  # noqa: S101 (a lock has its prism)
        sight = self._sights[self.prism]
        lost_s = self._now_s if self.blocked else sight.first_lost(self._now_s, to_s)
        if lost_s is None:
            self._now_s = to_s
            return
        last, before = (sight.direction_at(lost_s - s) for s in (STEP_S, STEP_S + SERVO_S))
        self._direction = last
        self._speed_radps = (
            math.remainder(last[0] - before[0], math.tau) / SERVO_S,
            (last[1] - before[1]) / SERVO_S,
        )
        self.lock = Lock.PREDICTED
        self._since_s = self._now_s = lost_s

    def _predict_until(self, to_s: float) -> None:
        end_s = self._since_s + self._prediction_s
        while self._now_s < min(to_s, end_s):
            self._now_s = min(to_s, end_s, self._now_s + STEP_S)
            prism = self.nearest(0.0, 0.0)
            if prism is not None:
                self.follow(prism)
                return
        if self._now_s >= end_s:
            self.release()
