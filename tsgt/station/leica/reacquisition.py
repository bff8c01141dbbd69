"""Which search window to try next after the target is lost, and when an operator has pointed the telescope. Sans-I/O.

After a loss the instrument predicts the target's path for some seconds and locks on by itself. Then the driver searches:
at the current pointing, at the direction from the master's poses, around the last direction, wide, and the full circle if
configured. Then it calls the operator, pauses, and starts over.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from tsgt.radio import Direction

ATR_FIELD_OF_VIEW_RAD: Final = math.radians(1.5)
"""Field of view of the automatic target recognition (ATR): a smaller window needs no search."""

MAX_FINE_ADJUST_RAD: Final = math.radians(10.0)
"""The fine adjustment ends after 5 s and does not cover a larger window."""

FULL_CIRCLE_RAD: Final = math.radians(359.0)

PREDICTION_TIMEOUT_NS: Final = 10_000_000_000  # instruments predict for 1 to 5 s, as set by the operator

DIRECTION_MAX_AGE_NS: Final = 15_000_000_000  # a direction from the master's poses is used for this long

ROUND_PAUSES_NS: Final = (2_000_000_000, 5_000_000_000, 10_000_000_000, 20_000_000_000)
"""Pauses after each round of searches; the last one repeats."""

TURN_THRESHOLD_RAD: Final = math.radians(0.3)
"""A telescope turned by hand moves by more; an unlocked one may drift by less."""
REST_TOLERANCE_RAD: Final = math.radians(0.03)
REST_DURATION_NS: Final = 1_500_000_000


class Pointing(NamedTuple):
    """Where a telescope points: the circles' readings in rad."""

    horizontal_angle_rad: float
    zenith_angle_rad: float


class Lock(IntEnum):
    """Lock state as returned by MOT_ReadLockStatus."""

    OUT = 0
    IN = 1
    PREDICTION = 2


@dataclass(frozen=True, slots=True)
class SearchWindow:
    """One search.

    Attributes
    ----------
    name
        Description for the operator.
    sweep
        Whether PowerSearch sweeps the window; otherwise the target recognition searches it.
    centre
        None: the current pointing.
    width_rad, height_rad
        Full width and height; a width of at least :data:`FULL_CIRCLE_RAD` is the full circle.
    """

    name: str
    sweep: bool
    centre: Pointing | None
    width_rad: float
    height_rad: float

    @property
    def is_full_circle(self) -> bool:
        """Whether it covers the full circle."""
        return self.width_rad >= FULL_CIRCLE_RAD


def window_at_pointing(centre: Pointing | None = None) -> SearchWindow:
    """Return the window for the target recognition at the current pointing, or at a known one."""
    size_rad = 2 * ATR_FIELD_OF_VIEW_RAD
    return SearchWindow("recognising the target at the current pointing", False, centre, size_rad, size_rad)


def window_at_direction(direction: Direction) -> SearchWindow:
    """Return the window for the target recognition at a direction from the master."""
    size_rad = min(max(2 * direction.spread_rad, ATR_FIELD_OF_VIEW_RAD), MAX_FINE_ADJUST_RAD)
    return SearchWindow(
        "recognising the target at the direction from the master",
        False,
        centre_of(direction),
        size_rad,
        size_rad,
    )


