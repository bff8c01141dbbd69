"""The command ``analyse gnss``: distances between satellite receivers, beside those between prisms."""

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
    DistanceErrors,
    common_part,
    prism_pairs,
    quality_shares,
    receiver_pairs,
    receivers,
    span,
)
from tsgt.cli.analyse.options import figure_option
from tsgt.cli.options import json_option, keep_going_option, path_type
from tsgt.cli.output import print_json, print_table
from tsgt.cli.recordings import load, progress
from tsgt.cli.render import clock_time
from tsgt.errors import InputFileError
from tsgt.estimation import build_tracks

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.analysis.gnss import Distances, Receiver

_HEADER = [
    "pair",
    "n",
    "reference",
    "mean",
    "std",
    "mean |error|",
    "std |error|",
    "p95 |error|",
    "max |error|",
]


@click.command()
@click.argument("files", nargs=-1, type=path_type, required=True, metavar="FILE FILE [FILE]...")
@click.option(
    "--reference-mm",
    "references_mm",
    type=click.FloatRange(min=0.0, min_open=True, max=1e6),
    multiple=True,
    help="Distance between two receivers, once per pair: of 1-2, then 1-3, ..., 2-3, as the files are given.  "
    "[default: the median of the fixed ones]",
)
@click.option(
    "--recording",
    type=path_type,
    help="Recording of the same drive: the distances between its prisms, over the time that both have.",
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
    """Compare satellite receivers with total stations.

    Each FILE is one receiver's solution as RTKLIB wrote it (.pos). However the robot moves, the distances between
    receivers on it do not change, nor do those between its prisms: how far they stray tells how good either is.
    """
    references_m = _references_m(files, references_mm)
    solutions = []
    with progress("reading") as on_progress:
        for number, path in enumerate(files, start=1):
            solutions.append(read_pos(path))
            if on_progress is not None:
                on_progress(number / len(files))
    found = receivers(solutions)
    pairs = receiver_pairs(found, references_m)
    if span(pairs) is None:
        raise InputFileError(
            "the receivers have no time in common; take the files of one drive", path=files[0]
        )
    prisms: tuple[Distances, ...] = ()
    if recording is not None:
        loaded = load(recording, keep_going=keep_going)
        tracks = build_tracks(loaded.parameters, loaded.measurements)
        pairs, prisms = common_part(pairs, prism_pairs(loaded.parameters, tracks, recording), recording)
    # Receivers are switched on long before the drive; their figures are to be of the same time as the distances.
    both = span(pairs)
    assert both is not None  # noqa: S101 (refused above, and by common_part)
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
        else "the median of fixed ones (of all, where none is): an error that is always there does not show"
    )
    click.echo(f"\nDistances between receivers (mm); reference {origin}")
    _print_pairs(pairs)
    if prisms:
        click.echo("\nDistances between prisms at 20 Hz, interpolated, over the same time (mm)")
        _print_pairs(prisms)


def _references_m(files: Sequence[Path], references_mm: Sequence[float]) -> list[float] | None:
    if len(files) < 2:
        raise click.UsageError("takes the files of two receivers at least")
    if len({path.resolve() for path in files}) < len(files):
        raise click.UsageError("one of the files is given twice")
    if not references_mm:
        return None
    if not all(map(math.isfinite, references_mm)):
        raise click.UsageError("--reference-mm takes finite numbers")
    names = [f"{a}-{b}" for a, b in combinations(range(1, len(files) + 1), 2)]
    if len(references_mm) != len(names):
        raise click.UsageError(
            f"{len(files)} receivers have {len(names)} distances ({', '.join(names)}); "
            f"give --reference-mm so many times, not {len(references_mm)} times"
        )
    return [reference_mm / 1e3 for reference_mm in references_mm]


def _keys(
    found: Sequence[Receiver],
    pairs: Sequence[Distances],
    prisms: Sequence[Distances],
    both: tuple[int, int],
    *,
    given: bool,
) -> dict[str, Any]:
    return {
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
        "inter_receiver_all_mm": _together(pairs),
        **(
            {
                "inter_prism_mm": {pair.name: _figures(pair) for pair in prisms},
                "inter_prism_all_mm": _together(prisms),
            }
            if prisms
            else {}
        ),
    }


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


def _figures(pair: Distances) -> dict[str, Any]:
    found = 1e3 * pair.distances_m
    nothing = len(found) == 0
    by_quality = {QUALITIES[q]: _errors(errors_m) for q, errors_m in pair.by_quality().items()}
    return {
        "reference": 1e3 * pair.reference_m,
        "mean": math.nan if nothing else float(np.mean(found)),
        "std": math.nan if nothing else float(np.std(found)),
        **_errors(pair.errors_m),
        "invalid": len(pair.invalid_ns),
        **({"by_quality": by_quality} if pair.quality is not None else {}),
    }


def _together(pairs: Sequence[Distances]) -> dict[str, Any]:
    return _errors(np.concatenate([pair.errors_m for pair in pairs]))


def _errors(errors_m: NDArray[np.float64]) -> dict[str, Any]:
    return dataclasses.asdict(DistanceErrors.of(errors_m))


def _print_receivers(found: Sequence[Receiver]) -> None:
    rows = []
    for receiver in found:
        satellites = _satellites(receiver)
        rows.append(
            [
                receiver.name,
                str(len(receiver.times_ns)),
                str(receiver.without_position),
                *_numbers(satellites["mean"], satellites["std"]),
                f"{satellites['min']} to {satellites['max']}" if len(receiver.times_ns) else "-",
                ", ".join(f"{name} {share:.1%}" for name, share in quality_shares(receiver).items()) or "-",
            ]
        )
    print_table(["receiver", "positions", "epochs without", "satellites", "std", "range", "quality"], rows)


def _print_pairs(pairs: Sequence[Distances]) -> None:
    rows = []
    for pair in pairs:
        figures = _figures(pair)
        rows.append(
            [
                pair.name,
                str(figures["valid"]),
                *_numbers(figures["reference"], figures["mean"], figures["std"]),
                *_error_cells(pair.errors_m),
            ]
        )
        of_quality = pair.by_quality()
        if len(of_quality) > 1:
            rows += [
                [f"  {QUALITIES[q]}", str(len(errors_m)), "", "", "", *_error_cells(errors_m)]
                for q, errors_m in of_quality.items()
            ]
    if len(pairs) > 1:
        together = np.concatenate([pair.errors_m for pair in pairs])
        rows.append(["all", str(len(together)), "", "", "", *_error_cells(together)])
    print_table(_HEADER, rows)


def _error_cells(errors_m: NDArray[np.float64]) -> list[str]:
    found = DistanceErrors.of(errors_m)
    return _numbers(found.mean_abs_error, found.std_abs_error, found.p95, found.max)


def _numbers(*figures: float) -> list[str]:
    return ["-" if math.isnan(figure) else f"{figure:.1f}" for figure in figures]
