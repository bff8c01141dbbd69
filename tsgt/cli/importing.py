"""The command ``import``. A module of its own: what solves station frames is slow to load."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from tsgt.analysis.rts_files import read_prisms, read_tracks
from tsgt.analysis.rts_import import point_measurements, polar_measurements, stations_from_targets
from tsgt.cli.options import finite, json_option, path_type
from tsgt.cli.output import print_json
from tsgt.cli.recordings import refuse_to_replace, write_recording
from tsgt.model import Parameters, StationParameters

if TYPE_CHECKING:
    from pathlib import Path


@click.group("import")
def import_group() -> None:
    """Bring other people's data into a recording."""


@import_group.command("rts")
@click.option(
    "--tracks", type=path_type, nargs=3, required=True, help="Published tracks of prisms 1, 2 and 3."
)
@click.option(
    "--prisms",
    type=path_type,
    required=True,
    help="The authors' sensor_positions.csv, or a prism layout (.toml).",
)
@click.option(
    "--targets", type=path_type, help="Targets of the same day: solve the stations, go back to raw angles."
)
@click.option(
    "--target-constant-mm",
    type=float,
    callback=finite,
    default=10.0,
    show_default=True,
    help="Added to the distances of the targets.",
)
@click.option(
    "--prism-constant-mm",
    type=float,
    callback=finite,
    default=10.0,
    show_default=True,
    help="Taken off the distances to the prisms on the way back to raw measurements.",
)
@click.option(
    "--output", type=path_type, required=True, help="The recording to write; replaced if it exists."
)
@json_option
def import_rts(
    *,
    tracks: tuple[Path, Path, Path],
    prisms: Path,
    targets: Path | None,
    target_constant_mm: float,
    prism_constant_mm: float,
    output: Path,
    as_json: bool,
) -> None:
    """Import the tracks that the authors of the founding paper published.

    A track is a text file with Unix time (s) and x, y, z (m) in the frame of station 1, separated by spaces. With
    the day's targets each point is taken back to the angles and the distance that its station measured; without
    them the points are recorded as they are.
    """
    sources = [*tracks, prisms, *([targets] if targets else [])]
    refuse_to_replace(sources, output)
    published = read_tracks(tracks)
    layout = read_prisms(prisms)
    if targets is None:
        stations = tuple(StationParameters(station=k, prism=k) for k in (1, 2, 3))
        measurements = point_measurements(published)
    else:
        solved = stations_from_targets(
            targets, target_constant_m=target_constant_mm / 1e3, prism_constant_m=prism_constant_mm / 1e3
        )
        stations = solved.stations
        for note in solved.notes:
            click.echo(f"note: {note}", err=True)
        measurements = polar_measurements(published, stations)
    write_recording(
        output,
        source=f"import rts: {' '.join(path.name for path in sources)}",
        parameters=Parameters(stations=stations, prisms=layout),
        records=measurements,
    )
    duration_s = (measurements[-1].stamp_ns - measurements[0].stamp_ns) / 1e9
    per_station = {k: len(track.stamps_ns) for k, track in enumerate(published, start=1)}
    if as_json:
        print_json({"measurements": len(measurements), "duration_s": duration_s, "stations": per_station})
        return
    counts = ", ".join(f"{n} of station {k}" for k, n in per_station.items())
    click.echo(f"{output}: {len(measurements)} measurements ({counts}) over {duration_s:.1f} s")
