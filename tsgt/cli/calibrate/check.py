"""The command ``tsgt calibrate check``: measure targets again to detect a moved tripod."""

from __future__ import annotations

import asyncio
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import click

from tsgt.analysis.calibration import check_repeats, check_station, same_face_points
from tsgt.analysis.formats import read_partial_target_file
from tsgt.cli.calibrate.operator import Terminal
from tsgt.cli.calibrate.session import target_session
from tsgt.cli.options import (
    FiniteRange,
    constant_m,
    constant_option,
    json_option,
    master_config_option,
    path_type,
)
from tsgt.cli.output import CHECK_FAILED, print_json
from tsgt.clock import SystemClock
from tsgt.config import MasterConfig, load
from tsgt.errors import InputFileError, OutputFileError, TsgtError
from tsgt.recording import write_target_checks

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from tsgt.analysis.calibration import StationCheck, StationTarget
    from tsgt.analysis.formats import TargetFile, TargetMeasurement
    from tsgt.cli.calibrate.operator import Operator
    from tsgt.cli.calibrate.session import TargetSession


@click.command()
@master_config_option
@click.option(
    "--targets", "targets_file", type=path_type, required=True, help="File of the targets as measured before."
)
@click.option(
    "--station",
    "stations",
    type=int,
    multiple=True,
    help="Station to check; may be repeated.  [default: all]",
)
@click.option(
    "--target",
    "targets",
    type=int,
    multiple=True,
    help="Target to measure; may be repeated. One target shows that a tripod has moved, two show how.  [default: all]",
)
@constant_option(
    "--target-constant-mm",
    "Constant added to the distances of targets, required if a line of the file has no constant_mm.",
)
@click.option(
    "--limit-mm",
    type=FiniteRange(min=0),
    default=0.0,
    help="Tolerated movement; movement within the noise is always tolerated.",
)
@json_option
def check(
    *,
    config_path: Path,
    targets_file: Path,
    stations: tuple[int, ...],
    targets: tuple[int, ...],
    target_constant_mm: float | None,
    limit_mm: float,
    as_json: bool,
) -> int:
    """Measure targets again to detect a moved tripod.

    Stop tsgt-master first, which owns the radio. Exit code 3: a station has moved, or the targets are inconsistent.
    """
    config = load(config_path, MasterConfig)
    file = read_partial_target_file(targets_file)
    cells = _cells(config, file, stations, targets)
    before = file.measurements
    constant = constant_m(
        "--target-constant-mm",
        target_constant_mm,
        (sight for station, target in cells for sight in before[station][target]),
        targets_file,
    )

    for station in dict(cells):
        checked = {target: before[station][target] for owner, target in cells if owner == station}
        check_repeats(targets_file, checked, constant, f"target {{}} of station {station}")

    async def run() -> dict[int, dict[int, list[TargetMeasurement]]]:
        operator = Terminal()
        async with target_session(config, config_path, SystemClock(), operator.say) as session:
            return await measure_again(cells, before, session, operator, constant_m=constant)

    measured = asyncio.run(run())
    if not measured:
        raise TsgtError("no target was measured, so nothing was checked")
    results = {}
    for station, sights in measured.items():
        what = f"target {{}} of station {station}"
        then, now = same_face_points(targets_file, before[station], sights, constant, what)
        results[station] = check_station(then, now, limit_m=limit_mm / 1e3)
    try:
        write_target_checks(
            config.recording.directory,
            {station: each.ok for station, each in results.items()},
            time.time_ns(),
        )
    except OutputFileError as error:
        click.echo(f"warning: the master will not know of this check: {error}", err=True)
    return print_check(results, as_json=as_json)


