"""The command ``doctor``, which tells whether this machine is ready for the field."""

from __future__ import annotations

import shutil
import socket
from contextlib import aclosing
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tsgt import service
from tsgt.cli.options import json_option, path_type
from tsgt.cli.output import CHECK_FAILED, print_json
from tsgt.clock import SystemClock
from tsgt.doctor import (
    Finding,
    Machine,
    Outcome,
    current_user,
    examine,
    find_user,
    free_bytes,
    group_name,
    run_command,
)
from tsgt.log import configure_logging
from tsgt.radio.sx127x import open_hal

if TYPE_CHECKING:
    from tsgt.station import ClientStatus
    from tsgt.station.serial import OpenPort, Port

USUAL = (Path("/etc/tsgt/client.toml"), Path("/etc/tsgt/master.toml"))

WORDS = {Outcome.OK: "ok", Outcome.NOTE: "note", Outcome.FAILED: "FAILED", Outcome.SKIPPED: "skipped"}


@click.command()
@click.argument("config", type=path_type, required=False)
@json_option
def doctor(config: Path | None, as_json: bool) -> int:  # noqa: FBT001 (click passes options by name)
    """Check this machine before it goes into the field: a station's client or the master.

    CONFIG is its configuration; without it /etc/tsgt/client.toml or /etc/tsgt/master.toml. A daemon may run meanwhile:
    what it has in use is left alone then. Nothing is changed and nothing is sent. With sudo more can be looked at.

    Exit code 3: a check failed. What is only noted, or could not be checked, fails nothing.
    """
    configure_logging("error")  # the findings say it all
    path = config or _usual_config()
    findings = service.run(lambda: _report(this_machine(), path, quiet=as_json))
    bad = [finding.name for finding in findings if finding.ok is False]
    if as_json:
        checks = {
            finding.name: {"ok": finding.ok, "outcome": str(finding.outcome), "detail": finding.detail}
            for finding in findings
        }
        print_json({"config": str(path), "ok": not bad, "checks": checks})
    else:
        made = sum(finding.ok is not None for finding in findings)
        click.echo(f"{len(bad)} of {made} checks failed" if bad else f"all {made} checks passed")
    return CHECK_FAILED if bad else 0


async def _report(machine: Machine, path: Path, *, quiet: bool) -> list[Finding]:
    found = []
    async with aclosing(examine(machine, path)) as findings:
        async for finding in findings:
            found.append(finding)
            if not quiet:
                word = click.style(
                    f"{WORDS[finding.outcome]:7}", bold=finding.ok is False, reverse=finding.ok is False
                )
                click.echo(f"{word} {finding.name.replace('_', ' '):17}{finding.detail}")
    return found


def _usual_config() -> Path:
    there = [path for path in USUAL if path.exists()]
    if len(there) > 1:
        raise click.UsageError(f"there are {' and '.join(map(str, there))}: name the one to check")
    return there[0] if there else USUAL[0]


def this_machine() -> Machine:
    """Return the machine that this program runs on."""
    clock = SystemClock()

    def port_holder(path: Path) -> str | None:
        from tsgt.station.serial import serial_port

        return serial_port.port_holder(path)

    def latency_timer_ms(path: Path) -> int | None:
        from tsgt.station.serial import serial_port

        return serial_port.latency_timer_ms(path)

    def open_port(path: Path) -> OpenPort:
        from tsgt.station.serial import serial_port

        async def at(baud: int) -> Port:
            return await serial_port.open_serial_port(path, baud, clock)

        return at

    return Machine(
        clock=clock,
        user=current_user(),
        find_user=find_user,
        group_name=group_name,
        run=run_command,
        which=shutil.which,
        free_bytes=free_bytes,
        port_holder=port_holder,
        latency_timer_ms=latency_timer_ms,
        open_port=open_port,
        open_hal=open_hal,
        client_status=_client_status,
        serves=_serves,
    )


def _client_status(path: Path) -> ClientStatus | None:
    """Ask the client behind a socket; None where nobody serves it."""
    if not _serves(path):
        return None
    from tsgt.cli.status import status_of
    from tsgt.station import ClientStatus

    record, _ = status_of(path)
    return record if isinstance(record, ClientStatus) else None


def _serves(path: Path) -> bool:
    """Whether somebody listens on a UNIX socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except BlockingIOError:  # so many wait there
            return True
        except OSError:
            return False
    return True
