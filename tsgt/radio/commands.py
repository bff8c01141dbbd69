"""What a master may order a station to do, in either protocol."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Direction:
    """Where a prism is believed to be, seen from a station, in the terms of its own circles.

    Attributes
    ----------
    horizontal_angle_rad
        Horizontal circle, clockwise from the circle's zero, in rad.
    zenith_angle_rad
        Angle from straight up, in rad.
    spread_rad
        It is within this of the direction, to every side, in rad.
    """

    horizontal_angle_rad: float
    zenith_angle_rad: float
    spread_rad: float


@dataclass(frozen=True, slots=True)
class TrackCommand:
    """Go back to tracking.

    Attributes
    ----------
    prism
        The prism to track; None: the one that was tracked before.
    """

    prism: int | None


@dataclass(frozen=True, slots=True)
class SearchCommand:
    """Look for the tracked prism anew, even if the instrument seems to have it. Not in the protocol classic.

    Attributes
    ----------
    towards
        Where to look for it; None: where the station last had it.
    """

    towards: Direction | None = None


@dataclass(frozen=True, slots=True)
class DirectCommand:
    """Stop tracking and get ready for single measurements."""


@dataclass(frozen=True, slots=True)
class MeasureCommand:
    """Make one single measurement."""


Command = TrackCommand | SearchCommand | DirectCommand | MeasureCommand
