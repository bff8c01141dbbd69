"""The command ``analyse gnss``: distances between GNSS receivers and between prisms of the same drive."""

from __future__ import annotations

import dataclasses
import math
from itertools import combinations
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tsgt.analysis.figures import draw_gnss
from tsgt.analysis.formats import QUALITIES, read_pos
from tsgt.analysis.gnss import (
    DistanceErrorStatistics,
    common_interval,
    prism_distances,
    quality_shares,
    receiver_distances,
    receivers,
    time_span,
)
from tsgt.analysis.validation import check_time_span, plausible_measurements
from tsgt.cli.analyse.options import figure_option
from tsgt.cli.options import FiniteRange, json_option, keep_going_option, path_type
from tsgt.cli.output import numbers, print_json, print_table, require_extra
from tsgt.cli.progress import progress
from tsgt.cli.recordings import load
from tsgt.cli.render import clock_time
from tsgt.errors import InputFileError
from tsgt.estimation import build_tracks

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.analysis.gnss import DistanceSeries, Receiver

_ERROR_COLUMNS = ("mean |error|", "std |error|", "p95 |error|", "max |error|")


@click.command()
@click.argument("files", nargs=-1, type=path_type, required=True, metavar="FILE FILE [FILE]...")
@click.option(
    "--reference-mm",
    "references_mm",
    type=FiniteRange(min=0.0, min_open=True, max=1e6),
    multiple=True,
    help="Distance between two receivers, once per pair in the order of the files: 1-2, 1-3, ..., 2-3.  "
    "[default: median of the fixed solutions]",
)
@click.option(
    "--recording",
    type=path_type,
    help="Recording of the same drive, to add the distances between its prisms.",
)
@keep_going_option
@figure_option
@json_option
def gnss(
    *,
    files: tuple[Path, ...],
    references_mm: tuple[float, ...],
    recording: Path | None,
    keep_going: bool,
    figure: Path | None,
    as_json: bool,
) -> None:
    """Compare GNSS receivers with total stations.

    Each FILE is the solution of one receiver by RTKLIB (.pos). On a rigid robot the distances between receivers and
    those between prisms are constant; their variation is a measure of the accuracy of either. Needs tsgt[gnss].
    """
    references_m = _references_m(files, references_mm)
    require_extra("GNSS files", "pymap3d", extra="gnss")
    solutions = []
    with progress("reading") as on_progress:
        for number, path in enumerate(files, start=1):
            solutions.append(read_pos(path))
            if on_progress is not None:
                on_progress(number / len(files))
    found = receivers(solutions)
    pairs = receiver_distances(found, references_m)
    if time_span(pairs) is None:
        raise InputFileError("the receivers do not overlap in time; use files of one drive", path=files[0])
    prisms: tuple[DistanceSeries, ...] = ()
    if recording is not None:
        loaded = load(recording, keep_going=keep_going)
        check_time_span(loaded.parameters, plausible_measurements(loaded), recording)
        tracks = build_tracks(loaded.parameters, loaded.measurements)
        pairs, prisms = common_interval(
            pairs, prism_distances(loaded.parameters, tracks, recording), recording
        )
    # Receivers are switched on long before the drive: reduce them to the time span of the distances.
    both = time_span(pairs)
    assert both is not None  # noqa: S101 (rejected above, and by common_part)
    found = tuple(receiver.between(*both) for receiver in found)
    if figure is not None:
        draw_gnss(found, pairs, prisms, figure)
    if as_json:
        print_json(_keys(found, pairs, prisms, both, given=references_m is not None))
        return
    click.echo(f"{clock_time(both[0])} to {clock_time(both[1])} UTC, {(both[1] - both[0]) / 1e9:.1f} s\n")
    _print_receivers(found)
    origin = (
        "as given"
        if references_m
        else "median of the fixed solutions (of all, if none is fixed), which hides a constant error"
    )
    click.echo(f"\nDistances between receivers (mm); reference: {origin}")
    _print_pairs(pairs)
    if prisms:
        click.echo("\nDistances between prisms at 20 Hz, interpolated, over the same time (mm)")
        _print_pairs(prisms)


