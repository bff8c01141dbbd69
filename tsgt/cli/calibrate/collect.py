"""The command ``tsgt calibrate collect``: an operator aims, the stations measure over the radio."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import click

from tsgt.analysis.calibration import TargetCollection
from tsgt.cli.calibrate.session import shot, target_session
from tsgt.cli.operator import Terminal
from tsgt.cli.options import constant_type, finite, master_config_option, path_type
from tsgt.cli.output import print_table
from tsgt.clock import SystemClock
from tsgt.config import MasterConfig, load
from tsgt.geometry.calibration import FrameCalibration
from tsgt.recording import write_atomically

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tsgt.analysis.calibration import Cell
    from tsgt.cli.calibrate.session import TargetSession
    from tsgt.cli.operator import Operator
    from tsgt.geometry.calibration import Name

KEYS = "Enter measures, s skips, r redoes the last one (r 3: target 3, r 2 3: of station 2), q quits"


@click.command()
@master_config_option
@click.option(
    "--output",
    type=path_type,
    required=True,
    help="File of targets; if it is there, collecting goes on with it.",
)
@click.option(
    "--targets",
    "count",
    type=click.IntRange(min=3),
    default=6,
    show_default=True,
    help="How many targets there are, numbered from 1.",
)
@click.option(
    "--repeats",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="How often each station measures each target: 2 for both faces.",
)
@click.option(
    "--target-constant-mm",
    type=constant_type,
    callback=finite,
    default=0.0,
    show_default=True,
    help="Added to each measured distance; goes into the file.",
)
def collect(*, config_path: Path, output: Path, count: int, repeats: int, target_constant_mm: float) -> None:
    """Measure targets with all stations over the radio, guided step by step.

    Stop tsgt-master first, which owns the radio. Someone aims each instrument by hand; Enter has it measure. The file
    holds every measurement as soon as it is made: after Ctrl-C or q the same command goes on where it stopped.
    """
    config = load(config_path, MasterConfig)
    stations = sorted(station.station for station in config.stations)
    collection = TargetCollection(output, stations, range(1, count + 1), repeats=repeats)
    collection.resume()
    _write(collection)  # before anybody aims: the folder may not be there

    async def run() -> None:
        operator = Terminal()
        async with target_session(config, config_path, SystemClock(), operator.say) as session:
            await collect_targets(collection, session, operator, constant_m=target_constant_mm / 1e3)

    asyncio.run(run())
    missing = len(list(collection.missing()))
    if missing:
        click.echo(
            f"{output}: {missing} measurements are missing; the same command goes on with them", err=True
        )
    else:
        click.echo(f"{output}: complete. Next: tsgt calibrate targets {output}", err=True)


async def collect_targets(
    collection: TargetCollection, session: TargetSession, operator: Operator, *, constant_m: float
) -> None:
    """Guide the operator until everything is measured or skipped, or they quit.

    Parameters
    ----------
    collection
        What there is already; its file is written after each change.
    session
        The stations.
    operator
        Who aims.
    constant_m
        Of the targets, in m.
    """
    skipped: set[Cell] = set()
    last: Cell | None = None
    while True:
        cell = collection.next(skipped)
        if cell is None:
            question = "nothing is left to be measured. Enter ends, r redoes as above"
        else:
            question = f"station {cell[0]}, target {cell[1]}: aim. {KEYS}"
        answer = await operator.ask(question)
        key, *numbers = (answer or "").split() or [""]
        if answer is None or key == "q" or (cell is None and key == ""):
            return
        if key == "r":
            _redo(collection, operator, numbers, last)
        elif cell is None or numbers or key not in ("", "s"):
            operator.say(f"{answer!r} is none of the keys")
        elif key == "s":
            skipped.add(cell)
        elif (sight := await shot(session, operator, cell[0], constant_m)) is not None:
            collection.add(*cell, sight)
            _write(collection)
            last = cell
            operator.say(f"good: {sight.slope_distance_m:.4f} m")
            _print_progress(collection, skipped, cell[0])


def _redo(
    collection: TargetCollection, operator: Operator, numbers: Sequence[str], last: Cell | None
) -> None:
    """Forget the last target, or the one with these numbers: ``[station] target``."""
    if (
        not all(number.isdecimal() for number in numbers)
        or len(numbers) > 2
        or (len(numbers) < 2 and last is None)
    ):
        operator.say("which one? Type r, station and target, for example r 2 5")
        return
    given = [int(number) for number in numbers]
    station, target = (*(last or ())[: 2 - len(given)], *given)
    if not collection.drop(station, target):
        operator.say(f"station {station} has not measured target {target} yet")
        return
    _write(collection)
    operator.say(f"station {station}, target {target} is forgotten; aim at it again")


def _write(collection: TargetCollection) -> None:
    with write_atomically(collection.path) as file:
        file.write(collection.text().encode())


def _print_progress(collection: TargetCollection, skipped: set[Cell], station: int) -> None:
    """Print which station has measured what, and how well the present one fits station 1."""
    solved = None if station == 1 else collection.residuals(station)
    residuals_mm: dict[Name, str] = {}
    if isinstance(solved, FrameCalibration):
        residuals_mm = {
            name: f"{1e3 * miss:.1f}" for name, miss in zip(solved.used, solved.residuals_m, strict=True)
        } | {bad.name: f"rejected, {1e3 * bad.miss_m:.0f}" for bad in solved.rejected}

    def state(cell: Cell) -> str:
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
    if solved is not None:
        click.echo(f"station {station}: {solved if isinstance(solved, str) else _verdict(solved)}")


def _verdict(solved: FrameCalibration) -> str:
    words = [f"rms {1e3 * solved.rms_m:.1f} mm"]
    if not solved.consistent:
        words.append("the targets contradict each other, one more shows which is wrong")
    words += [f"target {bad.name} contradicts the others, redo it" for bad in solved.rejected]
    if solved.weak:
        words.append("the frame is weak, add a target off the line of the others")
    return "; ".join(words)