class ReacquisitionSequence:
    """Sequence of search windows while the lock is lost; the widest has the given full width and height."""

    def __init__(self, *, width_rad: float, height_rad: float) -> None:
        self._width_rad = width_rad
        self._height_rad = height_rad
        self._last: Pointing | None = None
        self._towards: Direction | None = None
        self._towards_ns = 0
        self._predicting_since_ns: int | None = None
        self._step = 0
        self._rounds = 0
        self._resume_ns = 0
        self._telescope_moved = False

    @property
    def rounds(self) -> int:
        """Number of rounds without a target since the last lock."""
        return self._rounds

    def lock_acquired(self, pointing: Pointing) -> None:
        """Record the direction of the locked target."""
        self.reset()
        self._last = pointing

    def telescope_moved(self) -> None:
        """Record that the telescope was pointed at something else."""
        self._telescope_moved = True

    def restart(self, towards: Direction | None, now_ns: int) -> bool:
        """Search at once, from the first window, at the master's direction if there is one.

        A direction within the spread of the previous one only corrects that: an interrupted search counts as done, so
        that frequent commands cannot keep the sequence from reaching its later windows. Returns whether this direction
        only corrects the previous one.
        """
        correction = self._has_direction(now_ns) and towards is not None and self._near(towards)
        self._towards, self._towards_ns = towards, now_ns
        self._resume_ns = 0
        self._predicting_since_ns = None
        if not correction:
            self._step = self._rounds = 0
        return correction

    def reset(self) -> None:
        """Forget the target's direction: another prism is tracked from now on."""
        self._last = self._towards = self._predicting_since_ns = None
        self._step = self._rounds = self._resume_ns = 0
        self._telescope_moved = False

    def next(self, lock: Lock, now_ns: int) -> SearchWindow | None:
        """Return the window to search now, which then counts as done; None: keep measuring and query the lock again."""
        if lock is Lock.IN:
            self._predicting_since_ns = None
            return None
        if lock is Lock.PREDICTION and not self._has_direction(now_ns):
            if self._predicting_since_ns is None:
                self._predicting_since_ns = now_ns
            if now_ns - self._predicting_since_ns < PREDICTION_TIMEOUT_NS:
                return None
        if now_ns < self._resume_ns:
            return None
        windows = self._windows(now_ns)
        if self._step >= len(windows):
            self._resume_ns = now_ns + ROUND_PAUSES_NS[min(self._rounds, len(ROUND_PAUSES_NS) - 1)]
            self._rounds += 1
            self._step = 0
            self._telescope_moved = False  # from now on the operator points it
            return None
        self._step += 1
        return windows[self._step - 1]

    def _has_direction(self, now_ns: int) -> bool:
        return self._towards is not None and now_ns - self._towards_ns < DIRECTION_MAX_AGE_NS

    def _near(self, towards: Direction) -> bool:
        before = self._towards
        return (
            before is not None
            and angular_distance_rad(centre_of(before), centre_of(towards)) <= before.spread_rad
        )

    def _windows(self, now_ns: int) -> list[SearchWindow]:
        width_rad, height_rad, last = self._width_rad, self._height_rad, self._last
        if self._towards is not None and self._has_direction(now_ns):
            centre = centre_of(self._towards)
            size = max(2 * self._towards.spread_rad, ATR_FIELD_OF_VIEW_RAD)
            width = max(size, 2 * ATR_FIELD_OF_VIEW_RAD)
            windows = [
                window_at_direction(self._towards),
                SearchWindow("searching at the direction from the master", True, centre, width, size),
            ]
        else:
            windows = [window_at_pointing(last if self._telescope_moved else None)]
        narrow_rad = max(0.1 * width_rad, ATR_FIELD_OF_VIEW_RAD)
        narrow_height_rad = min(narrow_rad, height_rad)
        windows.append(
            SearchWindow("searching around its last direction", True, last, narrow_rad, narrow_height_rad)
        )
        if narrow_rad < width_rad < FULL_CIRCLE_RAD:
            windows.append(SearchWindow("searching the widest window", True, last, width_rad, height_rad))
        if width_rad >= FULL_CIRCLE_RAD:
            windows.append(SearchWindow("searching the full circle", True, None, math.tau, height_rad))
        return windows


class ManualPointingDetector:
    """Detects when the operator has turned the telescope to another prism: it has moved, and rests.

    ``initial``: pointing when the operator was called; None: the first pointing passed to :meth:`update`.
    """

    def __init__(self, initial: Pointing | None, now_ns: int) -> None:
        self._initial = initial
        self._rest: Pointing | None = None
        self._rest_ns = now_ns
        self._turned = False

    def update(self, pointing: Pointing, now_ns: int) -> bool:
        """Return whether the telescope has been turned, and rests."""
        if self._initial is None:
            self._initial = pointing
        if self._rest is None or angular_distance_rad(self._rest, pointing) > REST_TOLERANCE_RAD:
            self._rest, self._rest_ns = pointing, now_ns
        self._turned = self._turned or angular_distance_rad(self._initial, pointing) > TURN_THRESHOLD_RAD
        return self._turned and now_ns - self._rest_ns >= REST_DURATION_NS


def centre_of(direction: Direction) -> Pointing:
    """Return a direction without its spread."""
    return Pointing(direction.horizontal_angle_rad, direction.zenith_angle_rad)


def angular_distance_rad(a: Pointing, b: Pointing) -> float:
    """Return the angle between two directions in rad, to first order in their difference."""
    across = math.remainder(a.horizontal_angle_rad - b.horizontal_angle_rad, math.tau)
    return math.hypot(across * math.sin(a.zenith_angle_rad), a.zenith_angle_rad - b.zenith_angle_rad)
