"""The command ``rehearse``: a day in the field indoors, with the same commands as outside."""

from __future__ import annotations

import asyncio
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tsgt import service
from tsgt.cli.calibrate.operator import Terminal
from tsgt.cli.model_options import model_option
from tsgt.cli.options import FiniteRange, json_option
from tsgt.cli.output import CHECK_FAILED, print_json
from tsgt.cli.simulate.rehearsal_day import Day
from tsgt.cli.simulate.rehearsal_watch import Watch
from tsgt.clock import SystemClock, UnixTimeline
from tsgt.config import check_permissions
from tsgt.errors import StreamError
from tsgt.log import configure_logging
from tsgt.service import MAX_SOCKET_PATH_BYTES
from tsgt.simulation.options import SimulationOptions
from tsgt.simulation.rehearsal import Site

if TYPE_CHECKING:
    from collections.abc import Sequence

INCIDENTS = ("prism", "battery", "tripod")

LIMIT_MM = 30.0
"""Rms error of valid smoothed poses with good frames; 5 to 10 mm are usual."""


@click.command()
@click.option("--auto", is_flag=True, help="Play the day by a script instead of waiting for you.")
@click.option(
    "--incident",
    "incidents",
    type=click.Choice(INCIDENTS),
    multiple=True,
    help="What goes wrong; may be repeated.  [default: all]",
)
@click.option(
    "--drive", "drive_s", type=FiniteRange(1, 3600), default=30.0, help="Duration of each drive in s."
)
@model_option(SimulationOptions, "seed")
@json_option
def rehearse(*, auto: bool, incidents: Sequence[str], drive_s: float, seed: int, as_json: bool) -> int:
    """Rehearse a day in the field, indoors.

    Three stations, a robot and a master run as processes in real time, without a calibration. The rehearsal says what to
    do next and what to look at; you do it in a second terminal with the same commands as outside. A prism is lost, a
    battery ends, a tripod is moved. At the end it says what was noticed and when, and how accurate the poses were.
    Ctrl-C ends it early.

    Exit code 3: something was not noticed, the poses of a part with good frames were wrong, or it was ended before the
    first drive.
    """
    folder = Path(tempfile.mkdtemp(prefix="tsgt-rehearsal-"))
    if len(str(folder.absolute() / "instrument1.sock")) > MAX_SOCKET_PATH_BYTES:
        raise StreamError(f"{folder}: the path is too long for sockets; set TMPDIR to a shorter one")
    check_permissions(folder)  # otherwise the daemons fail to start, and only their logs say why
    configure_logging("warning")
    clock = SystemClock()
    site = Site(folder, seed=seed, clock=clock)
    watch = Watch(site, UnixTimeline.fixed_now(clock), folder / "poses.sock")
    day = Day(site, watch, folder, None if auto else Terminal(), drive_s)
    click.echo("In a second terminal, from which you work, and a third one for the page:", err=True)
    click.echo(f"    cd {folder}; export TSGT_SOCKET=$PWD/poses.sock", err=True)
    click.echo("In the third one also:", err=True)
    click.echo("    tsgt web", err=True)

    async def run() -> None:
        async with site.open():
            watching = asyncio.create_task(watch.run())
            try:
                await day.play(frozenset(incidents or INCIDENTS))
            finally:
                watching.cancel()
                await asyncio.wait([watching])

    service.run(run)
    return _debrief(day, folder, as_json=as_json)


def _debrief(day: Day, folder: Path, *, as_json: bool) -> int:
    """Print what was noticed and how accurate the poses were; return the exit code."""
    good = {name: part for name, part in day.parts.items() if not name.startswith("tripod moved")}
    ok = (
        bool(good)  # else it was ended before the first drive
        and all(each.noticed_s is not None for each in day.incidents)
        and all(part.poses and part.position_rms_mm < LIMIT_MM for part in good.values())
    )
    if as_json:
        print_json(
            {
                "ok": ok,
                "incidents": [incident.json() for incident in day.incidents],
                "parts": {name: part._asdict() for name, part in day.parts.items()},
                "events": [event.event for event in day.watch.events],
                "folder": str(folder),
            }
        )
        return 0 if ok else CHECK_FAILED
    click.echo("\n=== Debriefing")
    for incident in day.incidents:
        click.echo(incident.text())
    for name, part in day.parts.items():
        click.echo(f"{name}: {part.text()}")
    recordings = sorted((folder / "recordings").glob("*.jsonl"), key=lambda path: path.stat().st_size)
    if not recordings:  # ended before the master started
        click.echo(f"files: {folder}, without a recording")
    else:
        click.echo(
            f"files: {folder}, with a recording for each start of the master; next, for the longest one:"
        )
        click.echo(f"    tsgt evaluate {recordings[-1]}")
    return 0 if ok else CHECK_FAILED
