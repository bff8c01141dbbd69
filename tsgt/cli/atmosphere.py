"""The command ``atmosphere``: tells a station's client what thermometer and barometer show."""

from __future__ import annotations

import socket
import time
from typing import TYPE_CHECKING

import click

from tsgt.cli.options import DEFAULT_CLIENT_SOCKET, json_option, path_type
from tsgt.cli.output import harmless
from tsgt.cli.status import setting_lines
from tsgt.errors import InstrumentError, StreamError
from tsgt.recording import MAX_LINE_BYTES, Typed, decode, encode_line
from tsgt.station import Answer, AtmosphereRequest

if TYPE_CHECKING:
    from pathlib import Path

STATUS_S = 5.0
"""A client says at once how it does; one that has not by then is stuck."""

ANSWER_S = 30.0
"""An instrument that measures a target in two faces listens when it has done that."""

QUIET_S = 2.0
"""Whoever waits longer than this is told what for."""


# A negative temperature looks like an option otherwise.
@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("temperature_c", type=float)
@click.argument("pressure_hpa", type=float)
@click.option(
    "--socket",
    "socket_path",
    type=path_type,
    default=DEFAULT_CLIENT_SOCKET,
    show_default=True,
    help="Status socket of the client.",
)
@json_option
def atmosphere(temperature_c: float, pressure_hpa: float, socket_path: Path, *, as_json: bool) -> int:
    """Tell the total station beside this computer the air, while it measures.

    TEMPERATURE_C in the shade, PRESSURE_HPA at the instrument: not the one of the weather report, which is reduced to
    sea level. A degree, or 3.6 hPa, changes distances by about 1 mm in a kilometre. It holds until it is said anew or
    the client is started anew; then its configuration counts again.
    """
    request = AtmosphereRequest(temperature_c=temperature_c, pressure_hpa=pressure_hpa)
    answer = _asked(socket_path, encode_line(request) + b"\n")
    if as_json:
        click.echo(encode_line(answer))
        return 1 if answer.problem else 0
    if answer.problem:
        raise InstrumentError(f"{socket_path}: {harmless(answer.problem)}")
    lines = [] if answer.settings is None else setting_lines(answer.settings)
    click.echo("\n".join(["set; distances are measured with", *lines] if lines else ["set"]))
    return 0


def _asked(path: Path, request: bytes) -> Answer:
    """Say something to a client, whose first line is its status; return its answer."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        received = bytearray()
        try:
            connection.settimeout(STATUS_S)
            connection.connect(str(path))
            connection.sendall(request)
            status = _line(connection, received, time.monotonic() + STATUS_S)
        except TimeoutError as error:
            raise StreamError(
                f"{path}: no status within {STATUS_S:g} s; the client is stuck, see its log"
            ) from error
        except OSError as error:
            raise StreamError(
                f"{path}: nobody answers ({error.strerror or error}); start tsgt-client, or give --socket"
            ) from error
        try:
            if decode(Typed, status).type != "client_status":
                raise ValueError("that is a master; give the socket of a client")
            return decode(Answer, _answer(connection, received, path))
        except ValueError as error:
            raise StreamError(f"{path}: it does not answer as a client does ({error})") from error


def _answer(connection: socket.socket, received: bytearray, path: Path) -> bytes:
    """Wait for the second line, which comes when the instrument is free."""
    began_s = time.monotonic()
    try:
        try:
            return _line(connection, received, began_s + QUIET_S)
        except TimeoutError:
            click.echo(f"waiting for the instrument, which is busy; {ANSWER_S:g} s at most", err=True)
            return _line(connection, received, began_s + ANSWER_S)
    except TimeoutError as error:
        raise StreamError(
            f"{path}: the instrument has not been free for {ANSWER_S:g} s; it is told as soon as it is, "
            "`tsgt status` shows the air"
        ) from error
    except OSError as error:
        raise StreamError(f"{path}: the client ended ({error.strerror or error}); see its log") from error


def _line(connection: socket.socket, received: bytearray, until_s: float) -> bytes:
    """Return the next line, or what there is of it at the end; what comes after it stays in what was received.

    Raises
    ------
    TimeoutError
        It is not whole by that time on the monotonic clock, however many bytes have come.
    """
    while b"\n" not in received and len(received) < MAX_LINE_BYTES:
        if (left_s := until_s - time.monotonic()) <= 0:
            raise TimeoutError
        connection.settimeout(left_s)
        if not (data := connection.recv(65536)):
            break
        received += data
    line, _, rest = bytes(received).partition(b"\n")
    received[:] = rest
    return line
