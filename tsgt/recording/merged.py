"""Measurements that were merged into a recording from a station's journal."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from tsgt.model import PolarMeasurement  # noqa: TC001 (pydantic evaluates annotations at run time)

# Half a unit of the protocol plus rounding errors of the sums; distances from 1677.7 m on are sent in whole mm.
_ANGLE_ROUNDING_RAD = math.tau / 2**25 * 1.001
_DISTANCE_ROUNDING_M = 0.501e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class MergedRecord:
    """A measurement from a station's journal, added after the recording had ended.

    It was not on the stream, so a replay ignores it; post-processing uses it like any other.
    """

    type: Literal["merged"] = "merged"
    journal: str
    """Name of the file that it came from."""
    measurement: PolarMeasurement
    """As in the journal, with its number there, except for its times: ``stamp_ns`` is on the master's Unix clock, and
    ``received_ns`` is the same, as the master never received it."""


def same_content(journalled: PolarMeasurement, delivered: PolarMeasurement) -> bool:
    """Return whether a delivered measurement equals a journalled one up to the rounding of the protocol superframe."""
    if (journalled.status, journalled.prism) != (delivered.status, delivered.prism):
        return False
    differences_rad = (
        journalled.horizontal_angle_rad - delivered.horizontal_angle_rad,
        journalled.zenith_angle_rad - delivered.zenith_angle_rad,
    )
    if any(abs(math.remainder(angle, math.tau)) > _ANGLE_ROUNDING_RAD for angle in differences_rad):
        return False
    # The protocol classic transmits 0 for none.
    journalled_m, delivered_m = journalled.slope_distance_m or None, delivered.slope_distance_m or None
    if journalled_m is None or delivered_m is None:
        return journalled_m is delivered_m
    return abs(journalled_m - delivered_m) <= _DISTANCE_ROUNDING_M
