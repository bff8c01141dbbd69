"""The command ``demo``: a robot and three stations to try everything on, without hardware."""

from __future__ import annotations

import asyncio
import dataclasses
import math
import shutil
import sys
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from tsgt import service
from tsgt.cli.config import problems_at_start
from tsgt.cli.model_options import model_option
from tsgt.cli.options import RECORDING_SUFFIXES, OutputFile, json_option, path_type
from tsgt.cli.output import print_json, require_new_file
from tsgt.cli.simulate.command import protocol_option
from tsgt.cli.simulate.demo_progress import Progress
from tsgt.clock import SystemClock, UnixTimeline
from tsgt.config import ScenarioConfig, SimulatedImu, check_permissions, find_problems, load
from tsgt.errors import OutputFileError, StreamError
from tsgt.estimation import point_label
from tsgt.log import configure_logging
from tsgt.service import MAX_SOCKET_PATH_BYTES
from tsgt.simulation.demo import Demo, write_demo_files
from tsgt.simulation.options import SimulationOptions

if TYPE_CHECKING:
    from tsgt.analysis.evaluation import LivePoses
    from tsgt.config import ImuModelName
    from tsgt.model import ReferencePoint
    from tsgt.simulation.demo import DemoFiles

DEFAULT_DURATION_S = 30.0

_HEADLINE = ("poses", "valid_poses", "position_rms_mm", "orientation_rms_deg", "centroid")


@dataclass(frozen=True, slots=True)
class Result:
    """Result of a demonstration."""

    poses: LivePoses  # the best that the estimator makes
    live: dict[str, LivePoses]  # by series
    restarts: int
    recording: Path | None
    reference_point: ReferencePoint


@click.command()
@protocol_option
@model_option(
    ScenarioConfig,
    "duration_s",
    "--duration",
    default=None,
    help="Duration in s from the first pose.  [default: 30, or that of --scenario]",
)
@click.option("--socket", "socket_path", type=path_type, help="UNIX socket of the pose stream.")
@click.option("--output", type=OutputFile(*RECORDING_SUFFIXES), help="Recording to write (.jsonl).")
@model_option(SimulationOptions, "seed")
@model_option(
    SimulatedImu,
    "model",
    "--imu",
    default=None,
    help="Class of the robot's IMU; with one, live poses use it.  [default: that of the scenario]",
)
@click.option("--scenario", "scenario_path", type=path_type, help="Scenario (TOML).  [default: dynamic]")
@json_option
def demo(
    *,
    protocol: Literal["superframe", "classic"],
    duration_s: float | None,
    socket_path: Path | None,
    output: Path | None,
    seed: int,
    scenario_path: Path | None,
    model: ImuModelName | None,
    as_json: bool,
) -> None:
    """Run simulated stations and a master in real time.

    Three station clients and a master run as real processes over a simulated radio channel, with a simulated robot and
    instruments; no hardware and no root are needed. Their configuration, logs, journals and recordings are kept in a
    new temporary folder. A daemon that is killed is started again. At the end the poses are compared with the truth.
    Ctrl-C ends the demonstration early, with the summary so far.
    """
    scenario = ScenarioConfig() if scenario_path is None else load(scenario_path, ScenarioConfig)
    if model is not None:
        scenario = scenario.model_copy(update={"imu": scenario.imu.model_copy(update={"model": model})})
    if duration_s is None:
        duration_s = DEFAULT_DURATION_S if scenario_path is None else scenario.duration_s
    require_new_file(output)
    folder = Path(tempfile.mkdtemp(prefix="tsgt-demo-"))
    socket_path = socket_path or folder / "poses.sock"
    if len(str(folder.absolute() / "instrument1.sock")) > MAX_SOCKET_PATH_BYTES:
        raise StreamError(f"{folder}: the path is too long for sockets; set TMPDIR to a shorter one")
    check_permissions(folder)  # otherwise the daemons fail to start, and only their logs say why
    configure_logging("warning")  # the progress shows what matters
    # Tried here, as the failure of the master would be in its log only.
    listener = service.UnixListener(socket_path.absolute(), 0o600)
    listener.socket.close()
    listener.remove()
    files = write_demo_files(folder, scenario, socket_path.absolute(), protocol)
    result = _run(scenario, files, output, duration_s=duration_s, seed=seed)
    if as_json:
        print_json(
            {
                **{name: value for name, value in result.poses.keys().items() if name in _HEADLINE},
                "reference_point": dataclasses.asdict(result.reference_point),
                "live": {series: each.keys() for series, each in result.live.items()},
                "socket": str(socket_path),
                "recording": None if result.recording is None else str(result.recording),
                "folder": str(folder),
                "restarts": result.restarts,
            }
        )
        return
    click.echo(f"poses        {result.poses.poses}, of which {result.poses.valid_poses} valid")
    errors, at = result.poses.errors, point_label(result.reference_point)
    if math.isnan(errors.position_rms_mm):
        click.echo("errors       no valid pose to compare; the first and the last 2 s are not used")
    else:
        click.echo(
            f"position     {errors.position_rms_mm:.1f} mm rms error at {at}, "
            f"{errors.centroid.position_rms_mm:.1f} mm at the centroid of the prisms"
        )
        click.echo(f"orientation  {errors.orientation_rms_deg:.2f} deg rms error")
    for series, live in result.live.items():
        keys = live.keys()
        text = f"{series:<12} " + (f"{keys['valid_fraction']:.0%} valid" if live.poses else "no poses")
        if live.valid_poses:
            age = "newest measurement" if series == "predicted" else "sent"
            text += f", {age} {keys['age_ms']['p50']:.0f} ms old (median)"
        if not math.isnan(live.errors.position_rms_mm):
            text += (
                f", rms errors {live.errors.position_rms_mm:.1f} mm at {at} and "
                f"{live.errors.orientation_rms_deg:.2f} deg"
            )
        click.echo(text)
    click.echo(f"files        {folder}: configuration, logs, journals")
    if result.recording is not None:
        click.echo(f"recording    {result.recording}")
        click.echo(f"next         {_program()} process {result.recording} --output poses.tum")
        click.echo(f"             {_program()} evaluate {result.recording}")


