"""The command ``web``: the operator's page."""

from __future__ import annotations

import ipaddress
from typing import TYPE_CHECKING

import click

from tsgt.cli.options import DEFAULT_SOCKET, path_type
from tsgt.cli.output import require_extra

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.web.access import Access

DEFAULT_PORT = 8023

NEW_CODE = "(umask 077; tr -dc a-z0-9 < /dev/urandom | head -c 12 > web.code)"
"""Command for a new code: 12 letters and digits are 62 bits."""


@click.command()
@click.option(
    "--listen",
    "address",
    default="127.0.0.1",
    metavar="ADDRESS",
    help="IP address to serve on; 0.0.0.0: all of this machine. One that is not loopback needs --code-file.",
)
@click.option(
    "--port", type=click.IntRange(0, 65535), default=DEFAULT_PORT, help="TCP port; 0: any free one."
)
@click.option(
    "--socket",
    "socket_path",
    type=path_type,
    envvar="TSGT_SOCKET",
    show_envvar=True,
    help=f"UNIX socket of the pose stream.  [default: {DEFAULT_SOCKET}]",
)
@click.option("--replay", "recording", type=path_type, help="Show a recording, with a time bar.")
@click.option("--code-file", type=path_type, help="File with the access code, of mode 0600.")
@click.option(
    "--name",
    "names",
    multiple=True,
    metavar="HOST",
    help="Host name by which browsers may ask for the page, such as robot.local; addresses need none. May be repeated.",
)
@click.option("--certificate", type=path_type, help="Certificate chain (PEM) for TLS.")
@click.option("--key", type=path_type, help="Private key (PEM) of the certificate.  [default: in its file]")
@click.option(
    "--foxglove",
    is_flag=True,
    help="Serve the live stream to the Foxglove app as well, on the same address and with the same code; needs the extra foxglove.",
)
def web(
    *,
    address: str,
    port: int,
    socket_path: Path | None,
    recording: Path | None,
    code_file: Path | None,
    names: tuple[str, ...],
    certificate: Path | None,
    key: Path | None,
    foxglove: bool,
) -> None:
    """Serve the operator's page to browsers.

    Reads the pose stream, or a recording, and shows verdict, map, stations, residuals and events. The page can
    change nothing. It is for this machine alone unless --listen says otherwise.
    """
    if recording is not None and socket_path is not None:
        raise click.UsageError("--replay shows a recording, --socket a stream: give one of them")
    if key is not None and certificate is None:
        raise click.UsageError("--key belongs to a --certificate; give both")
    if recording is not None and foxglove:
        raise click.UsageError(
            "--foxglove serves a live stream; for a recording: `tsgt export RECORDING --format mcap`, and open the file"
        )
    listen = _address(address)
    require_extra("pages for browsers", "aiohttp", extra="web")
    if foxglove:
        require_extra("Foxglove", "foxglove", extra="foxglove")
    # Imported here: `--help` needs none of it.
    from tsgt import service
    from tsgt.clock import SystemClock
    from tsgt.web.server import Settings

    settings = Settings(
        address=address,
        port=port,
        access=_access(listen, code_file),
        names=frozenset(name.lower() for name in names),
        certificate=certificate,
        key=key,
    )
    clock = SystemClock()
    if recording is not None:
        from tsgt.web.program import run_replay

        service.run(lambda: run_replay(recording, settings, clock, _say))
    else:
        from tsgt.web.program import run_live

        apps, say = None, _say
        if foxglove:
            from tsgt.web.foxglove import FoxgloveServer

            apps, say = FoxgloveServer, _say_with_code if code_file is not None else _say_both
        service.run(lambda: run_live(socket_path or DEFAULT_SOCKET, settings, clock, say, apps))


def _say(url: str) -> None:
    click.echo(f"the page is at {url}", err=True)


def _say_both(url: str, query: str = "") -> None:
    _say(url)
    click.echo(f"open in Foxglove: {url.replace('http', 'ws', 1)}foxglove{query}", err=True)


def _say_with_code(url: str) -> None:
    _say_both(url, "?code=CODE")


def _address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        raise click.UsageError(
            f"--listen: {text!r} is no IP address; `ip -brief address` lists those of this machine"
        ) from None


def _access(listen: ipaddress.IPv4Address | ipaddress.IPv6Address, code_file: Path | None) -> Access | None:
    from tsgt.web.access import Access
    from tsgt.web.code_file import read_code

    if code_file is not None:
        return Access(read_code(code_file))
    if not listen.is_loopback:
        raise click.UsageError(
            f"--listen {listen} lets other computers reach the page: give --code-file, a file of mode 0600 with an access "
            f"code, made for example by: {NEW_CODE}"
        )
    return None
