"""Errors of estimates as CSV, one line for each compared pose. Columns: docs/reference/compare.md."""

from __future__ import annotations

import csv
import io
import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.compare.errors import TRAVEL_COMPONENTS

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from tsgt.analysis.compare.comparison import Comparison
    from tsgt.geometry import FloatArray

_UNITS = ("m", "m", "m", "rad", "rad", "rad")
_COMPONENTS = [f"{name}_{unit}" for name, unit in zip(TRAVEL_COMPONENTS, _UNITS, strict=True)]
COLUMNS = (
    "estimate",
    "stamp_ns",
    "x_m",
    "y_m",
    "z_m",
    "position_error_m",
    "rotation_error_rad",
    *_COMPONENTS,
    *(f"reference_sigma_{name}" for name in _COMPONENTS),
    "path_m",
    "speed_mps",
    "turn_rate_radps",
)
_BLOCK = 10_000


def error_csv(comparisons: Iterable[Comparison]) -> Iterator[str]:
    """Yield the header and the lines, from which the same doubles are read; cells without a value are empty."""
    yield ",".join(COLUMNS) + "\n"
    for each in comparisons:
        series = each.errors.series
        numbers = np.column_stack(
            [
                each.errors.pairs.reference[:, :3, 3],
                series.position_m,
                series.rotation_rad,
                series.components.value,
                series.components.sigma,
                series.path_m,
                series.speed_mps,
                series.turn_rate_radps,
            ]
        )
        name = _cell(each.name)
        stamps = series.stamp_ns.tolist()
        for start in range(0, len(stamps), _BLOCK):
            yield "".join(_lines(name, stamps[start : start + _BLOCK], numbers[start : start + _BLOCK]))


def _lines(name: str, stamps: Sequence[int], numbers: FloatArray) -> Iterator[str]:
    for stamp, row in zip(stamps, numbers.tolist(), strict=True):
        cells = ("" if math.isnan(value) else repr(value) for value in row)
        yield f"{name},{stamp},{','.join(cells)}\n"


def _cell(text: str) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="").writerow([text])
    return buffer.getvalue()
