"""The command ``import``."""

from __future__ import annotations

from collections import Counter
from itertools import chain
from typing import TYPE_CHECKING

import click

from tsgt.analysis.formats import (
    check_tracks,
    read_partial_target_file,
    read_polar_tracks,
    read_prisms,
    read_tracks,
    tracked_prisms,
)
from tsgt.analysis.rts_import import (
    DEFAULT_TRACKED_PRISMS,
    point_measurements,
    polar_measurements,
    stations_from_targets,
)
from tsgt.analysis.setup_replacement import with_calibration
from tsgt.analysis.text_file import utf8_name
from tsgt.cli.convert.cut_tables import note_cut_tables
from tsgt.cli.convert.import_imu import import_imu
from tsgt.cli.convert.import_odometry import import_odometry
from tsgt.cli.options import (
    RECORDING_SUFFIXES,
    OutputFile,
    PathsOption,
    constant_m,
    constant_option,
    json_option,
    path_type,
)
from tsgt.cli.output import print_json, refuse_overwrite
from tsgt.cli.recordings import write_recording
from tsgt.config import load_prism_layout, load_station_calibration, setup_covariance
from tsgt.errors import DegenerateGeometryError
from tsgt.geometry import check_layout
from tsgt.model import Parameters, StationParameters

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from tsgt.analysis.rts_import import SolvedStations
    from tsgt.model import Measurement, PrismPosition, SetupCovariance

PRISM_CONSTANT = "--prism-constant-mm"
TARGET_CONSTANT = "--target-constant-mm"


@click.group("import")
def import_group() -> None:
    """Convert other formats to a recording."""


import_group.add_command(import_imu)
import_group.add_command(import_odometry)

prisms_option = click.option(
    "--prisms",
    type=path_type,
    required=True,
    help="Prism layout (set-up file), or the authors' sensor_positions.csv.",
)
targets_option = click.option(
    "--targets", type=path_type, help="Targets of the same day, from which the station frames are solved."
)
target_constant_option = constant_option(
    TARGET_CONSTANT, "Constant added to the distances of targets, required if their file has none."
)
output_option = click.option(
    "--output",
    type=OutputFile(*RECORDING_SUFFIXES),
    required=True,
    help="Recording to write (.jsonl); replaced if it exists.",
)


@import_group.command("rts")
@click.option("--tracks", cls=PathsOption, required=True, help="Published tracks of prisms 1, 2 and 3.")
@prisms_option
@targets_option
@target_constant_option
@constant_option(
    PRISM_CONSTANT,
    "Constant subtracted from the distances to the prisms to obtain raw measurements, required with --targets.",
)
@output_option
@json_option
def import_rts(
    *,
    tracks: tuple[Path, ...],
    prisms: Path,
    targets: Path | None,
    target_constant_mm: float | None,
    prism_constant_mm: float | None,
    output: Path,
    as_json: bool,
) -> None:
    """Import the published tracks of the paper.

    A track is a text file with Unix time (s) and x, y, z (m) in the frame of station 1, separated by spaces. With the
    targets of the day each point is converted back to the angles and the distance that its station measured; without
    them the points are recorded.
    """
    if len(tracks) != len(DEFAULT_TRACKED_PRISMS):
        raise click.UsageError(
            f"--tracks takes {len(DEFAULT_TRACKED_PRISMS)} files, one per prism; got {len(tracks)}"
        )
    sources = [*tracks, prisms, *([targets] if targets else [])]
    refuse_overwrite(sources, output)
    if targets is None:
        for option, given in ((TARGET_CONSTANT, target_constant_mm), (PRISM_CONSTANT, prism_constant_mm)):
            if given is not None:
                raise click.UsageError(f"{option} is for raw measurements, which need --targets")
    published = read_tracks((tracks[0], tracks[1], tracks[2]))
    note_cut_tables(tracks)
    layout = read_prisms(prisms)
    if targets is None:
        stations = tuple(StationParameters(station=k, prism=k) for k in (1, 2, 3))
        parameters = _parameters(stations, layout, prisms)
        measurements = point_measurements(published)
    else:
        solved = _solved_stations(targets, target_constant_mm, prism_constant_mm, DEFAULT_TRACKED_PRISMS)
        parameters = _parameters(solved.stations, layout, prisms, solved.covariance)
        measurements = polar_measurements(published, solved.stations)
    write_recording(
        output,
        source=f"import rts: {' '.join(utf8_name(path.name) for path in sources)}",
        parameters=parameters,
        records=measurements,
    )
    _print_summary(output, measurements, as_json=as_json)


