"""The command ``demo``: a robot and three stations to try everything on, without any hardware."""

from __future__ import annotations

import asyncio
import math
import shutil
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

import tsgt
from tsgt import service
from tsgt.analysis.metrics import PoseErrors, inner_part, pose_errors
from tsgt.cli.options import finite, json_option
from tsgt.cli.output import print_json
from tsgt.clock import SystemClock, UnixTimeline
from tsgt.config import ScenarioConfig, load
from tsgt.geometry import rotation_from_quaternion, transform_from
from tsgt.log import configure_logging
from tsgt.master.recorder import Recorder
from tsgt.master.stream import StreamServer
from tsgt.master.stream_records import HelloRecord
from tsgt.recording import RecordingHeader, RecordingWriter, encode_line
from tsgt.simulation.demo import live, play

if TYPE_CHECKING:
    from tsgt.clock import Clock
    from tsgt.master.stream_records import PoseRecord
    from tsgt.simulation.demo import Run, Step

DEFAULT_DURATION_S = 30.0
SECONDS_PER_LINE = 5


@dataclass(frozen=True, slots=True)
class Result:
    """What a demonstration has come to."""

    poses: int
    valid_poses: int
    errors: PoseErrors


@click.command()
@click.option(
    "--duration",
    "duration_s",
    type=click.FloatRange(min=0, max=86_400, min_open=True),
    callback=finite,
    help="How many seconds it runs.  [default: 30, or what --scenario says]",
)
@click.option("--socket", "socket_path", type=click.Path(path_type=Path), help="Socket for the poses.")
@click.option("--output", type=click.Path(path_type=Path), help="Recording to write.")
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Another seed, another drive."
)
@click.option("--scenario", "scenario_path", type=click.Path(path_type=Path), help="Another scenario (TOML).")
@json_option
def demo(
    duration_s: float | None,
    socket_path: Path | None,
    output: Path | None,
    seed: int,
    scenario_path: Path | None,
    as_json: bool,  # noqa: FBT001 (click passes options by name)
) -> None:
    """Simulate a driving robot and three stations, live, and compare the poses with the truth.

    Needs no hardware and no root. Unless told otherwise, socket and recording are put into a new folder for
    temporary files; the recording stays there. Ctrl-C ends it early, with the summary so far.
    """
    scenario = ScenarioConfig() if scenario_path is None else load(scenario_path, ScenarioConfig)
    if duration_s is None:
        duration_s = DEFAULT_DURATION_S if scenario_path is None else scenario.duration_s
    if output is not None and output.exists():
        raise click.UsageError(f"{output} exists; a demo makes a recording of its own, choose another file")
    if socket_path is None or output is None:
        folder = Path(tempfile.mkdtemp(prefix="tsgt-demo-"))
        socket_path, output = socket_path or folder / "poses.sock", output or folder / "demo.jsonl"
    configure_logging("warning")  # what is worth telling stands in the progress
    clock = SystemClock()
    result = service.run(
        lambda: run_demo(
            scenario, clock, duration_s=duration_s, seed=seed, socket_path=socket_path, output=output
        )
    )
    position_rms_mm, orientation_rms_deg = result.errors.position_rms_mm, result.errors.orientation_rms_deg
    if as_json:
        print_json(
            {
                "poses": result.poses,
                "valid_poses": result.valid_poses,
                "socket": str(socket_path),
                "recording": str(output),
                "position_rms_mm": position_rms_mm,
                "orientation_rms_deg": orientation_rms_deg,
            }
        )
        return
    click.echo(f"poses        {result.poses}, of which {result.valid_poses} valid")
    if math.isnan(position_rms_mm):
        click.echo("against the truth: no valid pose to compare; the first and the last 2 s do not count")
    else:
        click.echo(f"position     {position_rms_mm:.1f} mm rms off the truth, at the centroid of the prisms")
        click.echo(f"orientation  {orientation_rms_deg:.2f} deg rms off the truth")
    click.echo(f"recording    {output}")
    click.echo(f"go on with   {_program()} process {output} --estimator linear --output poses.tum")
    click.echo(f"             {_program()} evaluate {output}")