def _run(
    scenario: ScenarioConfig, files: DemoFiles, output: Path | None, *, duration_s: float, seed: int
) -> Result:
    """Run a demonstration to its end or to Ctrl-C."""
    clock = SystemClock()
    timeline = UnixTimeline.fixed_now(clock)

    async def run() -> tuple[Demo, Progress]:
        demo = Demo(scenario, files, duration_s=duration_s, seed=seed, clock=clock)
        _check_configurations(files)  # complete now: the IMU is added with the demonstration
        click.echo(f"poses on     {files.socket}", err=True)
        click.echo(f"try          {_program()} listen --socket {files.socket}", err=True)
        click.echo(f"             {_program()} status --socket {files.socket}", err=True)
        with (
            Progress(demo, timeline) as progress,
            suppress(asyncio.CancelledError),
        ):  # Ctrl-C: the summary so far
            await demo.run(progress.line)
        return demo, progress

    demo, progress = service.run(run)
    return Result(
        poses=progress.live_poses(progress.best),
        live={series: progress.live_poses(series) for series in sorted(progress.poses)},
        restarts=sum(max(0, process.starts - 1) for process in demo.processes),
        recording=_kept(sorted(files.recordings.glob("*.jsonl")), output),
        reference_point=demo.parameters.reference_point,
    )


def _check_configurations(files: DemoFiles) -> None:
    """Raise ConfigError if a daemon would not start: its log alone would say why, after a minute without poses."""
    for path in (files.master_config, *map(files.client_config, files.stations)):
        content, problems = find_problems(path)
        if content is not None:
            problems = problems_at_start(path, content)
        if problems:
            raise problems[0]


def _kept(recordings: list[Path], output: Path | None) -> Path | None:
    """Join the recordings of the master's sessions into the file that the user wants."""
    if not recordings:
        return None
    if output is None and len(recordings) == 1:
        return recordings[0]
    path = output or recordings[0].with_name("all.jsonl")
    try:
        with path.open("wb") as file:
            for recording in recordings:
                with recording.open("rb") as session:
                    shutil.copyfileobj(session, file)
    except OSError as error:
        raise OutputFileError(
            f"cannot be written ({error.strerror}); the recordings are in {recordings[0].parent}", path=path
        ) from error
    return path


def _program() -> str:
    """Return how the user can call us: by name if the shell finds it, else by the path that was called."""
    return "tsgt" if shutil.which("tsgt") or Path(sys.argv[0]).name != "tsgt" else sys.argv[0]
