"""The base of all models in configuration and set-up files, and the types of their values.

Keys carry the units that people use in the field (``_mm``, ``_deg``, ``_arcsec``, ``_s``). An unknown key is an
error, so that a typing mistake cannot silently leave a default in force.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationInfo

from tsgt.model import LARGEST_COORDINATE_M, LARGEST_NUMBER, Matrix4

# A calibration writes 17 digits; a matrix typed off a report has seven or so.
RIGID_TOLERANCE = 1e-6

Number = Annotated[int, Field(ge=1, le=LARGEST_NUMBER)]
NumberKey = Annotated[str, Field(pattern=r"^[1-9][0-9]{0,8}$")]
Positive = Annotated[float, Field(gt=0, le=1e6)]
NotNegative = Annotated[float, Field(ge=0, le=1e6)]
Coordinate = Annotated[float, Field(ge=-LARGEST_COORDINATE_M, le=LARGEST_COORDINATE_M)]
Place = tuple[Coordinate, Coordinate, Coordinate]


def _beside_the_file(path: Path, info: ValidationInfo) -> Path:
    return Path((info.context or {}).get("folder", "")) / path


RelativePath = Annotated[Path, AfterValidator(_beside_the_file)]


def rigid(T: Matrix4) -> Matrix4:
    """Refuse what is not a rotation and a translation; in plain Python, as geometry lies in a layer above."""
    if T[3] != (0.0, 0.0, 0.0, 1.0):
        raise ValueError("the last row of a rigid transform is [0, 0, 0, 1]")
    for coordinate in (row[3] for row in T[:3]):
        if abs(coordinate) > LARGEST_COORDINATE_M:
            raise ValueError(
                f"it puts the station {coordinate:g} m away, at most {LARGEST_COORDINATE_M:g} m are allowed"
            )
    x, y, z = (row[:3] for row in T[:3])
    products = [(_dot(a, b), i == j) for i, a in enumerate((x, y, z)) for j, b in enumerate((x, y, z))]
    off = max(abs(product - same) for product, same in products)
    if off > RIGID_TOLERANCE:
        raise ValueError(
            f"its 3x3 part is not a rotation: off by {off:.1e}, allowed are {RIGID_TOLERANCE:.0e}"
        )
    x_cross_y = (x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0])
    if _dot(x_cross_y, z) < 0:
        raise ValueError("its 3x3 part mirrors: the determinant is -1, that of a rotation is +1")
    return T


def _dot(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    return sum(p * q for p, q in zip(a, b, strict=True))


def no_two_share(name: str) -> AfterValidator:
    """Refuse an array in which two entries have the same number under the given key."""

    def check(entries: tuple[Any, ...]) -> tuple[Any, ...]:
        numbers = [getattr(entry, name) for entry in entries]
        for number in numbers:
            if numbers.count(number) > 1:
                raise ValueError(f"{name} {number} stands there more than once")
        return entries

    return AfterValidator(check)


class Model(BaseModel):
    """Base of all: unknown keys refused, no conversions between types, nothing infinite."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


class NoiseConfig(Model):
    """One-sigma noise of a single measurement; the defaults are a Trimble S7 that tracks."""

    range_sigma_mm: NotNegative = 2.0
    """Constant part of the noise of the slope distance."""
    range_sigma_ppm: NotNegative = 2.0
    """Part that grows with the distance."""
    angle_sigma_arcsec: Annotated[float, Field(ge=0, le=648_000)] = 1.0
    """Noise of each angle."""
    pointing_sigma_mm: NotNegative = 1.0
    """What pointing at the prism adds, per axis."""
