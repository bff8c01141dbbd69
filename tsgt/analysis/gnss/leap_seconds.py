"""GPS time to UTC: UTC has had leap seconds inserted since 1980, GPS time has not."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.formats import SECOND_NS

if TYPE_CHECKING:
    from numpy.typing import NDArray

# GPS - UTC grew by 1 s at the begin of each of these months: IERS Bulletin C. None has been announced since 2017.
_LEAP_SECONDS = (
    "1981-07 1982-07 1983-07 1985-07 1988-01 1990-01 1991-01 1992-07 1993-07 "
    "1994-07 1996-01 1997-07 1999-01 2006-01 2009-01 2012-07 2015-07 2017-01"
)
_MONTHS_S = np.array(_LEAP_SECONDS.split(), dtype="datetime64[s]").astype(np.int64)
_FROM_GPS_NS = (_MONTHS_S + np.arange(1, len(_MONTHS_S) + 1)) * SECOND_NS


def utc_from_gps(gps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Convert GPS time, (N,) ns from 1970-01-01 00:00:00 on the calendar of GPS time, to Unix time in ns.

    Unix time cannot represent a leap second: during one it runs through the first second of the new day, which then repeats.
    """
    return gps_ns - np.searchsorted(_FROM_GPS_NS, gps_ns, side="right").astype(np.int64) * SECOND_NS
