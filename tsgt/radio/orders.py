"""What a master may order a station to do, in either protocol."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class TrackOrder:
    """Go back to tracking.

    Attributes
    ----------
    prism
        The prism to track; None: the one that was tracked before.
    """

    prism: int | None


@dataclass(frozen=True, slots=True)
class SearchOrder:
    """Look for the tracked prism anew, even if the instrument seems to have it. Not in the protocol classic."""


@dataclass(frozen=True, slots=True)
class DirectOrder:
    """Stop tracking and get ready for single measurements."""


@dataclass(frozen=True, slots=True)
class MeasureOrder:
    """Make one single measurement."""


Order = TrackOrder | SearchOrder | DirectOrder | MeasureOrder
