"""The command ``tsgt listen``: the stream as lines, or the newest of each kind in place on a terminal."""

from __future__ import annotations

import contextlib
import itertools
import re
import sys
import time
from collections import deque
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import click

from tsgt.cli.live.line_reader import check_version, connect
from tsgt.cli.live.pose_text import measurement_block, pose_block
from tsgt.cli.live.status_text import wrapped
from tsgt.cli.live.stream_filter import KINDS, StreamFilter
from tsgt.cli.live.watch import MAX_EVENTS, MAX_SILENCE_S, event_text
from tsgt.cli.options import FiniteRange, socket_option
from tsgt.cli.output import printable
from tsgt.cli.render import render
from tsgt.errors import StreamError
from tsgt.model import PolarMeasurement
from tsgt.recording import EventRecord, PoseRecord, Typed, decode

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tsgt.cli.live.status_text import Block

_SCREEN_KINDS = frozenset({"pose", "smoothed", "measurement", "event"})  # unless others are selected


class _Kinds(click.ParamType[frozenset[str]]):
    """Names of kinds, separated by commas."""

    name = "kinds"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> frozenset[str]:
        """Reject unknown names."""
        if isinstance(value, frozenset):
            return value
        names = frozenset(filter(None, re.split(r"[,\s]+", str(value))))
        if unknown := sorted(names - set(KINDS)):
            self.fail(f"unknown kind {unknown[0]!r}; known: {', '.join(KINDS)}", param, ctx)
        return names


