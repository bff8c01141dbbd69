"""The command ``tsgt replay``."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any

import click

from tsgt import service
from tsgt.cli.options import keep_going_option, recording_argument, socket_option
from tsgt.cli.output import report_problem
from tsgt.clock import SystemClock
from tsgt.errors import RecordingError
from tsgt.master.stream_server import StreamServer
from tsgt.recording import encode_line

if TYPE_CHECKING:
    from pathlib import Path


class _Speed(click.FloatRange):
    """A factor that may be infinite, but not NaN."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Reject NaN."""
        speed = float(super().convert(value, param, ctx))
        if math.isnan(speed):
            self.fail("nan is not a number", param, ctx)
        return speed


@click.command()
@recording_argument
@socket_option
@click.option(
    "--speed",
    type=_Speed(min=0.001),
    default=1.0,
    help="Factor on the pace of the recording; inf: as fast as the readers receive.",
)
@click.option("--wait/--no-wait", default=True, help="Start when the first reader has connected.")
@keep_going_option
def replay(recording: Path, *, socket_path: Path, speed: float, wait: bool, keep_going: bool) -> None:
    """Stream a recording again.

    The recorded measurements pass through the live pipeline in their order and at their times of arrival, so that the
    stream is identical to the last bit at any speed. The replay waits for slow readers.
    """
    # Imported here, so that `tsgt replay --help` starts without numpy.
    from tsgt.master.replay import greeting, replayed
    from tsgt.master.replay import replay as play

    arrivals = replayed(recording, keep_going=keep_going, on_problem=report_problem)
    first = next(arrivals, None)
    if first is None:
        raise RecordingError("holds nothing to replay: no measurement, status or event", path=recording)

    async def serve() -> int:
        async with StreamServer(
            socket_path, encode_line(greeting(recording, keep_going=keep_going))
        ) as server:
            if wait:
                click.echo(f"waiting for a reader: tsgt listen --socket {socket_path}", err=True)
                await server.wait_for_reader()
            lines = await play(itertools.chain([first], arrivals), server, SystemClock(), speed=speed)
            await server.finish()
            return lines

    click.echo(f"{service.run(serve)} lines replayed", err=True)
