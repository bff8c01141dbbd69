"""How a lost prism is found again, and how a person hands the telescope another one: what to do next, and nothing else.

An instrument that loses its prism goes on along the path for some seconds (prediction) and locks in by itself if the prism
comes back into view. After that somebody has to look for it. The order is: a small window where the telescope points, a
window where the master's other stations say the prism is, one about its last direction, a wide one, the whole circle if
the configuration allows it; then a beep for a person, a pause, and all over again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from tsgt.radio import Direction

NARROWEST_RAD: Final = math.radians(1.5)
"""The field of view of the target recognition: a narrower window needs no search."""

WIDEST_ADJUST_RAD: Final = math.radians(10.0)
"""In a larger window the fine adjustment, which ends after 5 s, does not come round."""

ROUND_RAD: Final = math.radians(359.0)

PREDICTION_NS: Final = 10_000_000_000
"""Instruments predict for 1 to 5 s, as a person has set them; after this they are not waited for any longer."""

FRESH_NS: Final = 15_000_000_000
"""A direction from the master's poses is worth looking at for so long."""

PAUSES_NS: Final = (2_000_000_000, 5_000_000_000, 10_000_000_000, 20_000_000_000)
"""Between one round of searches and the next; the last one for ever."""

TURNED_RAD: Final = math.radians(0.3)
"""A telescope that a person turns has turned by more than this; one that was let go may drift by less."""
RESTING_RAD: Final = math.radians(0.03)
RESTING_NS: Final = 1_500_000_000


LOOKING: Final = "looking where the telescope points"


class Pointing(NamedTuple):
    """Where a telescope points: the circles' readings in rad."""

    horizontal_angle_rad: float
    zenith_angle_rad: float


class Lock(IntEnum):
    """What MOT_ReadLockStatus says."""

    OUT = 0
    IN = 1
    PREDICTION = 2


@dataclass(frozen=True, slots=True)
class Look:
    """A search.

    Attributes
    ----------
    name
        What is done, for people.
    sweep
        Whether PowerSearch sweeps it; else the target recognition looks there.
    centre
        Of its window; None: where the telescope points.
    width_rad, height_rad
        Of its window, full; a width of :data:`ROUND_RAD` or more is the whole circle.
    """

    name: str
    sweep: bool
    centre: Pointing | None
    width_rad: float
    height_rad: float

    @property
    def is_round(self) -> bool:
        """Whether it is the whole circle."""
        return self.width_rad >= ROUND_RAD