def _cells(
    config: MasterConfig, file: TargetFile, stations: Sequence[int], targets: Sequence[int]
) -> list[StationTarget]:
    """Return the stations and targets to measure; each must have been measured before."""
    configured = {station.station for station in config.stations}
    for station in stations:
        if station not in configured:
            raise click.UsageError(f"the configuration has no station {station}")
    cells = [
        (station, target)
        for station, seen in file.measurements.items()
        if station in (stations or configured)
        for target in seen
        if not targets or target in targets
    ]
    for station in stations:
        if station not in {cell[0] for cell in cells}:
            raise InputFileError(f"holds none of these targets for station {station}", path=file.path)
    for target in targets:
        if target not in {cell[1] for cell in cells}:
            raise InputFileError(f"holds no target {target} for these stations", path=file.path)
    if not cells:
        raise InputFileError("holds no target of a station in the configuration", path=file.path)
    return cells


async def measure_again(
    cells: Sequence[StationTarget],
    before: Mapping[int, Mapping[int, Sequence[TargetMeasurement]]],
    session: TargetSession,
    operator: Operator,
    *,
    constant_m: float,
) -> dict[int, dict[int, list[TargetMeasurement]]]:
    """Measure targets once more, one after the other, until the operator quits.

    Parameters
    ----------
    cells
        Stations and targets.
    before
        Measurements before, by station and target; each target keeps its constant, and is measured in the same face.
    constant_m
        Constant of targets without their own, in m.

    Returns
    -------
    dict
        Measurements by station and target.
    """
    measured: dict[int, dict[int, list[TargetMeasurement]]] = {}
    for station, target in cells:
        own_m = before[station][target][0].constant_m
        while target not in measured.get(station, {}):
            reply = await operator.ask(
                f"station {station}, target {target}: aim. Enter measures, s skips, q quits"
            )
            if reply is None or reply == "q":
                return measured
            if reply == "s":
                break
            if reply:
                operator.say(f"unknown key {reply!r}")
                continue
            sight = await session.try_measure(operator, station, constant_m if own_m is None else own_m)
            if sight is None:
                continue
            if sight.face not in {each.face for each in before[station][target]}:
                operator.say(
                    f"target {target} of station {station} was measured in face {3 - sight.face} only: "
                    "turn the instrument to this face, whose index error and collimation are the same, and aim again"
                )
            else:
                # Distances that were not corrected for the air then, as in files of earlier versions, are compared uncorrected.
                if not before[station][target][0].atmospheric_ppm:
                    sight = replace(sight, atmospheric_ppm=0.0)
                measured.setdefault(station, {})[target] = [sight]
    return measured


def print_check(results: Mapping[int, StationCheck], *, as_json: bool) -> int:
    """Print the result of each station and return the exit code."""
    if as_json:
        print_json({"stations": {station: _check_json(result) for station, result in results.items()}})
    else:
        for station, result in results.items():
            click.echo(f"station {station}: {_check_text(result)}")
    ok = all(result.ok and result.consistent for result in results.values())
    return 0 if ok else CHECK_FAILED


def _check_json(result: StationCheck) -> dict[str, object]:
    return {
        "moved_mm": 1e3 * result.moved_m,
        "moved_sigma_mm": 1e3 * result.moved_sigma_m,
        "moved_mrad": None if result.turned_rad is None else 1e3 * result.turned_rad,
        "ok": result.ok,
        "consistent": result.consistent,
        "shifts_mm": {target: 1e3 * shift for target, shift in result.shifts_m.items()},
    }


def _check_text(result: StationCheck) -> str:
    shifts = ", ".join(f"{target}: {1e3 * shift:.1f}" for target, shift in result.shifts_m.items())
    parts = [f"{'unmoved' if result.ok else 'HAS MOVED'}; apparent shifts of the targets (mm) {shifts}"]
    if result.turned_rad is None:
        parts.append(
            "these targets do not distinguish translation from rotation; measure two or more, far apart"
        )
    else:
        rotation = f"{'heading ' if result.levelled else ''}rotated by {1e3 * result.turned_rad:.2f} mrad"
        parts.append(
            f"moved by {1e3 * result.moved_m:.1f} mm (one sigma {1e3 * result.moved_sigma_m:.1f}), {rotation}"
        )
    if not result.consistent:
        parts.append(
            "no single movement explains these shifts: a target has moved or was confused with another"
        )
    if not result.ok:
        parts.append("measure its targets again and solve the frames again")
    return "; ".join(parts)
