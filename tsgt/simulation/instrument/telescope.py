"""Telescope of a simulated total station: pointing, lock, prediction, reacquisition.

State is computed on request: :meth:`Telescope.advance` first. Times are in s from the start of the world.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import TYPE_CHECKING

from tsgt.simulation.instrument.visibility import (
    HALF_FIELD_OF_VIEW_RAD,
    SERVO_LOOKAHEAD_S,
    STEP_S,
    angular_separation_rad,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from tsgt.simulation.instrument.visibility import PolarDirection, PrismVisibility


class Lock(IntEnum):
    """Lock states as reported by MOT_ReadLockStatus."""

    OUT = 0
    IN = 1
    PREDICTED = 2


class Telescope:
    """Points in a direction, at rest or following a prism.

    Parameters
    ----------
    prisms
        Visibility by prism number.
    prediction_s
        How long it continues with constant angular speed after losing a prism.
    """

    def __init__(self, prisms: Mapping[int, PrismVisibility], *, prediction_s: float, now_s: float) -> None:
        self._prisms = prisms
        self._prediction_s = prediction_s
        self._now_s = now_s
        self._since_s = now_s
        self._direction: PolarDirection = (0.0, math.pi / 2)
        self._speed_radps: PolarDirection = (0.0, 0.0)
        self.lock = Lock.OUT
        self.prism: int | None = None  # the prism it follows, or followed last
        self.locked_s: float | None = None  # when it locked on again; None: not since the start
        self.target_id: int | None = None  # number of the only prism that it accepts; None: any
        self.blocked = False  # whether the line of sight is blocked; advance before changing it
        self.moving = False  # whether it is turning to another direction, and cannot measure
        self.field_rad = HALF_FIELD_OF_VIEW_RAD  # half the field of view

    def advance(self, to_s: float) -> None:
        """Advance to a later time; earlier times have no effect."""
        while self._now_s < to_s:
            if self.lock is Lock.IN:
                self._follow_until(to_s)
            elif self.lock is Lock.PREDICTED:
                self._predict_until(to_s)
            else:
                self._now_s = to_s

    def direction(self) -> PolarDirection:
        """Return the current true direction: horizontal and zenith angle in rad."""
        if self.lock is Lock.IN:
            assert self.prism is not None  # noqa: S101 (a lock has its prism)
            return self._prisms[self.prism].direction_at(self._now_s)
        after_s = self._now_s - self._since_s if self.lock is Lock.PREDICTED else 0.0
        horizontal, zenith = self._direction
        across, up = self._speed_radps
        return (horizontal + across * after_s) % math.tau, min(max(zenith + up * after_s, 0.0), math.pi)

    def speed_radps(self) -> float:
        """Return the current rate of turn about the standing axis in rad/s."""
        if self.lock is Lock.IN and self.prism is not None:
            visibility = self._prisms[self.prism]
            now, then = (visibility.direction_at(self._now_s - s)[0] for s in (0.0, SERVO_LOOKAHEAD_S))
            return abs(math.remainder(now - then, math.tau)) / SERVO_LOOKAHEAD_S
        return abs(self._speed_radps[0]) if self.lock is Lock.PREDICTED else 0.0

    def turn_to(self, direction: PolarDirection) -> None:
        """Release the lock and point in a direction."""
        self.lock = Lock.OUT
        self._direction = direction

    def release(self) -> None:
        """Release the lock and keep the direction."""
        self.turn_to(self.direction())

    def follow(self, prism: int) -> None:
        """Lock on a prism."""
        self.locked_s = None if self.prism is None else self._now_s
        self.lock, self.prism = Lock.IN, prism

    def take_over(self, prism: int) -> bool:
        """Follow another prism instead of the present one if that is in the field of view; return whether it does."""
        visibility = self._prisms[prism]
        if self.lock is not Lock.IN or self.blocked or visibility.lost_at(self._now_s):
            return False
        apart = angular_separation_rad(visibility.direction_at(self._now_s), self.direction())
        if max(apart) > self.field_rad:
            return False
        self.follow(prism)
        return True

    def nearest_prism(self, across_rad: float, up_rad: float) -> int | None:
        """Return the visible prism nearest to the line of sight within a window of this half width and height.

        The field of view counts if it is larger than the window.
        """
        if self.blocked:
            return None
        here = self.direction()
        least, found = math.inf, None
        for prism, visibility in self._prisms.items():
            if self.target_id not in (None, visibility.target_id) or visibility.lost_at(self._now_s):
                continue
            across, up = angular_separation_rad(visibility.direction_at(self._now_s), here)
            if across <= max(across_rad, self.field_rad) and up <= max(up_rad, self.field_rad):
                apart = math.hypot(across, up)
                if apart < least:
                    least, found = apart, prism
        return found

    def _follow_until(self, to_s: float) -> None:
        assert self.prism is not None  # noqa: S101 (a lock has its prism)
        visibility = self._prisms[self.prism]
        lost_s = self._now_s if self.blocked else visibility.first_lost(self._now_s, to_s)
        if lost_s is None:
            self._now_s = to_s
            return
        last, before = (visibility.direction_at(lost_s - s) for s in (STEP_S, STEP_S + SERVO_LOOKAHEAD_S))
        self._direction = last
        self._speed_radps = (
            math.remainder(last[0] - before[0], math.tau) / SERVO_LOOKAHEAD_S,
            (last[1] - before[1]) / SERVO_LOOKAHEAD_S,
        )
        self.lock = Lock.PREDICTED
        self._since_s = self._now_s = lost_s

    def _predict_until(self, to_s: float) -> None:
        end_s = self._since_s + self._prediction_s
        while self._now_s < min(to_s, end_s):
            self._now_s = min(to_s, end_s, self._now_s + STEP_S)
            prism = self.nearest_prism(0.0, 0.0)
            if prism is not None:
                self.follow(prism)
                return
        if self._now_s >= end_s:
            self.release()
