"""The command ``tsgt calibrate check``: targets measured again tell whether a tripod has moved."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import click

from tsgt.analysis.calibration import check_station, mean_points
from tsgt.analysis.formats import read_some_targets
from tsgt.cli.calibrate.session import shot, target_session
from tsgt.cli.operator import Terminal
from tsgt.cli.options import constant_type, finite, json_option, master_config_option, path_type
from tsgt.cli.output import CHECK_FAILED, print_json
from tsgt.clock import SystemClock
from tsgt.config import MasterConfig, load
from tsgt.errors import InputFileError, TsgtError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from tsgt.analysis.calibration import Cell, StationCheck
    from tsgt.analysis.formats import Sight
    from tsgt.cli.calibrate.session import TargetSession
    from tsgt.cli.operator import Operator


@click.command()
@master_config_option
@click.option("--targets-file", type=path_type, required=True, help="The targets as they were measured.")
@click.option("--station", "stations", type=int, multiple=True, help="Only this one; may be repeated.")
@click.option(
    "--target",
    "targets",
    type=int,
    multiple=True,
    help="Only this one; may be repeated. Two tell how, one whether.",
)
@click.option(
    "--target-constant-mm",
    type=constant_type,
    callback=finite,
    default=0.0,
    show_default=True,
    help="Added to each measured distance of a target whose line in the file has no constant_mm.",
)
@click.option(
    "--limit-mm",
    type=click.FloatRange(min=0),
    callback=finite,
    default=0.0,
    show_default=True,
    help="Tolerate targets that seem to have moved by up to this; what is no more than noise is always tolerated.",
)
@json_option
def check(
    *,
    config_path: Path,
    targets_file: Path,
    stations: tuple[int, ...],
    targets: tuple[int, ...],
    target_constant_mm: float,
    limit_mm: float,
    as_json: bool,
) -> int:
    """Measure targets again, to see whether a tripod has moved.

    Stop tsgt-master first, which owns the radio. Exit code 3: a station has moved, or targets contradict each other.
    """
    config = load(config_path, MasterConfig)
    cells = _to_check(config, targets_file, stations, targets)
    before = read_some_targets(targets_file).sights
    constant_m = target_constant_mm / 1e3

    async def run() -> dict[int, dict[int, list[Sight]]]:
        operator = Terminal()
        async with target_session(config, config_path, SystemClock(), operator.say) as session:
            return await measure_again(cells, before, session, operator, constant_m=constant_m)

    measured = asyncio.run(run())
    if not measured:
        raise TsgtError("nothing was measured, so nothing can be said")
    results = {}
    for station, sights in measured.items():
        what = f"target {{}} of station {station}"
        then = mean_points(targets_file, before[station], constant_m, what)
        now = mean_points(targets_file, sights, constant_m, what)
        results[station] = check_station(then, now, limit_m=limit_mm / 1e3)
    return print_check(results, as_json=as_json)


def _to_check(
    config: MasterConfig, path: Path, stations: Sequence[int], targets: Sequence[int]
) -> list[Cell]:
    """Return what to measure again; refuse what was not measured before."""
    before = read_some_targets(path).sights
    configured = {station.station for station in config.stations}
    for station in stations:
        if station not in configured:
            raise click.UsageError(f"the configuration has no station {station}.")
    cells = [
        (station, target)
        for station, seen in before.items()
        if station in (stations or configured)
        for target in seen
        if not targets or target in targets
    ]
    for station in stations:
        if station not in {cell[0] for cell in cells}:
            raise InputFileError(f"holds none of these targets for station {station}", path=path)
    for target in targets:
        if target not in {cell[1] for cell in cells}:
            raise InputFileError(f"holds no target {target} for these stations", path=path)
    if not cells:
        raise InputFileError("holds no target of a station in the configuration", path=path)
    return cells


async def measure_again(
    cells: Sequence[Cell],
    before: Mapping[int, Mapping[int, Sequence[Sight]]],
    session: TargetSession,
    operator: Operator,
    *,
    constant_m: float,
) -> dict[int, dict[int, list[Sight]]]:
    """Have targets measured once more, one after the other.

    Parameters
    ----------
    cells
        Which, by station.
    before
        What was measured then; the constant of a target is taken from there.
    session
        The stations.
    operator
        Who aims; may skip targets, or quit early.
    constant_m
        Of targets without a constant of their own, in m.

    Returns
    -------
    dict
        By station and target.
    """
    measured: dict[int, dict[int, list[Sight]]] = {}
    for station, target in cells:
        own_m = before[station][target][0].constant_m
        while target not in measured.get(station, {}):
            answer = await operator.ask(
                f"station {station}, target {target}: aim. Enter measures, s skips, q quits"
            )
            if answer is None or answer == "q":
                return measured
            if answer == "s":
                break
            if answer:
                operator.say(f"{answer!r} is none of the keys")
                continue
            sight = await shot(session, operator, station, constant_m if own_m is None else own_m)
            if sight is not None:
                measured.setdefault(station, {})[target] = [sight]
    return measured


def print_check(results: Mapping[int, StationCheck], *, as_json: bool) -> int:
    """Print what became of each station; return the exit code."""
    if as_json:
        print_json({"stations": {station: _check_json(result) for station, result in results.items()}})
    else:
        for station, result in results.items():
            click.echo(f"station {station}: {_check_words(result)}")
    sound = all(result.ok and result.consistent for result in results.values())
    return 0 if sound else CHECK_FAILED


def _check_json(result: StationCheck) -> dict[str, object]:
    return {
        "moved_mm": 1e3 * result.moved_m,
        "moved_sigma_mm": 1e3 * result.moved_sigma_m,
        "moved_mrad": None if result.turned_rad is None else 1e3 * result.turned_rad,
        "ok": result.ok,
        "consistent": result.consistent,
        "shifts_mm": {target: 1e3 * shift for target, shift in result.shifts_m.items()},
    }


def _check_words(result: StationCheck) -> str:
    shifts = ", ".join(f"{target}: {1e3 * shift:.1f}" for target, shift in result.shifts_m.items())
    words = [f"{'stands' if result.ok else 'HAS MOVED'}; targets seem shifted by (mm) {shifts}"]
    if result.turned_rad is None:
        words.append(
            "whether it moved or turned cannot be told from these targets; measure two or more, far apart"
        )
    else:
        turned = f"{'heading ' if result.levelled else ''}turned by {1e3 * result.turned_rad:.2f} mrad"
        words.append(
            f"moved by {1e3 * result.moved_m:.1f} mm (one sigma {1e3 * result.moved_sigma_m:.1f}), {turned}"
        )
    if not result.consistent:
        words.append("no single movement explains these shifts: a target has moved, or was taken for another")
    if not result.ok:
        words.append("measure its targets anew and solve the frames again")
    return "; ".join(words)
