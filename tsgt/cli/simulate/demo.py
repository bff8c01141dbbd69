"""The command ``demo``: a robot and three stations to try everything on, without any hardware.

How a demonstration goes, on stderr: poses, what they are off the truth, and how each station does.
"""

from __future__ import annotations

import asyncio
import math
import shutil
import sys
import tempfile
import time
from array import array
from collections import Counter, defaultdict
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tsgt import service
from tsgt.analysis.evaluation import PoseErrors, inner_part, pose_errors
from tsgt.cli.options import finite, json_option
from tsgt.cli.output import print_json, require_new_file
from tsgt.cli.status import station_word
from tsgt.clock import SystemClock, UnixTimeline
from tsgt.config import ScenarioConfig, check_trust, load
from tsgt.errors import OutputFileError, StreamError
from tsgt.geometry import rotation_from_quaternion, transform_from
from tsgt.log import configure_logging
from tsgt.recording import EventRecord, PoseRecord, StatusRecord, decode
from tsgt.service import MAX_SOCKET_PATH_BYTES
from tsgt.simulation.demo import Demo, write_demo_files

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.recording import Kind
    from tsgt.simulation.demo import DemoFiles

LINE_INTERVAL_S = 5.0
"""How often there is a line where the output is no terminal."""


_COMPARED_AT_ONCE = 100
"""A day brings 3.5 million poses, so each is compared once, and only its stamp and its errors are kept."""


@dataclass(slots=True)
class _Valid:
    """Valid poses of one kind: the newest, those to be compared with the truth, and what the others have come to."""

    newest: PoseRecord | None = None
    waiting: list[PoseRecord] = field(default_factory=list)
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    position_m: array[float] = field(default_factory=lambda: array("d"))
    rotation_rad: array[float] = field(default_factory=lambda: array("d"))


class Progress:
    """Compares the poses of a demonstration with the truth and tells how it goes, with every status line of the master.

    Parameters
    ----------
    demo
        Truth and daemons.
    timeline
        From CLOCK_MONOTONIC, which the truth is on, to Unix time, which the poses are on.

    Attributes
    ----------
    poses
        How many have come, valid or not, by kind.
    first_ns, last_ns
        Unix time in ns of the first and the last of them; 0 before.
    """

    def __init__(self, demo: Demo, timeline: UnixTimeline) -> None:
        self._demo = demo
        self._start_ns = timeline.unix_ns(demo.start_ns)
        self._valid: defaultdict[Kind, _Valid] = defaultdict(_Valid)
        self._on_terminal = sys.stderr.isatty()
        self._block_lines = 0
        self._shown_at_s = 0.0
        self._starts = 0
        self.poses: Counter[Kind] = Counter()
        self.first_ns = 0
        self.last_ns = 0

    def line(self, line: bytes) -> None:
        """Take a line of the master's stream."""
        if line.startswith(b'{"type":"pose"'):
            self._pose(decode(PoseRecord, line))
        elif line.startswith(b'{"type":"status"'):
            self._status(decode(StatusRecord, line))
        elif line.startswith(b'{"type":"event"'):
            event = decode(EventRecord, line)
            self._say(f"event  {event.event}: {event.message}")

    @property
    def kind(self) -> Kind:
        """The kind of poses that the figures are of: the best that the estimator makes."""
        return "smoothed" if self.poses["predicted"] else "interpolated"

    def valid_stamps_ns(self, kind: Kind) -> NDArray[np.int64]:
        """Return the times of the valid poses of a kind, Unix time in ns."""
        return np.array(self._compared(kind).stamps_ns, dtype=np.int64)

    def errors(self, kind: Kind, counts: NDArray[np.bool_] | None = None) -> PoseErrors:
        """Tell how far valid poses of a kind are from the truth: all of them, or those that count."""
        compared = self._compared(kind)
        chosen = slice(None) if counts is None else counts
        return PoseErrors(np.array(compared.position_m)[chosen], np.array(compared.rotation_rad)[chosen])

    def _compared(self, kind: Kind) -> _Valid:
        """Compare the poses that wait for it."""
        valid = self._valid[kind]
        poses, valid.waiting = valid.waiting, []
        stamps_ns = np.array([pose.stamp_ns for pose in poses], dtype=np.int64)
        positions = np.array([pose.position_m for pose in poses], dtype=np.float64).reshape(-1, 3)
        quaternions = np.array([pose.orientation_xyzw for pose in poses], dtype=np.float64).reshape(-1, 4)
        world = self._demo.world
        errors = pose_errors(
            transform_from(rotation_from_quaternion(quaternions), positions),
            world.pose_at((stamps_ns - self._start_ns) / 1e9),
            world.prisms_m.mean(axis=0),
        )
        valid.stamps_ns.extend(stamps_ns.tolist())
        valid.position_m.extend(errors.position_m.tolist())
        valid.rotation_rad.extend(errors.rotation_rad.tolist())
        return valid

    def _pose(self, pose: PoseRecord) -> None:
        self.first_ns = self.first_ns or pose.stamp_ns
        self.last_ns = max(self.last_ns, pose.stamp_ns)
        self.poses[pose.kind] += 1
        if pose.valid:
            valid = self._valid[pose.kind]
            valid.newest = pose
            valid.waiting.append(pose)
            if len(valid.waiting) == _COMPARED_AT_ONCE:
                self._compared(pose.kind)

    def _status(self, status: StatusRecord) -> None:
        starts = sum(process.starts for process in self._demo.processes)
        if starts != self._starts:
            self._starts = starts
            pids = "  ".join(f"{p.name}: {p.pid or 'down'}" for p in self._demo.processes)
            self._say(f"processes  {pids}")
        now_s = time.monotonic()
        if not self._on_terminal and now_s - self._shown_at_s < LINE_INTERVAL_S:
            return
        self._shown_at_s = now_s
        elapsed_s = (status.stamp_ns - self._start_ns) / 1e9
        newest, errors = self._valid[self.kind].newest, self.errors(self.kind)
        text = f"{elapsed_s:5.0f} s  {len(errors.position_m)}/{self.poses[self.kind]} poses valid"
        if newest is not None:
            position = " ".join(f"{value:6.2f}" for value in newest.position_m or ())
            text += f"  at {position} m  off {errors.position_rms_mm:.1f} mm rms"
        lines = [text]
        for station in status.stations:
            word, _ = station_word(station)
            rate = "" if station.rate_hz is None else f"  {station.rate_hz:.2f} Hz"
            strength = "" if station.rssi_dbm is None else f"  {station.rssi_dbm:.0f} dBm"
            bound_ns = station.stamp_bound_ns if station.clock_bound_ns is None else station.clock_bound_ns
            clock = "" if bound_ns is None else f"  clock within {bound_ns / 1e6:.2f} ms"
            lines.append(f"         station {station.id}  {word}{rate}{strength}{clock}")
        self._show(lines)

    def _show(self, lines: list[str]) -> None:
        """Write a block; on a terminal over the one before."""
        if self._on_terminal:
            up = f"\x1b[{self._block_lines}A" if self._block_lines else ""
            width = shutil.get_terminal_size().columns  # a line that wraps would not be written over
            click.echo(up + "\n".join(f"\x1b[K{line[:width]}" for line in lines), err=True)
            self._block_lines = len(lines)
        else:
            click.echo("\n".join(lines), err=True)

    def _say(self, text: str) -> None:
        """Write a line that stays."""
        self._block_lines = 0
        click.echo(text, err=True)


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
