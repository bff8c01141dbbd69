"""The authors' file formats, filled from a simulated scene: tracks, prism positions, targets."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from harness.drives.scene import FRAMES, LAYOUT, driving

from tsgt.geometry import cartesian_to_polar, invert, transform_points

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from harness.drives.scene import Motion
    from numpy.typing import NDArray

TARGETS = np.array(
    [[20.0, 3.0, 0.5], [5.0, 18.0, -0.5], [-14.0, 9.0, 1.0], [-8.0, -16.0, 0.2], [12.0, -11.0, 2.0]]
)
TARGET_CONSTANT_M = 0.01

CONSTANTS = ("--target-constant-mm", "10", "--prism-constant-mm", "10")
"""Options of ``tsgt import`` with these targets."""


def write_tracks(
    folder: Path, motion: Callable[[float], Motion] = driving, *, duration_s: float = 10.0
) -> tuple[Path, Path, Path]:
    """Write three exact tracks at 2.5 Hz with a phase per station; Unix times with seven decimals."""
    paths = (folder / "trimble1.csv", folder / "trimble2.csv", folder / "trimble3.csv")
    for prism, path in enumerate(paths):
        lines = []
        for step in range(int(duration_s / 0.4)):
            time_s = 0.4 * step + 0.11 * prism + 0.0000123
            rotation, position = motion(time_s)
            point = rotation @ LAYOUT[prism] + position
            lines.append(f"{1_700_000_000 + int(time_s)}.{f'{time_s % 1:.7f}'[2:]} {_row(point)}")
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return paths


def write_prisms(folder: Path, layout: NDArray[np.float64] = LAYOUT) -> Path:
    """Write ``sensor_positions.csv``: position, 1, nine elements of a covariance."""
    path = folder / "sensor_positions.csv"
    tail = " ".join(["1.0", *["0.0"] * 9])
    path.write_text("".join(f"{_row(row)} {tail}\n" for row in layout), encoding="utf-8")
    return path


def write_targets(folder: Path, stations: Sequence[int] = (1, 2, 3)) -> Path:
    """Write a marker file with exact measurements of the targets by the given stations."""
    path = folder / "GCP.txt"
    lines = ["theodolite_number , marker_number , status , elevation , azimuth , distance , sec , nsec"]
    for station in stations:
        horizontal, zenith, distance = cartesian_to_polar(
            transform_points(invert(FRAMES[station - 1]), TARGETS)
        )
        lines += [
            f"{station} , {k + 1} , 0 , {float(z)!r} , {float(h)!r} , {float(d) - TARGET_CONSTANT_M!r} , 0 , 0"
            for k, (h, z, d) in enumerate(zip(horizontal, zenith, distance, strict=True))
        ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _row(values: NDArray[np.float64]) -> str:
    return " ".join(repr(float(value)) for value in values)
