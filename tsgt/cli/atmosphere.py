"""The command ``atmosphere``: sets the atmospheric correction of a running client's instrument."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import click

from tsgt.cli.live import connect, setting_lines
from tsgt.cli.options import DEFAULT_CLIENT_SOCKET, json_option, path_type
from tsgt.cli.output import printable
from tsgt.errors import InstrumentError, StreamError
from tsgt.recording import Typed, decode, encode_line
from tsgt.station import AtmosphereRequest, AtmosphereResponse

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.cli.live import LineReader

STATUS_TIMEOUT_S = 5.0
"""A client sends its status at once; one that does not is stuck."""

RESPONSE_TIMEOUT_S = 30.0
"""An instrument that is measuring a target in two faces responds after that."""

NOTICE_AFTER_S = 2.0
"""After this time the reason for the wait is printed."""


# A negative temperature looks like an option.
@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("temperature_c", type=float)
@click.argument("pressure_hpa", type=float)
@click.option(
    "--socket",
    "socket_path",
    type=path_type,
    default=DEFAULT_CLIENT_SOCKET,
    help="Status socket of the client.",
)
@json_option
def atmosphere(temperature_c: float, pressure_hpa: float, socket_path: Path, *, as_json: bool) -> int:
    """Set temperature and pressure of the instrument.

    The running client sets the instrument's atmospheric correction. TEMPERATURE_C is measured in the shade,
    PRESSURE_HPA at the instrument, not reduced to sea level as in a weather report. An error of 1 degree or 3.6 hPa
    changes a distance of one kilometre by about 1 mm. The setting lasts until the client restarts; then its
    configuration applies.
    """
    request = AtmosphereRequest(temperature_c=temperature_c, pressure_hpa=pressure_hpa)
    response = _request(socket_path, encode_line(request))
    if as_json:
        click.echo(encode_line(response))
        return 1 if response.problem else 0
    if response.problem:
        raise InstrumentError(f"{socket_path}: {printable(response.problem)}")
    lines = [] if response.settings is None else setting_lines(response.settings)
    click.echo("\n".join(["set; distances are corrected by", *lines] if lines else ["set"]))
    return 0


def _request(path: Path, request: bytes) -> AtmosphereResponse:
    """Send a request to a client, whose first line is its status, and return the response."""
    try:
        with connect(path, STATUS_TIMEOUT_S) as client:
            client.send(request)
            status = client.line(time.monotonic() + STATUS_TIMEOUT_S)
            if decode(Typed, status).type != "client_status":
                raise ValueError("this is a master; give the socket of a client")
            return decode(AtmosphereResponse, _response(client, path))
    except TimeoutError as error:
        raise StreamError(
            f"{path}: no status within {STATUS_TIMEOUT_S:g} s; the client is stuck, see its log"
        ) from error
    except StreamError:
        raise
    except OSError as error:
        raise StreamError(
            f"{path}: no connection to a client ({error.strerror or error}); start tsgt-client, or give --socket"
        ) from error
    except ValueError as error:
        raise StreamError(f"{path}: not the response of a client ({error})") from error


def _response(client: LineReader, path: Path) -> bytes:
    """Wait for the second line, which the client sends when the instrument is free."""
    started_s = time.monotonic()
    try:
        try:
            return client.line(started_s + NOTICE_AFTER_S)
        except TimeoutError:
            click.echo(f"waiting up to {RESPONSE_TIMEOUT_S:g} s for the busy instrument", err=True)
            return client.line(started_s + RESPONSE_TIMEOUT_S)
    except TimeoutError as error:
        raise StreamError(
            f"{path}: the instrument has been busy for {RESPONSE_TIMEOUT_S:g} s; the client sets it as soon as it is free, "
            "`tsgt status` shows the correction in force"
        ) from error
    except OSError as error:
        raise StreamError(f"{path}: the client has ended ({error.strerror or error}); see its log") from error
