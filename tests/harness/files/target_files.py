"""Files of simulated targets, and the configuration of a master whose set-up files they give."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pathlib import Path

    from harness.instruments.target_field import TargetField


def write_targets(field: TargetField, folder: Path, *, ppm: tuple[float, ...] = ()) -> Path:
    """Write the measurements of a simulated field of targets to a file; ``ppm``: atmospheric corrections of the stations."""
    readings = field.measure()
    rows = zip(
        readings.station + 1,
        readings.target + 1,
        (readings.horizontal_rad % (2 * np.pi)).tolist(),
        readings.zenith_rad.tolist(),
        readings.distance_m.tolist(),
        strict=True,
    )
    lines = ["station,target,horizontal_angle_rad,zenith_angle_rad,slope_distance_m"]
    lines += [",".join(map(str, row)) for row in rows]
    if ppm:
        columns = ["atmospheric_ppm", *(f"{ppm[station]}" for station in readings.station.tolist())]
        lines = [f"{line},{column}" for line, column in zip(lines, columns, strict=True)]
    path = folder / "simulated.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def write_master(path: Path, *, ppm: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
    """Write the configuration of a master of three stations, with ``frames.toml`` and ``layout.toml`` beside it."""
    stations = "".join(
        f"[[stations]]\nstation = {number}\nprism = {number}\nprism_constant_mm = 0.0\natmospheric_ppm = {value}\n"
        for number, value in enumerate(ppm, start=1)
    )
    path.write_text(
        f'kind = "master"\n{stations}[setup]\nstation_frames = "frames.toml"\nprism_layout = "layout.toml"\n'
        '[radio]\nkind = "simulated"\nair_socket = "air.sock"\nname = "master"\nfrequency_mhz = 905.0\n'
        'spreading_factor = 9\n[protocol]\nkind = "classic"\n[stream]\nsocket = "poses.sock"\n',
        encoding="utf-8",
    )
