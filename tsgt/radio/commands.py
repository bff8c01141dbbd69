"""The commands of a master to a station, in either protocol."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Direction:
    """Predicted direction of a prism in a station's own circles.

    Attributes
    ----------
    horizontal_angle_rad
        Clockwise from the circle's zero.
    zenith_angle_rad
        From the zenith.
    spread_rad
        Bound of the error to every side.
    """

    horizontal_angle_rad: float
    zenith_angle_rad: float
    spread_rad: float


@dataclass(frozen=True, slots=True)
class TrackCommand:
    """Track a prism; None: the one that was tracked before."""

    prism: int | None


@dataclass(frozen=True, slots=True)
class SearchCommand:
    """Search for the prism even if locked; None: where the station last had it. Not in the protocol classic."""

    towards: Direction | None = None


@dataclass(frozen=True, slots=True)
class DirectCommand:
    """Stop tracking and prepare for single measurements (direct mode)."""


@dataclass(frozen=True, slots=True)
class MeasureCommand:
    """Make one single measurement."""


Command = TrackCommand | SearchCommand | DirectCommand | MeasureCommand