class LossSequence:
    """What to do about a prism that is not locked in on.

    Parameters
    ----------
    width_rad, height_rad
        The widest window, full.
    """

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
        self._turned_away = False

    @property
    def rounds(self) -> int:
        """How many rounds have found nothing since the last lock."""
        return self._rounds

    @property
    def last(self) -> Pointing | None:
        """Where the prism was last seen, or where somebody has told to look."""
        return self._last

    def seen(self, pointing: Pointing) -> None:
        """Note where the prism is: it is locked in on."""
        self._last = pointing
        self._towards = None
        self._predicting_since_ns = None
        self._step = self._rounds = self._resume_ns = 0
        self._turned_away = False

    def turned_away(self) -> None:
        """Note that the telescope has been pointed at something else meanwhile."""
        self._turned_away = True

    def restart(self, towards: Direction | None, now_ns: int) -> bool:
        """Look at once, from the beginning, and where the master believes the prism to be if it says so.

        One that points to where the one before it did, as far as that was sure, only puts that right: a search that it
        has interrupted counts as done, so that orders every few seconds cannot keep the later searches from being reached.

        Returns
        -------
        bool
            Whether this is such an order.
        """
        again = self._is_fresh(now_ns) and towards is not None and self._near(towards)
        self._towards, self._towards_ns = towards, now_ns
        self._resume_ns = 0
        self._predicting_since_ns = None
        if not again:
            self._step = self._rounds = 0
        return again

    def forget(self) -> None:
        """Forget where the prism was: from now on it is another one."""
        self._last = self._towards = self._predicting_since_ns = None
        self._step = self._rounds = self._resume_ns = 0
        self._turned_away = False

    def next(self, lock: Lock, now_ns: int) -> Look | None:
        """Return what to do now; None: nothing but to measure and to ask for the lock again, soon.

        A search that is returned counts as done, whatever becomes of it.
        """
        if lock is Lock.IN:
            self._predicting_since_ns = None
            return None
        if lock is Lock.PREDICTION and not self._is_fresh(now_ns):
            if self._predicting_since_ns is None:
                self._predicting_since_ns = now_ns
            if now_ns - self._predicting_since_ns < PREDICTION_NS:
                return None
        if now_ns < self._resume_ns:
            return None
        looks = self._looks(now_ns)
        if self._step >= len(looks):
            self._resume_ns = now_ns + PAUSES_NS[min(self._rounds, len(PAUSES_NS) - 1)]
            self._rounds += 1
            self._step = 0
            self._turned_away = False  # from now on a person points it
            return None
        self._step += 1
        return looks[self._step - 1]

    def _is_fresh(self, now_ns: int) -> bool:
        return self._towards is not None and now_ns - self._towards_ns < FRESH_NS

    def _near(self, towards: Direction) -> bool:
        before = self._towards
        return (
            before is not None and apart_rad(pointing_at(before), pointing_at(towards)) <= before.spread_rad
        )

    def _looks(self, now_ns: int) -> list[Look]:
        looks = []
        if self._towards is not None and self._is_fresh(now_ns):
            centre = pointing_at(self._towards)
            size = max(2 * self._towards.spread_rad, NARROWEST_RAD)
            adjusted = min(size, WIDEST_ADJUST_RAD)
            looks.append(Look("looking where the master says", False, centre, adjusted, adjusted))
            looks.append(
                Look("searching where the master says", True, centre, max(size, 2 * NARROWEST_RAD), size)
            )
        else:
            where = self._last if self._turned_away else None
            looks.append(Look(LOOKING, False, where, 2 * NARROWEST_RAD, 2 * NARROWEST_RAD))
        narrow_rad = max(0.1 * self._width_rad, NARROWEST_RAD)
        looks.append(
            Look(
                "searching around its last direction",
                True,
                self._last,
                narrow_rad,
                min(narrow_rad, self._height_rad),
            )
        )
        if self._width_rad > narrow_rad and self._width_rad < ROUND_RAD:
            looks.append(Look("searching wide", True, self._last, self._width_rad, self._height_rad))
        if self._width_rad >= ROUND_RAD:
            looks.append(Look("searching all around", True, None, math.tau, self._height_rad))
        return looks


class Handover:
    """Tells when a person who was asked to has turned the telescope to another prism.

    Parameters
    ----------
    begun
        Where it pointed when that was asked for; None: not known, the first direction counts.
    now_ns
        When that was.
    """

    def __init__(self, begun: Pointing | None, now_ns: int) -> None:
        self._from = begun
        self._rest: Pointing | None = None
        self._rest_ns = now_ns
        self._turned = False

    def points(self, pointing: Pointing, now_ns: int) -> bool:
        """Take where the telescope points; return whether it has been turned, and rests."""
        if self._from is None:
            self._from = pointing
        if self._rest is None or apart_rad(self._rest, pointing) > RESTING_RAD:
            self._rest, self._rest_ns = pointing, now_ns
        self._turned = self._turned or apart_rad(self._from, pointing) > TURNED_RAD
        return self._turned and now_ns - self._rest_ns >= RESTING_NS


def pointing_at(direction: Direction) -> Pointing:
    """Return the middle of a direction."""
    return Pointing(direction.horizontal_angle_rad, direction.zenith_angle_rad)


def apart_rad(a: Pointing, b: Pointing) -> float:
    """Return the angle between two directions, for small ones; in rad."""
    across = math.remainder(a.horizontal_angle_rad - b.horizontal_angle_rad, math.tau)
    return math.hypot(across * math.sin(a.zenith_angle_rad), a.zenith_angle_rad - b.zenith_angle_rad)
