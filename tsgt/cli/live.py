"""Commands on the live stream: ``tsgt listen`` and ``tsgt replay``."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any

import click

from tsgt import service
from tsgt.cli.line_reader import connect
from tsgt.cli.options import keep_going_option, recording_argument, socket_option
from tsgt.cli.output import printable, report_problem
from tsgt.cli.render import render
from tsgt.clock import SystemClock
from tsgt.errors import RecordingError, StreamError
from tsgt.master.stream_server import StreamServer
from tsgt.recording import Typed, decode, encode_line

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@click.command()
@socket_option
@click.option("--json", "as_json", is_flag=True, help="Print the lines as received, one JSON object each.")
@click.option("--count", type=click.IntRange(min=1), help="Number of lines to print.  [default: all]")
def listen(socket_path: Path, *, as_json: bool, count: int | None) -> None:
    """Print the pose stream as text.

    Prints one line per record until the stream ends.
    """
    for line in itertools.islice(_lines(socket_path), count):
        if as_json:
            click.echo(line, nl=False)
            continue
        try:
            text = render(decode(Typed, line).type, line)
        except ValueError as error:
            click.echo(f"warning: unreadable line: {error}", err=True)
        else:
            if text is not None:
                click.echo(printable(text))


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
    # Imported here, so that `tsgt listen` starts without numpy.
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


def _lines(socket_path: Path) -> Iterator[bytes]:
    connected = False
    try:
        with connect(socket_path) as reader:
            connected = True
            while line := reader.line():
                yield line
    except ConnectionResetError:  # the server closes the connection of a reader that is too slow at the end
        return
    except ValueError as error:
        raise StreamError(f"{socket_path}: not a stream of tsgt: {error}") from error
    except OSError as error:
        if connected:
            raise
        raise StreamError(
            f"{socket_path}: no stream ({error.strerror or error}); start tsgt-master, tsgt demo or tsgt replay, or "
            "give the right --socket"
        ) from error
