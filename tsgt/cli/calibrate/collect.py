"""The command ``tsgt calibrate collect``: the operator aims, the stations measure over the radio."""

from __future__ import annotations

import asyncio
import os
from typing import TYPE_CHECKING

import click

from tsgt.analysis.calibration import TargetCalibration, TargetCollection, target_notes
from tsgt.cli.calibrate.operator import Terminal
from tsgt.cli.calibrate.session import target_session
from tsgt.cli.options import OutputFile, constant_option, master_config_option
from tsgt.cli.output import print_table
from tsgt.clock import SystemClock
from tsgt.config import MasterConfig, load
from tsgt.recording import write_atomically

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tsgt.analysis.calibration import StationTarget
    from tsgt.cli.calibrate.operator import Operator
    from tsgt.cli.calibrate.session import TargetSession
    from tsgt.geometry.target_calibration import FrameCalibration, PointName

KEYS = "Enter measures, s skips, r repeats the last one (r 3: target 3, r 2 3: of station 2), q quits"


@click.command()
@master_config_option
@click.option(
    "--output",
    type=OutputFile(".csv"),
    required=True,
    help="File of targets to write (.csv); an existing one is continued.",
)
@click.option(
    "--target-count", type=click.IntRange(min=3), default=6, help="Number of targets, numbered from 1."
)
@click.option(
    "--repeats",
    type=click.IntRange(min=1),
    default=1,
    help="Measurements of each target by each station; 2 for both faces.",
)
@constant_option(
    "--target-constant-mm", "Constant added to each distance, written to the file.", required=True
)
def collect(
    *, config_path: Path, output: Path, target_count: int, repeats: int, target_constant_mm: float
) -> None:
    """Measure targets with all stations over the radio.

    Stop tsgt-master first, which owns the radio. The command asks for one target after the other: aim the instrument
    by hand, then press Enter to measure. Every measurement is written to the file at once; after Ctrl-C or q the same
    command continues.
    """
    config = load(config_path, MasterConfig)
    stations = sorted(station.station for station in config.stations)
    collection = TargetCollection(output, stations, range(1, target_count + 1), repeats=repeats)
    collection.resume()
    _write(collection)  # before anybody aims: the folder may not exist

    async def run() -> None:
        operator = Terminal()
        async with target_session(config, config_path, SystemClock(), operator.say) as session:
            await collect_targets(collection, session, operator, constant_m=target_constant_mm / 1e3)

    asyncio.run(run())
    missing = len(list(collection.outstanding()))
    if missing:
        click.echo(f"{output}: {missing} measurements are missing; the same command continues", err=True)
    else:
        sudo = (
            "sudo " if os.geteuid() == 0 else ""
        )  # as this command was started: the configuration is root's
        click.echo(
            f"{output}: complete. Next: {sudo}tsgt calibrate targets {output} --apply {config_path}", err=True
        )


async def collect_targets(
    collection: TargetCollection, session: TargetSession, operator: Operator, *, constant_m: float
) -> None:
    """Guide the operator until every target is measured or skipped, or the operator quits.

    Parameters
    ----------
    collection
        Existing measurements; its file is written after each change.
    constant_m
        Constant of the targets in m.
    """
    skipped: set[StationTarget] = set()
    last: StationTarget | None = None
    while True:
        cell = collection.next(skipped)
        if cell is None:
            question = "all targets are measured or skipped. Enter ends, r repeats as above"
        else:
            question = f"station {cell[0]}, target {cell[1]}: aim. {KEYS}"
        reply = await operator.ask(question)
        key, *arguments = (reply or "").split() or [""]
        if reply is None or key == "q" or (cell is None and key == ""):
            return
        if key == "r":
            skipped.discard(_repeat(collection, operator, arguments, last))
        elif cell is None or arguments or key not in ("", "s"):
            operator.say(f"unknown key {reply!r}")
        elif key == "s":
            skipped.add(cell)
        elif (sight := await session.try_measure(operator, cell[0], constant_m)) is not None:
            collection.add(*cell, sight)
            _write(collection)
            last = cell
            operator.say(f"measured: {sight.slope_distance_m:.4f} m")
            _print_progress(collection, skipped, cell[0])


def _repeat(
    collection: TargetCollection, operator: Operator, arguments: Sequence[str], last: StationTarget | None
) -> StationTarget | None:
    """Delete the last target, or the one with these numbers, ``[station] target``; return which."""
    if (
        not all(number.isdecimal() for number in arguments)
        or len(arguments) > 2
        or (len(arguments) < 2 and last is None)
    ):
        operator.say("which one? Type r, station and target, for example r 2 5")
        return None
    given = [int(number) for number in arguments]
    station, target = (*(last or ())[: 2 - len(given)], *given)
    if not collection.remove(station, target):
        operator.say(f"station {station} has not measured target {target} yet")
        return None
    _write(collection)
    operator.say(f"station {station}, target {target} is deleted; aim at it again")
    return station, target


def _write(collection: TargetCollection) -> None:
    with write_atomically(collection.path) as file:
        file.write(collection.text().encode())


def _print_progress(collection: TargetCollection, skipped: set[StationTarget], station: int) -> None:
    """Print the measurements of all stations, and the residuals of one station against station 1."""
    solved = None if station == 1 else collection.solution(station)
    residuals_mm: dict[PointName, str] = {}
    if isinstance(solved, TargetCalibration):
        frame = solved.frames[station]
        residuals_mm = {
            name: f"{1e3 * residual:.1f}"
            for name, residual in zip(frame.used, frame.residuals_m, strict=True)
        } | {bad.name: f"rejected, {1e3 * bad.prediction_error_m:.0f}" for bad in frame.rejected}

    def state(cell: StationTarget) -> str:
        return str(collection.count(*cell)) if collection.count(*cell) else "X" if cell in skipped else "-"

    rows = [
        [
            str(target),
            *(state((number, target)) for number in collection.stations),
            residuals_mm.get(target, ""),
        ]
        for target in collection.targets
    ]
    stations = [f"station {number}" for number in collection.stations]
    print_table(["target", *stations, "" if solved is None else f"residual of {station}, mm"], rows)
    if isinstance(solved, TargetCalibration):
        click.echo(f"station {station}: {_verdict(solved.frames[station])}")
        for note in target_notes(solved):
            click.echo(f"note: {note}")
    elif solved is not None:
        click.echo(f"station {station}: {solved}")


def _verdict(frame: FrameCalibration) -> str:
    parts = [f"rms {1e3 * frame.rms_m:.1f} mm"]
    if not frame.consistent:
        parts.append("the targets are inconsistent; one more target identifies the bad one")
    parts += [f"target {bad.name} is an outlier, repeat it" for bad in frame.rejected]
    if frame.weak:
        parts.append("the frame is weakly determined, add a target off the line of the others")
    return "; ".join(parts)