def _references_m(files: Sequence[Path], references_mm: Sequence[float]) -> list[float] | None:
    if len(files) < 2:
        raise click.UsageError("give the files of at least two receivers")
    if len({path.resolve() for path in files}) < len(files):
        raise click.UsageError("a file is given twice")
    if not references_mm:
        return None
    names = [f"{a}-{b}" for a, b in combinations(range(1, len(files) + 1), 2)]
    if len(references_mm) != len(names):
        raise click.UsageError(
            f"{len(files)} receivers have {len(names)} distances ({', '.join(names)}); "
            f"give --reference-mm {len(names)} times, not {len(references_mm)} times"
        )
    return [reference_mm / 1e3 for reference_mm in references_mm]


def _keys(
    found: Sequence[Receiver],
    pairs: Sequence[DistanceSeries],
    prisms: Sequence[DistanceSeries],
    both: tuple[int, int],
    *,
    given: bool,
) -> dict[str, Any]:
    keys = {
        "receivers": {
            receiver.name: {
                "file": str(receiver.path),
                "time_system": receiver.time_system,
                "positions": len(receiver.times_ns),
                "without_position": receiver.without_position,
                "satellites": _satellites(receiver),
                "quality": quality_shares(receiver),
            }
            for receiver in found
        },
        "start_ns": both[0],
        "end_ns": both[1],
        "reference": "given" if given else "median",
        "inter_receiver_mm": {pair.name: _figures(pair) for pair in pairs},
        "inter_receiver_all_mm": _errors(_all_errors_m(pairs)),
    }
    if prisms:
        keys["inter_prism_mm"] = {pair.name: _figures(pair) for pair in prisms}
        keys["inter_prism_all_mm"] = _errors(_all_errors_m(prisms))
    return keys


def _satellites(receiver: Receiver) -> dict[str, float]:
    used = receiver.satellites
    if not len(used):
        return dict.fromkeys(("mean", "std", "min", "max"), math.nan)
    return {
        "mean": float(np.mean(used)),
        "std": float(np.std(used)),
        "min": int(np.min(used)),
        "max": int(np.max(used)),
    }


def _figures(pair: DistanceSeries) -> dict[str, Any]:
    found = 1e3 * pair.distances_m
    empty = len(found) == 0
    by_quality = {QUALITIES[q]: _errors(errors_m) for q, errors_m in pair.by_quality().items()}
    return {
        "reference": 1e3 * pair.reference_m,
        "mean": math.nan if empty else float(np.mean(found)),
        "std": math.nan if empty else float(np.std(found)),
        **_errors(pair.errors_m),
        "invalid": len(pair.invalid_ns),
        **({"by_quality": by_quality} if pair.quality is not None else {}),
    }


def _all_errors_m(pairs: Sequence[DistanceSeries]) -> NDArray[np.float64]:
    return np.concatenate([pair.errors_m for pair in pairs])


def _errors(errors_m: NDArray[np.float64]) -> dict[str, Any]:
    return dataclasses.asdict(DistanceErrorStatistics.of(errors_m))


def _print_receivers(found: Sequence[Receiver]) -> None:
    rows = []
    for receiver in found:
        satellites = _satellites(receiver)
        rows.append(
            [
                receiver.name,
                str(len(receiver.times_ns)),
                str(receiver.without_position),
                *numbers(satellites["mean"], satellites["std"], digits=1),
                f"{satellites['min']} to {satellites['max']}" if len(receiver.times_ns) else "-",
                ", ".join(f"{name} {share:.1%}" for name, share in quality_shares(receiver).items()) or "-",
            ]
        )
    print_table(["receiver", "positions", "epochs without", "satellites", "std", "range", "quality"], rows)


def _print_pairs(pairs: Sequence[DistanceSeries]) -> None:
    rows = []
    for pair in pairs:
        figures = _figures(pair)
        cells = numbers(figures["reference"], figures["mean"], figures["std"], digits=1)
        rows.append([pair.name, str(figures["valid"]), *cells, *_error_cells(pair.errors_m)])
        of_quality = pair.by_quality()
        if len(of_quality) > 1:
            rows += [
                [f"  {QUALITIES[q]}", str(len(errors_m)), "", "", "", *_error_cells(errors_m)]
                for q, errors_m in of_quality.items()
            ]
    if len(pairs) > 1:
        errors_m = _all_errors_m(pairs)
        rows.append(["all", str(len(errors_m)), "", "", "", *_error_cells(errors_m)])
    print_table(["pair", "n", "reference", "mean", "std", *_ERROR_COLUMNS], rows)


def _error_cells(errors_m: NDArray[np.float64]) -> list[str]:
    found = DistanceErrorStatistics.of(errors_m)
    return numbers(found.mean_abs_error, found.std_abs_error, found.p95, found.max, digits=1)
