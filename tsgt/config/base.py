"""Base class and value types of configuration models. Keys end with units (``_mm``, ``_deg``); unknown ones are errors."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationInfo

from tsgt.model import MAX_COORDINATE_M, MAX_NUMBER, Matrix4

# A calibration writes 17 digits; a matrix copied from a report has about seven.
RIGID_TOLERANCE = 1e-6

MAX_SOCKET_PATH_BYTES = 107  # As in tsgt.service, a layer above

Number = Annotated[int, Field(ge=1, le=MAX_NUMBER)]
NumberKey = Annotated[str, Field(pattern=r"^[1-9][0-9]{0,8}$")]
Positive = Annotated[float, Field(gt=0, le=1e6)]
NotNegative = Annotated[float, Field(ge=0, le=1e6)]
Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE_M, le=MAX_COORDINATE_M)]
Place = tuple[Coordinate, Coordinate, Coordinate]


def _without_zero_byte(text: str) -> str:
    if "\0" in text:
        raise ValueError("it cannot contain a zero byte")
    return text


Argument = Annotated[str, AfterValidator(_without_zero_byte)]
"""A word of a command, or a name that the kernel takes."""


def relative_to_file(path: Path, info: ValidationInfo) -> Path:
    """Return a path of a configuration; a relative one counts from the file's folder."""
    if "\0" in str(path):
        raise ValueError("a path cannot contain a zero byte")
    return Path((info.context or {}).get("folder", "")) / path


def _short_enough(path: Path, info: ValidationInfo) -> Path:
    """Reject the path of a socket that cannot be opened; of a file only, as simulated sockets are not opened."""
    size = len(os.fsencode(path))
    if info.context and size > MAX_SOCKET_PATH_BYTES:
        raise ValueError(
            f"the path of a UNIX socket has at most {MAX_SOCKET_PATH_BYTES} bytes, not {size}: {path}"
        )
    return path


RelativePath = Annotated[Path, AfterValidator(relative_to_file)]
SocketPath = Annotated[RelativePath, AfterValidator(_short_enough)]


def rigid(T: Matrix4) -> Matrix4:
    """Reject a matrix that is not a rigid transform; in plain Python, as geometry is a layer above."""
    if T[3] != (0.0, 0.0, 0.0, 1.0):
        raise ValueError("the last row of a rigid transform is [0, 0, 0, 1]")
    for coordinate in (row[3] for row in T[:3]):
        if abs(coordinate) > MAX_COORDINATE_M:
            raise ValueError(
                f"the station is {coordinate:g} m away, at most {MAX_COORDINATE_M:g} m are allowed"
            )
    x, y, z = (row[:3] for row in T[:3])
    products = [(_dot(a, b), i == j) for i, a in enumerate((x, y, z)) for j, b in enumerate((x, y, z))]
    off = max(abs(product - same) for product, same in products)
    if off > RIGID_TOLERANCE:
        raise ValueError(
            f"its 3x3 part is not a rotation: error {off:.1e}, at most {RIGID_TOLERANCE:.0e} is allowed"
        )
    x_cross_y = (x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0])
    if _dot(x_cross_y, z) < 0:
        raise ValueError("its 3x3 part is a reflection: the determinant is -1, that of a rotation is +1")
    return T


def _dot(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    return sum(p * q for p, q in zip(a, b, strict=True))


def unique_by(name: str) -> AfterValidator:
    """Reject an array in which two entries have the same value under the given key."""

    def check(entries: tuple[Any, ...]) -> tuple[Any, ...]:
        numbers = [getattr(entry, name) for entry in entries]
        for number in numbers:
            if numbers.count(number) > 1:
                raise ValueError(f"{name} {number} is given more than once")
        return entries

    return AfterValidator(check)


class Model(BaseModel):
    """Base class: no unknown keys, no type conversions, finite numbers."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        strict=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
        defer_build=True,  # A command uses few of the models, and building all takes a third of a second
    )


class NoiseConfig(Model):
    """Noise of a single measurement, one sigma; the defaults are a tracking Trimble S7."""

    range_sigma_mm: NotNegative = 2.0
    """Constant part of the slope distance noise."""
    range_sigma_ppm: NotNegative = 2.0
    """Part of the slope distance noise that is proportional to the distance."""
    angle_sigma_arcsec: Annotated[float, Field(ge=0, le=648_000)] = 1.0
    """Noise of each angle."""
    pointing_sigma_mm: NotNegative = 1.0
    """Pointing noise at the prism, per axis."""
