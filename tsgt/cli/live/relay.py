"""``tsgt relay``."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import click

from tsgt.cli.options import FiniteRange, path_type, socket_option
from tsgt.client.relay_wire import DEFAULT_PORT

if TYPE_CHECKING:
    from pathlib import Path

LOOPBACK = "127.0.0.1"

MAKE_KEY = "tsgt relay --make-key"


class _AddressType(click.ParamType["tuple[str, int]"]):
    """A numeric address to listen on, perhaps with a port."""

    name = "address"

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, int]:
        """Parse ``ADDRESS``, ``ADDRESS:PORT``, ``[IPV6]:PORT``."""
        import ipaddress

        match = re.fullmatch(r"(?:\[([^\]]+)\]|([^:\[\]]+))(?::(\d{1,5}))?|([0-9a-fA-F:]+)", str(value))
        try:
            if match is None:
                raise ValueError
            host = match[1] or match[2] or match[4]
            ipaddress.ip_address(host.partition("%")[0])
            port = int(match[3]) if match[3] else DEFAULT_PORT
            if port >= 1 << 16:
                raise ValueError
        except ValueError:
            self.fail(
                f"{value} is not ADDRESS, ADDRESS:PORT or [IPV6]:PORT, with an address in digits", param, ctx
            )
        return host, port


def _make_key(ctx: click.Context, param: click.Parameter, path: Path | None) -> None:  # noqa: ARG001 (click's signature)
    from tsgt.radio.key_file import write_key

    if path is not None:
        write_key(path)
        click.echo(
            f"{path}: a new key for a relay and its readers. Anybody who has it can read poses: keep it secret."
        )
        ctx.exit()


@click.command()
@socket_option
@click.option(
    "--key",
    "key_path",
    type=path_type,
    required=True,
    help="File with the key that readers need.",
)
@click.option(
    "--make-key",
    type=path_type,
    is_eager=True,
    expose_value=False,
    callback=_make_key,
    help="Write a random key to this new file and exit.",
)
@click.option(
    "--listen",
    type=_AddressType(),
    default=f"{LOOPBACK}:{DEFAULT_PORT}",
    metavar="ADDRESS[:PORT]",
    help="Address of this computer that readers connect to; 0.0.0.0: any.",
)
@click.option(
    "--certificate",
    type=path_type,
    help="Encrypt with TLS: certificate (PEM), which may be self-signed. Without it, others on the network can read along.",
)
@click.option("--private-key", type=path_type, help="Private key of the certificate (PEM).")
@click.option(
    "--hold-s",
    type=FiniteRange(0, 3600),
    default=120.0,
    help="Time in s for which lines are held for readers whose connection was lost; at most 32 MiB.",
)
def relay(
    socket_path: Path,
    *,
    key_path: Path,
    listen: tuple[str, int],
    certificate: Path | None,
    private_key: Path | None,
    hold_s: float,
) -> None:
    """Serve the pose stream to other computers.

    Readers need the key; they can only read. After a lost connection they get what they have missed. Runs until SIGTERM or
    Ctrl-C, and waits for the master when there is none.
    """
    import ssl

    from tsgt import service
    from tsgt.clock import SystemClock
    from tsgt.errors import ConfigError
    from tsgt.radio.key_file import read_key
    from tsgt.relay import run_relay

    if (certificate is None) != (private_key is None):
        raise click.UsageError("give --certificate and --private-key together")
    key = read_key(key_path, make_key=MAKE_KEY)
    tls = None
    if certificate is not None and private_key is not None:
        from tsgt.client.tls import relay_context

        try:
            tls = relay_context(certificate, private_key)
        except (OSError, ValueError) as error:
            reason = (
                error.strerror
                if isinstance(error, OSError) and not isinstance(error, ssl.SSLError)
                else error
            )
            raise ConfigError(
                f"{certificate}, {private_key}: cannot be used ({reason})", path=certificate
            ) from error
    host, port = listen
    service.run(lambda: run_relay(socket_path, host, port, key, SystemClock(), held_s=hold_s, tls=tls))
