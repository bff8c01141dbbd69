"""GPS time to UTC: UTC has had leap seconds inserted since 1980, GPS time has not."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.formats import SECOND_NS

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Month of change and GPS - UTC in s from then on: IERS Bulletin C. No change has been announced since 2017.
_LEAP_SECONDS = (
    ((1981, 7), 1),
    ((1982, 7), 2),
    ((1983, 7), 3),
    ((1985, 7), 4),
    ((1988, 1), 5),
    ((1990, 1), 6),
    ((1991, 1), 7),
    ((1992, 7), 8),
    ((1993, 7), 9),
    ((1994, 7), 10),
    ((1996, 1), 11),
    ((1997, 7), 12),
    ((1999, 1), 13),
    ((2006, 1), 14),
    ((2009, 1), 15),
    ((2012, 7), 16),
    ((2015, 7), 17),
    ((2017, 1), 18),
)

_OFFSET_S = np.array([0, *(seconds for _, seconds in _LEAP_SECONDS)], dtype=np.int64)
_FROM_GPS_NS = np.array(
    [
        (round(datetime(year, month, 1, tzinfo=UTC).timestamp()) + seconds) * SECOND_NS
        for (year, month), seconds in _LEAP_SECONDS
    ],
    dtype=np.int64,
)


def utc_from_gps(gps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Convert GPS time, (N,) ns from 1970-01-01 00:00:00 on the calendar of GPS time, to Unix time in ns.

    Unix time cannot represent a leap second: during one it runs through the first second of the new day, which then repeats.
    """
    return gps_ns - _OFFSET_S[np.searchsorted(_FROM_GPS_NS, gps_ns, side="right")] * SECOND_NS
