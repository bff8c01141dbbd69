"""The command ``tsgt status``: the state of the daemon on this machine, once or continuously."""

from __future__ import annotations

import contextlib
import shutil
import sys
import time
from typing import TYPE_CHECKING, NamedTuple

import click

from tsgt.cli.live.follower import StreamFollower
from tsgt.cli.live.line_reader import connect
from tsgt.cli.live.status_text import client_text, master_text
from tsgt.cli.live.watch import Watch
from tsgt.cli.options import DEFAULT_CLIENT_SOCKET, DEFAULT_SOCKET, path_type
from tsgt.cli.output import CHECK_FAILED, printable
from tsgt.cli.render import clock_time, render
from tsgt.errors import StreamError
from tsgt.recording import PoseRecord, StatusRecord, Typed, decode
from tsgt.station import ClientStatus
from tsgt.web.mission import MissionState
from tsgt.web.mission.verdict import Level

if TYPE_CHECKING:
    from pathlib import Path

TIMEOUT_S = 5.0
"""A master sends its status each second; one that sends none for this long is stuck."""

MAX_POSE_WAIT_S = 1.5
"""A master sends the next status within a second; if no live pose has come until then, there is none."""


@click.command()
@click.option(
    "--socket",
    "socket_path",
    type=path_type,
    envvar="TSGT_SOCKET",
    show_envvar=True,
    help=f"Socket of a master or a client.  [default: {DEFAULT_SOCKET}, else {DEFAULT_CLIENT_SOCKET}]",
)
@click.option("--json", "as_json", is_flag=True, help="Print the status record as received.")
@click.option(
    "--watch",
    is_flag=True,
    help="Show a screen that is updated in place until Ctrl-C; without a terminal, or with --json, a line per status.",
)
def status(socket_path: Path | None, *, as_json: bool, watch: bool) -> int:
    """Show the status of the daemon on this machine.

    A master reports all its stations, a client its own station. With --watch also the verdict, the pose and the last
    events; it connects again when the daemon was restarted.

    Exit code 1: no daemon runs. 3: a daemon runs, but action is required: a station is not received or does not track,
    the IMU gives no samples, disagrees with the prisms or is not confirmed, the disk is full or fails, or no pose is
    valid. With --watch 0, or 1 if the stream has another protocol version.
    """
    if watch:
        paths = [DEFAULT_SOCKET, DEFAULT_CLIENT_SOCKET] if socket_path is None else [socket_path]
        with contextlib.closing(StreamFollower(paths)) as follower:
            if as_json or not sys.stdout.isatty():
                _print_lines(follower, as_json=as_json)
            else:
                _show_screen(follower)
        return 0
    answer = _request(socket_path)
    record = answer.record
    text, ok = (
        client_text(record) if isinstance(record, ClientStatus) else master_text(record, answer.no_pose)
    )
    click.echo(answer.line.rstrip() if as_json else "\n".join(text))
    return 0 if ok else CHECK_FAILED


def _show_screen(follower: StreamFollower) -> None:
    from tsgt.cli.live.screen import REFRESH_S, screen

    watch = Watch()
    with screen() as show:
        while True:
            for line in follower.lines(time.monotonic() + REFRESH_S):
                with contextlib.suppress(ValueError):  # of a newer version; `tsgt listen` reports it
                    watch.take(line, time.monotonic())
            width = shutil.get_terminal_size().columns
            show(*watch.view(time.monotonic(), follower.problem, width=width), list(watch.events))


def _print_lines(follower: StreamFollower, *, as_json: bool) -> None:
    """Print a line per status, and on stderr unreadable lines and the loss of the connection."""
    problem = ""
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            for line in follower.lines(time.monotonic() + TIMEOUT_S):
                try:
                    kind = decode(Typed, line).type
                    if kind not in ("status", "client_status"):
                        continue
                    text = line.rstrip() if as_json else _text_line(kind, line)
                except ValueError as error:  # of a newer version, for example
                    click.echo(f"warning: unreadable line: {error}", err=True)
                else:
                    click.echo(text)
            if follower.problem not in (problem, ""):
                click.echo(f"warning: {follower.problem}; connecting again", err=True)
            problem = follower.problem


def _text_line(kind: str, line: bytes) -> str:
    if kind == "client_status":
        record = decode(ClientStatus, line)
        return f"{clock_time(record.stamp_ns)}  status  {click.unstyle(client_text(record)[0][0])}"
    return printable(render(kind, line) or "")


def _request(socket_path: Path | None) -> Answer:
    """Read the status from the given socket, else from the default of a master, then of a client."""
    if socket_path is not None:
        return status_of(socket_path)
    for path in (DEFAULT_SOCKET, DEFAULT_CLIENT_SOCKET):
        with contextlib.suppress(StreamError):
            return status_of(path)
    raise StreamError(
        f"no daemon runs here: neither {DEFAULT_SOCKET} nor {DEFAULT_CLIENT_SOCKET} responds; "
        "start tsgt-master or tsgt-client, or give --socket"
    )


class Answer(NamedTuple):
    """A daemon's status, its line, and of a master why there is no valid pose now; empty if there is one."""

    record: StatusRecord | ClientStatus
    line: bytes
    no_pose: str = ""


def status_of(path: Path) -> Answer:
    """Wait for the first status on a socket, and with a master for a live pose or the next status."""
    until_s = time.monotonic() + TIMEOUT_S  # for the status, not for each line
    mission = MissionState(str(path))
    mission.connected(time.monotonic())
    found: Answer | None = None
    pose_seen = False
    try:
        with connect(path, TIMEOUT_S) as reader:
            while line := reader.line(until_s):
                now_s, kind = time.monotonic(), decode(Typed, line).type
                if kind == "client_status":
                    return Answer(decode(ClientStatus, line), line)
                try:
                    mission.line(line, now_s)
                    pose_seen |= kind == "pose" and decode(PoseRecord, line).kind != "smoothed"
                except ValueError:  # another line that cannot be read is one less
                    if kind in ("hello", "status"):
                        raise
                complete = found is not None and kind == "status"
                if kind == "status":
                    found, until_s = Answer(decode(StatusRecord, line), line), now_s + MAX_POSE_WAIT_S
                if found is not None and (pose_seen or complete):
                    break
    except TimeoutError as error:
        if found is None:
            raise StreamError(
                f"{path}: no status within {TIMEOUT_S:g} s; the daemon is stuck, see its log"
            ) from error
    except OSError as error:
        raise StreamError(f"{path}: no connection to a daemon ({error.strerror or error})") from error
    except ValueError as error:
        raise StreamError(f"{path}: not a stream of tsgt ({error})") from error
    if found is None:
        raise StreamError(f"{path}: the stream ended without a status; is it a replay?")
    verdict = mission.findings_now(time.monotonic())[0]
    return found._replace(no_pose=verdict.cause if verdict.level >= Level.NO_POSE else "")
