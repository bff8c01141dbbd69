"""RTKLIB solution files in all variants, from positions in a local frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

from pymap3d import ecef2geodetic, enu2ecef

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

SECOND = 1_000_000_000
BASE = (math.radians(46.7794), math.radians(-71.2746), 61.02)
"""Latitude and longitude in rad and height in m of a base near Quebec."""

LEGEND = ",Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)"
_SIGMAS = {
    "geodetic": "sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m)",
    "sexagesimal": "sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdue(m)",
    "ecef": "sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m)",
    "baseline": "sde(m) sdn(m) sdu(m) sden(m) sdnu(m) sdue(m)",
}
_NAMES = {
    "geodetic": "latitude(deg) longitude(deg) height(m)",
    "sexagesimal": "latitude(d'\") longitude(d'\") height(m)",
    "ecef": "x-ecef(m) y-ecef(m) z-ecef(m)",
    "baseline": "e-baseline(m) n-baseline(m) u-baseline(m)",
}


@dataclass(frozen=True)
class Variant:
    """Options of RTKLIB's output."""

    coordinates: str = "geodetic"
    system: str = "GPST"
    week: bool = False
    separator: str = " "
    velocity: bool = False
    decimals: int = 3

    def header(self) -> list[str]:
        """Return the header; its last line names the columns."""
        names = f"{_NAMES[self.coordinates]} Q ns {_SIGMAS[self.coordinates]} age(s) ratio"
        if self.velocity:
            names += " vn(m/s) ve(m/s) vu(m/s) sdvn sdve sdvu sdvne sdveu sdvun"
        latitude, longitude, height = BASE
        place = f"{math.degrees(latitude):14.9f}{self.separator}{math.degrees(longitude):14.9f}"
        return [
            "% program   : RTKPOST ver.2.4.2",
            "% inp file  : C:\\data\\rover.obs",
            "% obs start : 2022/05/25 17:21:00.0 GPST (week2211 321660.0s)",
            "% pos mode  : kinematic",
            f"% ref pos   :{self.separator}{place}{self.separator}{height:10.4f}",
            "%",
            f"% (lat/lon/height=WGS84/ellipsoidal{LEGEND}",
            f"%  {self.system:23s}{self.separator}{self.separator.join(names.split())}",
        ]

    def row(
        self,
        time_ns: int,
        enu_m: NDArray[np.float64],
        quality: int = 1,
        satellites: int = 15,
        gps_utc_s: int = 18,
    ) -> str:
        """Format one position; ``time_ns`` is Unix time, ``gps_utc_s`` the offset of GPS time to UTC."""
        shift_s = {"GPST": gps_utc_s, "UTC": 0, "JST": 9 * 3600}[self.system]
        fields = [
            *self._time(time_ns + shift_s * SECOND),
            *self._position(enu_m),
            f"{quality:3d}",
            f"{satellites:3d}",
            *["  0.0058"] * 6,
            "  0.00",
            "   9.2",
            *(["   0.00001"] * 9 if self.velocity else []),
        ]
        return self.separator.join(fields)

    def _time(self, time_ns: int) -> list[str]:
        second, rest = divmod(time_ns, SECOND)
        fraction = f".{rest:09d}"[: 1 + self.decimals] if self.decimals else ""
        if self.week:
            week, second = divmod(second - 315_964_800, 604_800)
            return [f"{week:4d}", f"{second:6d}{fraction}"]
        then = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=second)
        return [f"{then:%Y/%m/%d %H:%M:%S}{fraction}"]

    def _position(self, enu_m: NDArray[np.float64]) -> list[str]:
        if self.coordinates == "baseline":
            return [f"{value:14.4f}" for value in enu_m]
        ecef_m = enu2ecef(*enu_m, *BASE, deg=False)
        if self.coordinates == "ecef":
            return [f"{value:14.4f}" for value in ecef_m]
        latitude, longitude, height = ecef2geodetic(*ecef_m)
        if self.coordinates == "geodetic":
            return [f"{latitude:14.9f}", f"{longitude:14.9f}", f"{height:10.4f}"]
        return [*_sexagesimal(latitude), *_sexagesimal(longitude), f"{height:10.4f}"]


def _sexagesimal(degrees: float) -> list[str]:
    size = round(abs(degrees) * 3600, 5)
    sign = "-" if degrees < 0 else ""
    return [f"{sign}{int(size // 3600):d}", f"{int(size // 60 % 60):02d}", f"{size % 60:08.5f}"]


def write_pos(
    path: Path,
    times_ns: Sequence[int],
    points_m: NDArray[np.float64],
    variant: Variant | None = None,
    *,
    quality: Sequence[int] | None = None,
    satellites: Sequence[int] | None = None,
) -> Path:
    """Write positions, (N, 3) east, north and up from the base, at Unix times."""
    variant = variant or Variant()
    rows = [
        variant.row(
            time_ns,
            point,
            1 if quality is None else quality[i],
            15 if satellites is None else satellites[i],
        )
        for i, (time_ns, point) in enumerate(zip(times_ns, points_m, strict=True))
    ]
    path.write_text("\n".join([*variant.header(), *rows, ""]), encoding="utf-8")
    return path