async def run_demo(
    scenario: ScenarioConfig, clock: Clock, *, duration_s: float, seed: int, socket_path: Path, output: Path
) -> Result:
    """Run a scenario live: lines to the socket and the recording, progress to stderr.

    Raises
    ------
    StreamError
        The socket cannot be opened.
    RecordingError
        The recording cannot be written.
    """
    timeline = UnixTimeline.fixed_now(clock)

    def unix_now_ns() -> int:
        return timeline.unix_ns(clock.monotonic_ns())

    hello = encode_line(HelloRecord())
    async with StreamServer(socket_path, hello, unix_now_ns=unix_now_ns) as server:
        with RecordingWriter(output) as writer:
            click.echo(f"poses on     {socket_path}", err=True)
            click.echo(f"try          {_program()} listen --socket {socket_path}", err=True)
            run = play(scenario, duration_s=duration_s, seed=seed, start_ns=unix_now_ns())
            header = RecordingHeader(
                software=f"tsgt {tsgt.__version__}",
                created_ns=run.start_ns,
                source=f"demo: scenario {scenario.name}, seed {seed}",
            )
            writer.write(header)
            writer.write(run.parameters)
            recorder, progress = Recorder(writer), Progress(run)
            try:
                async with asyncio.TaskGroup() as group:
                    syncing = group.create_task(service.keep_synced(writer.sync, clock))
                    async for step in live(run, clock, timeline):
                        for line in map(encode_line, step.records):
                            recorder.write_line(line)
                            server.publish(line)
                        progress.show(step, readers=server.readers)
                    syncing.cancel()
            finally:
                recorder.close()
    return progress.result()


def _program() -> str:
    """How the user can call us: by name where the shell finds it, else by the path that was called."""
    return "tsgt" if shutil.which("tsgt") or Path(sys.argv[0]).name != "tsgt" else sys.argv[0]


class Progress:
    """Keeps the poses of a run, tells on stderr how it goes, and how good they were in the end."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._poses = 0
        self._valid: list[PoseRecord] = []
        self._now_ns = run.start_ns
        self._updates = 0

    def show(self, step: Step, *, readers: int) -> None:
        """Take a step; once in a second (on a terminal, else every few seconds) tell how it goes."""
        self._now_ns = step.now_ns
        self._poses += len(step.poses)
        self._valid += [pose for pose in step.poses if pose.valid]
        if step.status is None:
            return
        self._updates += 1
        if not sys.stderr.isatty() and self._updates % SECONDS_PER_LINE:
            return
        elapsed_s = (step.now_ns - self._run.start_ns) / 1e9
        # Fits into 80 columns, or a terminal would not write it over.
        text = f"{elapsed_s:5.0f} s  {len(self._valid)}/{self._poses} poses valid"
        if self._valid:
            position = " ".join(f"{value:6.2f}" for value in self._valid[-1].position_m or ())
            off_mm = self._errors(self._valid).position_rms_mm
            text += f"  at {position} m  off {off_mm:.1f} mm rms"
        text += f"  {readers} readers"
        # On a terminal one line is written over again and again, until the run has ended.
        click.echo(f"\r{text}\x1b[K" if sys.stderr.isatty() else text, err=True, nl=not sys.stderr.isatty())

    def result(self) -> Result:
        """Compare what counts with the truth, after the last step."""
        if sys.stderr.isatty():
            click.echo(err=True)
        stamps_ns = np.array([pose.stamp_ns for pose in self._valid], dtype=np.int64)
        counts = inner_part(stamps_ns, self._run.start_ns, self._now_ns)
        inner = [pose for pose, counted in zip(self._valid, counts, strict=True) if counted]
        return Result(poses=self._poses, valid_poses=len(self._valid), errors=self._errors(inner))

    def _errors(self, poses: list[PoseRecord]) -> PoseErrors:
        stamps_ns = np.array([pose.stamp_ns for pose in poses], dtype=np.int64)
        positions = np.array([pose.position_m for pose in poses], dtype=np.float64).reshape(-1, 3)
        quaternions = np.array([pose.orientation_xyzw for pose in poses], dtype=np.float64).reshape(-1, 4)
        world = self._run.world
        return pose_errors(
            transform_from(rotation_from_quaternion(quaternions), positions),
            world.pose_at((stamps_ns - self._run.start_ns) / 1e9),
            world.prisms_m.mean(axis=0),
        )