@import_group.command("polar")
@click.option(
    "--tracks",
    cls=PathsOption,
    required=True,
    help="CSV files of raw measurements: one for all stations, or one each.",
)
@prisms_option
@click.option("--frames", type=path_type, help="Station frames (set-up file).")
@targets_option
@target_constant_option
@constant_option(
    PRISM_CONSTANT, "Constant added to the distances to the prisms when poses are computed.", required=True
)
@output_option
@json_option
def import_polar(
    *,
    tracks: tuple[Path, ...],
    prisms: Path,
    frames: Path | None,
    targets: Path | None,
    target_constant_mm: float | None,
    prism_constant_mm: float,
    output: Path,
    as_json: bool,
) -> None:
    """Import raw measurements of total stations.

    A track is a CSV file whose header names the columns with their units, as written by `tsgt export --format csv
    --records measurements`. Required are stamp_ns or time_s (Unix time), horizontal_angle_rad, _deg or _gon,
    zenith_angle_rad, _deg or _gon, and slope_distance_m. Without a column station the first file is that of station 1,
    and so on; without a column prism each station tracks the prism of its own number.
    """
    if (frames is None) == (targets is None):
        raise click.UsageError("the station frames are unknown: give --frames or --targets")
    if targets is None and target_constant_mm is not None:
        raise click.UsageError(f"{TARGET_CONSTANT} belongs to --targets")
    sources = [*tracks, prisms, *(path for path in (frames, targets) if path is not None)]
    refuse_overwrite(sources, output)
    measurements = read_polar_tracks(tracks)
    note_cut_tables(tracks)
    check_tracks(measurements, tracks)
    tracked = tracked_prisms(measurements)
    layout = read_prisms(prisms, sorted({m.prism for m in measurements}), imu=True)
    _note_need_of_imu(layout, prisms)
    if targets is not None:
        solved = _solved_stations(targets, target_constant_mm, prism_constant_mm, tracked)
        parameters = _parameters(solved.stations, layout, prisms, solved.covariance)
    else:
        assert frames is not None  # noqa: S101 (one of them is given)
        constant = prism_constant_mm / 1e3
        stations = (
            StationParameters(station=k, prism=p, prism_constant_m=constant) for k, p in tracked.items()
        )
        parameters = with_calibration(
            _parameters(tuple(stations), layout, prisms), load_station_calibration(frames), path=frames
        )
    write_recording(
        output,
        source=f"import polar: {' '.join(utf8_name(path.name) for path in sources)}",
        parameters=parameters,
        records=measurements,
    )
    _print_summary(output, measurements, as_json=as_json)


def _note_need_of_imu(layout: tuple[PrismPosition, ...], path: Path) -> None:
    """Print a note where the prisms give poses with an IMU alone, whose samples and set-up are given with the recording."""
    try:
        check_layout([prism.position_m for prism in layout], names=[prism.prism for prism in layout])
    except DegenerateGeometryError as error:
        click.echo(f"note: {path}: {error}; tsgt process needs --imu and --imu-setup", err=True)


def _solved_stations(
    targets: Path,
    target_constant_mm: float | None,
    prism_constant_mm: float | None,
    tracked: Mapping[int, int],
) -> SolvedStations:
    """Solve the station frames from targets, and print notes on them."""
    if prism_constant_mm is None:
        raise click.UsageError(
            f"--targets needs {PRISM_CONSTANT}, the prism constant that the published positions already contain"
        )
    measured = read_partial_target_file(targets)
    sights = (
        sight for seen in measured.measurements.values() for sight in chain.from_iterable(seen.values())
    )
    solved = stations_from_targets(
        targets,
        target_constant_m=constant_m(TARGET_CONSTANT, target_constant_mm, sights, targets),
        prism_constant_m=prism_constant_mm / 1e3,
        tracked=tracked,
    )
    for note in solved.notes:
        click.echo(f"note: {note}", err=True)
    return solved


def _parameters(
    stations: tuple[StationParameters, ...],
    layout: tuple[PrismPosition, ...],
    prisms: Path,
    covariance: SetupCovariance | None = None,
) -> Parameters:
    """Return parameters with the covariance of the frames, and of a prism layout from a set-up file."""
    of_prisms = load_prism_layout(prisms).covariance if prisms.suffix == ".toml" else None
    return Parameters(
        stations=stations,
        prisms=layout,
        setup_covariance=setup_covariance(
            covariance,
            of_prisms,
            station_numbers=(s.station for s in stations),
            prism_numbers=(p.prism for p in layout),
        ),
    )


def _print_summary(output: Path, measurements: Sequence[Measurement], *, as_json: bool) -> None:
    stamps = [m.stamp_ns for m in measurements]
    duration_s = (max(stamps) - min(stamps)) / 1e9
    per_station = dict(sorted(Counter(m.station for m in measurements).items()))
    if as_json:
        print_json({"measurements": len(measurements), "duration_s": duration_s, "stations": per_station})
        return
    counts = ", ".join(f"station {k}: {n}" for k, n in per_station.items())
    click.echo(f"{output}: {len(measurements)} measurements ({counts}) over {duration_s:.1f} s")