class _Instant(click.ParamType[int]):
    """A time as ISO 8601 or as a stamp in ns; gives Unix time in ns."""

    name = "time"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Reject what is no time."""
        text = str(value)
        if text.isascii() and text.isdigit():
            return int(text)
        try:
            at = datetime.fromisoformat(text)
        except ValueError:
            self.fail(
                f"{text!r} is neither a time such as 2026-11-21T05:51:00Z nor a stamp in ns", param, ctx
            )
        seconds = (at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp()
        return round(seconds * 1e6) * 1000


@click.command()
@socket_option
@click.option("--json", "as_json", is_flag=True, help="Print the lines as received, one JSON object each.")
@click.option("--count", type=click.IntRange(min=1), help="Number of lines to print.  [default: all]")
@click.option(
    "--kind",
    "kinds",
    type=_Kinds(),
    default="",
    show_default=False,
    help=f"Kinds of lines, separated by commas: {', '.join(KINDS)}. pose: predicted or interpolated. clock: also beacons. "
    "[default: all]",
)
@click.option(
    "--rate",
    "rate_hz",
    type=FiniteRange(0.001, 1000.0),
    help="Maximum number of poses per second of each series (predicted, smoothed at each delay, final), by their stamps.",
)
@click.option(
    "--since",
    "since_ns",
    type=_Instant(),
    default="0",
    show_default=False,
    help="Skip lines with an earlier stamp: ISO 8601 (UTC without a zone) or a stamp in ns. Lines from before the "
    "connection are not sent again; the recording has them: replay it with tsgt replay, and listen to the replay.",
)
def listen(
    socket_path: Path,
    *,
    as_json: bool,
    count: int | None,
    kinds: frozenset[str],
    rate_hz: float | None,
    since_ns: int,
) -> None:
    """Print the pose stream as text.

    Prints one line per record until the stream ends. On a terminal the newest record of each kind is shown in place
    instead, with the last events; a pipe (tsgt listen | cat) and --json give lines.
    """
    on_screen = sys.stdout.isatty() and not as_json
    if on_screen and not kinds:
        kinds = _SCREEN_KINDS
    stream_filter = StreamFilter(kinds, rate_hz, since_ns)
    if on_screen:
        _show_screen(socket_path, stream_filter, count)
    else:
        _print_lines(socket_path, stream_filter, count, as_json=as_json)


def _print_lines(socket_path: Path, stream_filter: StreamFilter, count: int | None, *, as_json: bool) -> None:
    printed = 0
    for line in _lines(socket_path):
        if as_json and stream_filter.accepts_all:
            click.echo(line, nl=False)
        else:
            try:
                if not stream_filter.accepts(line):
                    _warn_of_loss(line)
                    continue
                text = line.decode() if as_json else render(decode(Typed, line).type, line)
            except ValueError as error:
                click.echo(f"warning: unreadable line: {error}", err=True)
                text = None
            if text is not None:
                click.echo(text, nl=False) if as_json else click.echo(printable(text))
        printed += 1
        if printed == count:
            return


def _warn_of_loss(line: bytes) -> None:
    """Print on stderr that lines are missing, where events are not selected."""
    if b'"lines_lost"' in line and decode(Typed, line).type == "event":
        event = decode(EventRecord, line)
        if event.event == "lines_lost":
            click.echo(f"warning: {printable(event.message)}", err=True)


def _show_screen(socket_path: Path, stream_filter: StreamFilter, count: int | None) -> None:
    from tsgt.cli.live.screen import REFRESH_S, screen

    newest = _Newest()
    received, line_s = 0, time.monotonic()
    lines = _lines(socket_path, REFRESH_S)
    first = next(lines)  # before the terminal is taken over: there may be no stream
    with screen() as show:
        for line in itertools.chain([first], lines):
            if line:
                line_s = time.monotonic()
                with contextlib.suppress(ValueError):  # of a newer version
                    if stream_filter.accepts(line):
                        newest.take(line)
                        received += 1
            silence_s = time.monotonic() - line_s
            if not line or received == count:
                stopped = silence_s > MAX_SILENCE_S
                headline = f"{'STREAM STOPPED' if stopped else 'LISTENING'}  last line {silence_s:.1f} s ago"
                show(
                    [click.style(headline, bold=True, reverse=stopped)],
                    newest.blocks(),
                    list(newest.events),
                )
            if received == count:
                return
    click.echo("the stream has ended", err=True)


class _Newest:
    """The newest record of each kind, and the last events."""

    def __init__(self) -> None:
        self.events: deque[str] = deque(maxlen=MAX_EVENTS)
        self._blocks: dict[tuple[int, str, float], Block] = {}

    def take(self, line: bytes) -> None:
        """Take a line; raises ValueError if it cannot be read."""
        kind = decode(Typed, line).type
        if kind == "pose":
            pose = decode(PoseRecord, line)
            final_last = (
                float("inf") if pose.delay_s is None and pose.kind == "smoothed" else pose.delay_s or 0.0
            )
            self._blocks[0, "", final_last] = pose_block(pose)
        elif kind == "measurement":
            measurement = decode(PolarMeasurement, line)
            self._blocks[1, "", measurement.station] = measurement_block(measurement)
        elif kind == "event":
            self.events.append(event_text(decode(EventRecord, line)))
        elif (text := render(kind, line)) is not None:
            self._blocks[2, kind, 0.0] = wrapped(text)

    def blocks(self) -> list[Block]:
        """Return poses, measurements and the others."""
        return [block for _, block in sorted(self._blocks.items(), key=lambda item: item[0])]


def _lines(socket_path: Path, refresh_s: float | None = None) -> Iterator[bytes]:
    """Yield the lines of the stream, and nothing in between at an interval."""
    connected = received = False
    try:
        with connect(socket_path) as reader:
            connected = True
            until_s = None if refresh_s is None else time.monotonic()
            while True:
                if refresh_s is not None and until_s is not None and time.monotonic() >= until_s:
                    until_s = time.monotonic() + refresh_s
                    yield b""
                try:
                    line = reader.line(until_s)
                except TimeoutError:
                    continue
                if not line:
                    break
                received = True
                check_version(line)
                yield line
    except ConnectionResetError:  # the server closes the connection of a reader that is too slow at the end
        pass
    except ValueError as error:
        raise StreamError(f"{socket_path}: not a stream of tsgt: {error}") from error
    except OSError as error:
        if connected:
            raise
        raise StreamError(
            f"{socket_path}: no stream ({error.strerror or error}); start tsgt-master, tsgt demo or tsgt replay, or "
            "give the right --socket"
        ) from error
    if not received:
        raise StreamError(
            f"{socket_path}: the connection was closed without a line; are there too many readers?"
        )
