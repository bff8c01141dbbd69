"""Types, limits and checks of numbers that the records share."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, ClassVar

if TYPE_CHECKING:
    from collections.abc import Iterable

Vector3 = tuple[float, float, float]
Row4 = tuple[float, float, float, float]
Matrix4 = tuple[Row4, Row4, Row4, Row4]

IDENTITY4: Matrix4 = (
    (1.0, 0.0, 0.0, 0.0),
    (0.0, 1.0, 0.0, 0.0),
    (0.0, 0.0, 1.0, 0.0),
    (0.0, 0.0, 0.0, 1.0),
)

WORLD_FRAME = "station1"
ROBOT_FRAME = "robot"

ARCSECOND_RAD = math.pi / 648_000

MAX_INSTANT_NS = 2**63 - 1  # times are signed 64-bit integers, which end in 2262

MIN_PRISMS = 3  # that determine a pose without an IMU

MAX_NUMBER = 2**31 - 1  # of stations and prisms

MAX_COORDINATE_M = 1e8  # map coordinates (UTM: 1e7) and geocentric coordinates are smaller

FRAME_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_./-]*")
OTHER_FRAME = re.compile(r"(station|prism)\d+")

ROTATION_TOLERANCE = 1e-3  # exceeds the rounding of a matrix that is written with four digits


def check_instants(*times_ns: int) -> None:
    """Raise ValueError for a time before 1970 or beyond 64 bits."""
    for time_ns in times_ns:
        if not 0 <= time_ns <= MAX_INSTANT_NS:
            raise ValueError(f"a time of {time_ns} ns is outside what a clock can show")


def check_finite(*numbers: float) -> None:
    """Raise ValueError for NaN and infinity, which an instrument or a radio may send and JSON cannot represent."""
    for number in numbers:
        if not math.isfinite(number):
            raise ValueError(f"{number} is not a finite number")


def check_coordinates(what: str, coordinates: Iterable[float]) -> None:
    """Reject positions that are not near the Earth."""
    for coordinate in coordinates:
        if not abs(coordinate) <= MAX_COORDINATE_M:
            raise ValueError(f"{what} holds {coordinate:g}, expected at most {MAX_COORDINATE_M:g} m")


def _dot(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def check_rotation(what: str, matrix: Matrix4) -> None:
    """Reject a matrix whose upper left 3x3 block is not a rotation."""
    x, y, z = (row[:3] for row in matrix[:3])
    lengths = (math.hypot(*x) - 1, math.hypot(*y) - 1, math.hypot(*z) - 1)
    cosines = (_dot(x, y), _dot(y, z), _dot(z, x))
    if not all(abs(error) < ROTATION_TOLERANCE for error in (*lengths, *cosines)):
        raise ValueError(f"{what} holds {x}, {y}, {z}, which is not a rotation")


def check_limits(record: object, **limits: tuple[float, float]) -> None:
    """Reject attributes outside their limits (inclusive)."""
    for name, (lower, upper) in limits.items():
        if not lower <= getattr(record, name) <= upper:
            raise ValueError(f"{name} is {getattr(record, name)}, expected {lower:g} to {upper:g}")


class FiniteNumbers:
    """Base of records that pydantic validates to have finite numbers."""

    __slots__ = ()
    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}
