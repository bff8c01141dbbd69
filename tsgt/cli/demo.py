"""The command ``demo``: a robot and three stations to try everything on, without any hardware."""

from __future__ import annotations

import asyncio
import math
import shutil
import sys
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tsgt import service
from tsgt.analysis.metrics import inner_part
from tsgt.cli.demo_progress import Progress
from tsgt.cli.options import finite, json_option
from tsgt.cli.output import print_json, require_new_file
from tsgt.clock import SystemClock, UnixTimeline
from tsgt.config import ScenarioConfig, load
from tsgt.config.trust import check_trust
from tsgt.errors import OutputFileError, StreamError
from tsgt.log import configure_logging
from tsgt.service import MAX_SOCKET_PATH_BYTES
from tsgt.simulation.demo import Demo
from tsgt.simulation.demo_files import write_demo_files

if TYPE_CHECKING:
    from tsgt.analysis.metrics import PoseErrors
    from tsgt.master.stream_records import Kind
    from tsgt.simulation.demo_files import DemoFiles

DEFAULT_DURATION_S = 30.0


@dataclass(frozen=True, slots=True)
class PosesResult:
    """What the poses of one kind have come to."""

    count: int
    valid: int
    errors: PoseErrors

    def keys(self) -> dict[str, Any]:
        """Return it for machines."""
        return {
            "poses": self.count,
            "valid_poses": self.valid,
            "position_rms_mm": self.errors.position_rms_mm,
            "orientation_rms_deg": self.errors.orientation_rms_deg,
        }


@dataclass(frozen=True, slots=True)
class Result:
    """What a demonstration has come to; `live` only where poses are predicted and smoothed."""

    poses: PosesResult
    live: PosesResult | None
    restarts: int
    recording: Path | None


@click.command()
@click.option(
    "--protocol",
    type=click.Choice(["superframe", "classic"]),
    default="superframe",
    show_default=True,
    help="What master and stations speak.",
)
@click.option(
    "--duration",
    "duration_s",
    type=click.FloatRange(min=0, max=86_400, min_open=True),
    callback=finite,
    help="How many seconds it runs from the first pose on.  [default: 30, or what --scenario says]",
)
@click.option("--socket", "socket_path", type=click.Path(path_type=Path), help="Socket for the poses.")
@click.option("--output", type=click.Path(path_type=Path), help="Recording to write.")
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Another seed, another drive."
)
@click.option("--scenario", "scenario_path", type=click.Path(path_type=Path), help="Another scenario (TOML).")
@json_option
def demo(
    protocol: Any,
    duration_s: float | None,
    socket_path: Path | None,
    output: Path | None,
    seed: int,
    scenario_path: Path | None,
    as_json: bool,  # noqa: FBT001 (click passes options by name)
) -> None:
    """Run three station clients and a master, with robot, instruments and radios simulated.

    The daemons are real processes that talk over a simulated radio channel; their configuration, logs, journals and
    recordings lie in a new folder for temporary files and stay there. Needs no hardware and no root. A daemon that
    is killed is started again. At the end the poses are compared with the truth. Ctrl-C ends it early, with the
    summary so far.
    """
    scenario = ScenarioConfig() if scenario_path is None else load(scenario_path, ScenarioConfig)
    if duration_s is None:
        duration_s = DEFAULT_DURATION_S if scenario_path is None else scenario.duration_s
    require_new_file(output)
    folder = Path(tempfile.mkdtemp(prefix="tsgt-demo-"))
    socket_path = socket_path or folder / "poses.sock"
    if len(str(folder.absolute() / "instrument1.sock")) > MAX_SOCKET_PATH_BYTES:
        raise StreamError(f"{folder}: the path is too long for sockets; set TMPDIR to a shorter one")
    check_trust(folder)  # the daemons would not start, and say so in their logs only
    configure_logging("warning")  # what is worth telling stands in the progress
    # Tried here: that the master cannot open it would only stand in the master's log.
    listener = service.UnixListener(socket_path.absolute(), 0o600)
    listener.socket.close()
    listener.remove()
    files = write_demo_files(folder, scenario, socket_path.absolute(), protocol)
    result = _run(scenario, files, output, duration_s=duration_s, seed=seed)
    if as_json:
        print_json(
            {
                **result.poses.keys(),
                **({} if result.live is None else {"live": result.live.keys()}),
                "socket": str(socket_path),
                "recording": None if result.recording is None else str(result.recording),
                "folder": str(folder),
                "restarts": result.restarts,
            }
        )
        return
    click.echo(f"poses        {result.poses.count}, of which {result.poses.valid} valid")
    errors = result.poses.errors
    if math.isnan(errors.position_rms_mm):
        click.echo("against the truth: no valid pose to compare; the first and the last 2 s do not count")
    else:
        click.echo(
            f"position     {errors.position_rms_mm:.1f} mm rms off the truth, at the centroid of the prisms"
        )
        click.echo(f"orientation  {errors.orientation_rms_deg:.2f} deg rms off the truth")
    if result.live is not None:
        click.echo(
            f"live         {result.live.valid} of {result.live.count} predictions valid, "
            f"{result.live.errors.position_rms_mm:.1f} mm and {result.live.errors.orientation_rms_deg:.2f} deg rms off"
        )
    click.echo(f"everything   {folder}: configuration, logs, journals")
    if result.recording is not None:
        click.echo(f"recording    {result.recording}")
        click.echo(f"go on with   {_program()} process {result.recording} --output poses.tum")
        click.echo(f"             {_program()} evaluate {result.recording}")


def _run(
    scenario: ScenarioConfig,
    files: DemoFiles,
    output: Path | None,
    *,
    duration_s: float,
    seed: int,
) -> Result:
    """Run a demonstration to its end or to Ctrl-C."""
    clock = SystemClock()
    timeline = UnixTimeline.fixed_now(clock)
    click.echo(f"poses on     {files.socket}", err=True)
    click.echo(f"try          {_program()} listen --socket {files.socket}", err=True)
    click.echo(f"             {_program()} status --socket {files.socket}", err=True)

    async def run() -> tuple[Demo, Progress]:
        demo = Demo(scenario, files, duration_s=duration_s, seed=seed, clock=clock)
        progress = Progress(demo, timeline)
        with suppress(asyncio.CancelledError):  # Ctrl-C: the summary so far
            await demo.run(progress.line)
        return demo, progress

    demo, progress = service.run(run)
    return Result(
        poses=_poses(progress, progress.kind),
        live=_poses(progress, "predicted") if progress.poses["predicted"] else None,
        restarts=sum(max(0, process.starts - 1) for process in demo.processes),
        recording=_kept(sorted(files.recordings.glob("*.jsonl")), output),
    )


def _poses(progress: Progress, kind: Kind) -> PosesResult:
    stamps_ns = progress.valid_stamps_ns(kind)
    counts = inner_part(stamps_ns, progress.first_ns, progress.last_ns)
    return PosesResult(progress.poses[kind], len(stamps_ns), progress.errors(kind, counts))


def _kept(recordings: list[Path], output: Path | None) -> Path | None:
    """Put what the master recorded where the user wants it: one session after the other."""
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
    """How the user can call us: by name where the shell finds it, else by the path that was called."""
    return "tsgt" if shutil.which("tsgt") or Path(sys.argv[0]).name != "tsgt" else sys.argv[0]
