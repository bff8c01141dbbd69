"""All checks of a machine, in an order in which what others depend on comes first."""

from __future__ import annotations

from functools import partial
from inspect import isawaitable
from typing import TYPE_CHECKING

from tsgt.config import ClientConfig, LeicaInstrumentConfig, MasterConfig
from tsgt.doctor import computer, files, radio, serial_line
from tsgt.doctor.finding import Finding, failed, note, ok, skipped
from tsgt.doctor.instrument import RunningDaemon, check_instrument
from tsgt.errors import TsgtError

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable, Iterator, Mapping
    from pathlib import Path

    from tsgt.doctor.machine import Machine

    Findings = Finding | list[Finding]
    Check = Callable[[], Findings | Awaitable[Findings]]


async def examine(machine: Machine, path: Path) -> AsyncGenerator[Finding]:
    """Make all checks; each finding comes as soon as it is there.

    Parameters
    ----------
    machine
        What is looked at.
    path
        Configuration of a client or a master. Where it cannot be used, what needs none is checked nevertheless.
    """
    finding, config = files.check_configuration(path)
    yield finding
    service = None if config is None else computer.service_of(machine, config.kind)
    match config:
        case ClientConfig():
            daemon, finding = _client(machine, config, service)
            yield finding
            checks = _client_checks(machine, path, config, service, daemon)
        case MasterConfig():
            daemon, finding = _master(machine, config, service)
            yield finding
            checks = _master_checks(machine, path, config, service, daemon)
        case None:
            checks = _computer_checks(machine, "client")
    for name, check in checks:
        for finding in await _made(machine, name, check):
            yield finding


def _client(
    machine: Machine, config: ClientConfig, service: Mapping[str, str] | None
) -> tuple[RunningDaemon, Finding]:
    """Ask the client that may run here."""
    try:
        status = machine.client_status(config.status_socket)
    except TsgtError as error:
        return RunningDaemon(runs=True), failed("daemon", f"{error}: sudo systemctl restart tsgt-client")
    if status is None:
        return _unasked(machine, service, "client")
    text = f"a client runs here, {status.measurements} measured; `tsgt status` tells how it does"
    return RunningDaemon(runs=True, status=status), ok("daemon", text)


def _master(
    machine: Machine, config: MasterConfig, service: Mapping[str, str] | None
) -> tuple[RunningDaemon, Finding]:
    """Look for the master that may run here."""
    if machine.serves(config.stream.socket):
        return RunningDaemon(runs=True), ok("daemon", "a master runs here; `tsgt status` tells how it does")
    return _unasked(machine, service, "master")


def _unasked(
    machine: Machine, service: Mapping[str, str] | None, kind: computer.Kind
) -> tuple[RunningDaemon, Finding]:
    """Tell what systemd knows of a daemon that does not answer, perhaps only because this user may not ask it."""
    if service is None or service.get("ActiveState") != "active":
        return RunningDaemon(runs=False), ok("daemon", f"no {kind} runs here now")
    return RunningDaemon(runs=True), note(
        "daemon", f"a {kind} runs here, but does not answer you, {machine.user.name}: sudo tsgt doctor"
    )


def _client_checks(
    machine: Machine,
    path: Path,
    config: ClientConfig,
    service: Mapping[str, str] | None,
    daemon: RunningDaemon,
) -> Iterator[tuple[str, Check]]:
    user = computer.daemon_user(machine, service) or machine.user
    instrument = config.instrument
    if isinstance(instrument, LeicaInstrumentConfig):
        port = instrument.port
        yield "serial_port", partial(serial_line.check_serial_port, machine, port, user)
        yield (
            "serial_port_free",
            partial(serial_line.check_serial_port_free, machine, port, daemon=daemon.runs),
        )
        yield "latency_timer", partial(serial_line.check_latency_timer, machine, port)
    yield "instrument", partial(check_instrument, machine, instrument, daemon)
    yield from _common_checks(machine, path, config, service, daemon)


def _master_checks(
    machine: Machine,
    path: Path,
    config: MasterConfig,
    service: Mapping[str, str] | None,
    daemon: RunningDaemon,
) -> Iterator[tuple[str, Check]]:
    yield "setup", partial(files.check_setup, machine, config)
    yield from _common_checks(machine, path, config, service, daemon)


def _common_checks(
    machine: Machine,
    path: Path,
    config: ClientConfig | MasterConfig,
    service: Mapping[str, str] | None,
    daemon: RunningDaemon,
) -> Iterator[tuple[str, Check]]:
    user = computer.daemon_user(machine, service) or machine.user
    yield "radio_devices", partial(radio.check_radio_devices, machine, config.radio, user)
    yield "radio", partial(radio.check_radio, machine, config.radio, path, daemon=daemon.runs)
    yield "limits", partial(radio.check_limits, config, path)
    yield "key", partial(files.check_key, machine, config.protocol, user)
    yield "disk", partial(files.check_disk, machine, config, user, service)
    yield "user", partial(computer.check_user, machine, service)
    yield "service", partial(computer.check_service, config.kind, path, service)
    yield from _computer_checks(machine, config.kind)


def _computer_checks(machine: Machine, kind: computer.Kind) -> Iterator[tuple[str, Check]]:
    yield "clock_source", partial(computer.check_clock_source, machine)
    yield "ntp", partial(computer.check_ntp, machine, kind)
    yield "boot_id", partial(computer.check_boot_id, machine)


async def _made(machine: Machine, name: str, check: Check) -> list[Finding]:
    """Make a check; whatever goes wrong in it is a finding, so that the others are made as well."""
    try:
        found = check()
        if isawaitable(found):
            found = await found
    except Exception as error:  # noqa: BLE001 (a driver by others raises what it likes)
        return [_in_words(machine, name, error)]
    return [found] if isinstance(found, Finding) else found


def _in_words(machine: Machine, name: str, error: Exception) -> Finding:
    """Say what kept a check from being made."""
    match error:
        case PermissionError():
            where = error.filename or "this"
            return skipped(name, f"you, {machine.user.name}, may not look at {where}: sudo tsgt doctor")
        case TsgtError():
            return failed(name, str(error))
        case OSError():
            return failed(name, f"{error.filename or name}: {error.strerror or error}")
        case ImportError():
            return failed(name, f"{error}: install tsgt again with all that it needs (pip install tsgt)")
    return failed(name, f"this could not be checked ({type(error).__name__}: {error}); please report it")
