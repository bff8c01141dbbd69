"""The command ``import``. A module of its own: what solves station frames is slow to load."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import click

from tsgt.analysis.formats import check_tracks, read_polar_tracks, read_prisms, read_tracks, station_prisms
from tsgt.analysis.processing import with_frames, with_latencies, with_targets
from tsgt.analysis.rts_import import point_measurements, polar_measurements, stations_from_targets
from tsgt.cli.options import constant_type, finite, json_option, path_type
from tsgt.cli.output import print_json
from tsgt.cli.recordings import refuse_to_replace, write_recording
from tsgt.config import load_station_frames, load_station_latencies, load_target_residuals
from tsgt.model import Parameters, StationParameters

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tsgt.analysis.rts_import import SolvedStations
    from tsgt.model import Measurement


def _three_files(
    _context: click.Context, _parameter: click.Parameter, value: tuple[Path, Path, Path]
) -> tuple[Path, Path, Path]:
    """Refuse options among the files: click takes the next three words, whatever they are."""
    for path in value:
        if str(path).startswith("--"):
            raise click.BadParameter(
                f"takes three files, one after the other, but {path} stands between them"
            )
    return value


@click.group("import")
def import_group() -> None:
    """Bring other people's data into a recording."""


target_constant_option = click.option(
    "--target-constant-mm",
    type=constant_type,
    callback=finite,
    default=10.0,
    show_default=True,
    help="Added to the distances of the targets.",
)
output_option = click.option(
    "--output", type=path_type, required=True, help="The recording to write; replaced if it exists."
)


@import_group.command("rts")
@click.option(
    "--tracks",
    type=path_type,
    nargs=3,
    required=True,
    callback=_three_files,
    help="Published tracks of prisms 1, 2 and 3.",
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
@target_constant_option
@click.option(
    "--prism-constant-mm",
    type=constant_type,
    callback=finite,
    default=10.0,
    show_default=True,
    help="Taken off the distances to the prisms on the way back to raw measurements.",
)
@output_option
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
        stations = _told(solved)
        measurements = polar_measurements(published, stations)
    write_recording(
        output,
        source=f"import rts: {' '.join(path.name for path in sources)}",
        parameters=Parameters(stations=stations, prisms=layout),
        records=measurements,
    )
    _tell(output, measurements, as_json=as_json)


@import_group.command("polar")
@click.option(
    "--tracks",
    type=path_type,
    multiple=True,
    required=True,
    help="CSV of raw measurements; once for a file of all stations, or once for each.",
)
@click.option(
    "--prisms",
    type=path_type,
    required=True,
    help="A prism layout (.toml), or the authors' sensor_positions.csv.",
)
@click.option("--frames", type=path_type, help="Where the stations stand (set-up file).")
@click.option("--targets", type=path_type, help="Targets of the same day instead: solve the stations.")
@target_constant_option
@click.option(
    "--prism-constant-mm",
    type=constant_type,
    callback=finite,
    default=0.0,
    show_default=True,
    help="What the distances to the prisms lack: added to them whenever poses are computed.",
)
@output_option
@json_option
def import_polar(
    *,
    tracks: tuple[Path, ...],
    prisms: Path,
    frames: Path | None,
    targets: Path | None,
    target_constant_mm: float,
    prism_constant_mm: float,
    output: Path,
    as_json: bool,
) -> None:
    """Import raw measurements of total stations: time, horizontal angle, zenith angle, slope distance.

    A track is a CSV file whose first line names the columns, with their units: those of `tsgt export --format csv
    --records measurements`, or fewer. Needed are stamp_ns or time_s (Unix time), horizontal_angle_rad, _deg or _gon,
    zenith_angle_rad, _deg or _gon, and slope_distance_m. Without a column station the first file is that of station 1, and
    so on; without a column prism each station tracks the prism of its own number.
    """
    if (frames is None) == (targets is None):
        raise click.UsageError("where the stations stand has to be known: give --frames or --targets")
    sources = [*tracks, prisms, *(path for path in (frames, targets) if path is not None)]
    refuse_to_replace(sources, output)
    measurements = read_polar_tracks(tracks)
    check_tracks(measurements, tracks)
    tracked = station_prisms(measurements)
    layout = read_prisms(prisms, sorted({m.prism for m in measurements}))
    constant_m = prism_constant_mm / 1e3
    if targets is not None:
        solved = stations_from_targets(
            targets,
            target_constant_m=target_constant_mm / 1e3,
            prism_constant_m=constant_m,
            tracked=tracked,
        )
        parameters = Parameters(stations=_told(solved), prisms=layout)
    else:
        assert frames is not None  # noqa: S101 (one of them is given)
        stations = (
            StationParameters(station=k, prism=p, prism_constant_m=constant_m) for k, p in tracked.items()
        )
        parameters = Parameters(stations=tuple(stations), prisms=layout)
        parameters = with_frames(parameters, load_station_frames(frames), path=frames)
        parameters = with_latencies(parameters, load_station_latencies(frames))
        parameters = with_targets(parameters, load_target_residuals(frames))
    write_recording(
        output,
        source=f"import polar: {' '.join(path.name for path in sources)}",
        parameters=parameters,
        records=measurements,
    )
    _tell(output, measurements, as_json=as_json)


def _told(solved: SolvedStations) -> tuple[StationParameters, ...]:
    """Take the solved stations, and say what the user should know of the targets."""
    for note in solved.notes:
        click.echo(f"note: {note}", err=True)
    return solved.stations


def _tell(output: Path, measurements: Sequence[Measurement], *, as_json: bool) -> None:
    """Say what has been imported."""
    stamps = [m.stamp_ns for m in measurements]
    duration_s = (max(stamps) - min(stamps)) / 1e9
    per_station = dict(sorted(Counter(m.station for m in measurements).items()))
    if as_json:
        print_json({"measurements": len(measurements), "duration_s": duration_s, "stations": per_station})
        return
    counts = ", ".join(f"{n} of station {k}" for k, n in per_station.items())
    click.echo(f"{output}: {len(measurements)} measurements ({counts}) over {duration_s:.1f} s")
