"""Commands on the live stream: ``tsgt listen`` and ``tsgt replay``."""

from __future__ import annotations

import contextlib
import itertools
import socket
from typing import TYPE_CHECKING

import click

from tsgt import service
from tsgt.cli.options import a_number, keep_going_option, recording_argument, socket_option
from tsgt.cli.output import harmless
from tsgt.cli.recordings import report_problem
from tsgt.cli.render import render
from tsgt.clock import SystemClock
from tsgt.errors import RecordingError, StreamError
from tsgt.master import StreamServer
from tsgt.recording import MAX_LINE_BYTES, HelloRecord, Typed, decode, encode_line

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@click.command()
@socket_option
@click.option("--json", "as_json", is_flag=True, help="Print the lines as they come, one JSON object each.")
@click.option("--count", type=click.IntRange(min=1), help="Stop after so many lines.")
def listen(socket_path: Path, *, as_json: bool, count: int | None) -> None:
    """Show the stream, one line each, until it ends."""
    for line in itertools.islice(_lines(socket_path), count):
        if as_json:
            click.echo(line, nl=False)
            continue
        try:
            text = render(decode(Typed, line).type, line)
        except ValueError as error:
            click.echo(f"a line cannot be shown: {error}", err=True)
        else:
            if text is not None:
                click.echo(harmless(text))


@click.command()
@recording_argument
@socket_option
@click.option(
    "--speed",
    type=click.FloatRange(min=0.001),
    callback=a_number,
    default=1.0,
    show_default=True,
    help="Times the pace of the recording; inf: as fast as the readers take it.",
)
@click.option(
    "--wait/--no-wait",
    default=True,
    show_default=True,
    help="Begin when the first reader is there, or at once.",
)
@keep_going_option
def replay(recording: Path, *, socket_path: Path, speed: float, wait: bool, keep_going: bool) -> None:
    """Put a recording through the live pipeline into the socket again.

    Whatever arrived is handed over in the order and at the instants of the recording, so the stream is the same to
    the last bit, at any speed. A slow reader is waited for.
    """
    # Only here, so that `tsgt listen` starts without numpy.
    from tsgt.master import replay as play
    from tsgt.master import replayed

    arrivals = replayed(recording, keep_going=keep_going, on_problem=report_problem)
    first = next(arrivals, None)
    if first is None:
        raise RecordingError("holds nothing to replay: no measurement, status or event", path=recording)

    async def serve() -> int:
        async with StreamServer(socket_path, encode_line(HelloRecord())) as server:
            if wait:
                click.echo(f"waiting for a reader: tsgt listen --socket {socket_path}", err=True)
                await server.wait_for_reader()
            lines = await play(itertools.chain([first], arrivals), server, SystemClock(), speed=speed)
            await server.finish()
            return lines

    click.echo(f"{service.run(serve)} lines replayed", err=True)


def _lines(socket_path: Path) -> Iterator[bytes]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        try:
            connection.connect(str(socket_path))
        except OSError as error:
            raise StreamError(
                f"{socket_path}: no stream there ({error.strerror or error}); start tsgt-master, tsgt demo or "
                "tsgt replay, or give the right --socket"
            ) from error
        # A server that gives up on us, because we were too slow at its end, resets the connection.
        with connection.makefile("rb") as file, contextlib.suppress(ConnectionResetError):
            while line := file.readline(MAX_LINE_BYTES):
                if len(line) == MAX_LINE_BYTES and not line.endswith(b"\n"):
                    raise StreamError(
                        f"{socket_path}: what it says is no stream of tsgt: a line is longer than {MAX_LINE_BYTES} bytes"
                    )
                yield line
