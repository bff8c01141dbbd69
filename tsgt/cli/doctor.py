"""The command ``doctor``: checks whether this machine is ready for the field."""

from __future__ import annotations

import shutil
import socket
from contextlib import aclosing
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tsgt import service
from tsgt.cli.composition import instrument_line
from tsgt.cli.options import json_option, path_type
from tsgt.cli.output import CHECK_FAILED, print_json
from tsgt.clock import SystemClock
from tsgt.doctor import (
    Finding,
    Machine,
    Outcome,
    current_user,
    find_user,
    free_bytes,
    group_name,
    reach_server,
    run_checks,
    run_command,
)
from tsgt.log import configure_logging
from tsgt.radio.sx127x import open_hal

if TYPE_CHECKING:
    from tsgt.station import ClientStatus

DEFAULT_CONFIGS = (Path("/etc/tsgt/client.toml"), Path("/etc/tsgt/master.toml"))

LABELS = {Outcome.OK: "ok", Outcome.NOTE: "note", Outcome.FAILED: "FAILED", Outcome.SKIPPED: "skipped"}


@click.command()
@click.argument("config", type=path_type, required=False)
@json_option
def doctor(*, config: Path | None, as_json: bool) -> int:
    """Check that this machine is ready for the field.

    CONFIG is the configuration of a client or a master; default: /etc/tsgt/client.toml or /etc/tsgt/master.toml. What
    a running daemon uses is left alone. Nothing is changed and nothing is transmitted. With sudo more can be checked.

    Exit code 3: a check failed. Notes and skipped checks do not fail.
    """
    configure_logging("error")  # the findings say everything
    path = config or _default_config()
    findings = service.run(lambda: _report(this_machine(), path, quiet=as_json))
    failures = [finding.name for finding in findings if finding.ok is False]
    if as_json:
        checks = {
            finding.name: {"ok": finding.ok, "outcome": str(finding.outcome), "detail": finding.detail}
            for finding in findings
        }
        print_json({"config": str(path), "ok": not failures, "checks": checks})
    else:
        made = sum(finding.ok is not None for finding in findings)
        click.echo(f"{len(failures)} of {made} checks failed" if failures else f"all {made} checks passed")
    return CHECK_FAILED if failures else 0


async def _report(machine: Machine, path: Path, *, quiet: bool) -> list[Finding]:
    found = []
    async with aclosing(run_checks(machine, path)) as findings:
        async for finding in findings:
            found.append(finding)
            if not quiet:
                failed = finding.ok is False
                label = click.style(f"{LABELS[finding.outcome]:7}", bold=failed, reverse=failed)
                click.echo(f"{label} {finding.name.replace('_', ' '):17}{finding.detail}")
    return found


def _default_config() -> Path:
    existing = [path for path in DEFAULT_CONFIGS if path.exists()]
    if len(existing) > 1:
        raise click.UsageError(f"{' and '.join(map(str, existing))} exist; give the one to check")
    return existing[0] if existing else DEFAULT_CONFIGS[0]


def this_machine() -> Machine:
    """Return the machine that this program runs on."""
    clock = SystemClock()

    def port_holder(path: Path) -> str | None:
        from tsgt.station.serial import serial_port

        return serial_port.port_holder(path)

    def latency_timer_ms(path: Path) -> int | None:
        from tsgt.station.serial import serial_port

        return serial_port.latency_timer_ms(path)

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
        open_port=lambda port: instrument_line(port, clock),
        open_hal=open_hal,
        client_status=_client_status,
        serves=_is_served,
        reach=reach_server,
    )


def _client_status(path: Path) -> ClientStatus | None:
    """Request the status of a client; None if its socket is not served."""
    if not _is_served(path):
        return None
    from tsgt.cli.live.status import status_of
    from tsgt.station import ClientStatus

    record = status_of(path).record
    return record if isinstance(record, ClientStatus) else None


def _is_served(path: Path) -> bool:
    """Whether a process listens on a UNIX socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except BlockingIOError:  # its queue of connections is full
            return True
        except OSError:
            return False
    return True
