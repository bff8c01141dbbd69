"""All checks of a machine, in the order of their dependencies."""

from __future__ import annotations

from functools import partial
from inspect import isawaitable
from typing import TYPE_CHECKING

from tsgt.config import ClientConfig, LeicaInstrumentConfig, MasterConfig, TcpAddress
from tsgt.doctor import computer, files, radio, serial_line
from tsgt.doctor.finding import Finding, failed, note, ok, skipped
from tsgt.doctor.imu import check_imu
from tsgt.doctor.instrument import DaemonState, check_instrument
from tsgt.doctor.odometry import check_odometry
from tsgt.doctor.outgoing import check_alarms, check_geofence_commands, check_instrument_network
from tsgt.errors import TsgtError

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable, Iterator, Mapping
    from pathlib import Path

    from tsgt.doctor.machine import Machine

    Findings = Finding | list[Finding]
    Check = Callable[[], Findings | Awaitable[Findings]]


async def run_checks(machine: Machine, path: Path) -> AsyncGenerator[Finding]:
    """Run all checks, yielding each finding at once; with an invalid configuration only the checks that need none."""
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
) -> tuple[DaemonState, Finding]:
    """Request the status of a client on this machine."""
    try:
        status = machine.client_status(config.status_socket)
    except TsgtError as error:
        return DaemonState(running=True), failed("daemon", f"{error}: sudo systemctl restart tsgt-client")
    if status is None:
        return _without_response(machine, service, "client")
    text = f"a client is running, {status.measurements} measured; `tsgt status` shows its status"
    return DaemonState(running=True, status=status), ok("daemon", text)


def _master(
    machine: Machine, config: MasterConfig, service: Mapping[str, str] | None
) -> tuple[DaemonState, Finding]:
    """Look for a running master."""
    if machine.serves(config.stream.socket):
        return DaemonState(running=True), ok("daemon", "a master is running; `tsgt status` shows its status")
    return _without_response(machine, service, "master")


def _without_response(
    machine: Machine, service: Mapping[str, str] | None, kind: computer.Kind
) -> tuple[DaemonState, Finding]:
    """Return the state that systemd reports of a daemon whose socket does not respond, perhaps for lack of permission."""
    if service is None or service.get("ActiveState") != "active":
        return DaemonState(running=False), ok("daemon", f"no {kind} is running")
    return DaemonState(running=True), note(
        "daemon",
        f"a {kind} is running, but does not respond to the user {machine.user.name}: sudo tsgt doctor",
    )


def _client_checks(
    machine: Machine, path: Path, config: ClientConfig, service: Mapping[str, str] | None, daemon: DaemonState
) -> Iterator[tuple[str, Check]]:
    user = computer.daemon_user(machine, service) or machine.user
    instrument = config.instrument
    if isinstance(instrument, LeicaInstrumentConfig):
        port = instrument.port
        if isinstance(port, TcpAddress):
            yield "instrument_network", partial(check_instrument_network, port, service)
        else:
            yield "serial_port", partial(serial_line.check_serial_port, machine, port, user)
            yield (
                "serial_port_free",
                partial(serial_line.check_serial_port_free, machine, port, daemon=daemon.running),
            )
            yield "latency_timer", partial(serial_line.check_latency_timer, machine, port)
    yield "instrument", partial(check_instrument, machine, instrument, daemon)
    yield from _common_checks(machine, path, config, service, daemon)


def _master_checks(
    machine: Machine, path: Path, config: MasterConfig, service: Mapping[str, str] | None, daemon: DaemonState
) -> Iterator[tuple[str, Check]]:
    yield "setup", partial(files.check_setup, machine, config)
    yield "imu", partial(check_imu, machine, config.imu, daemon=daemon.running)
    yield "odometry", partial(check_odometry, machine, config.odometry, daemon=daemon.running)
    yield "geofence_command", partial(check_geofence_commands, machine, config.geofences, service)
    yield "alarms", partial(check_alarms, machine, config.alarms, service)
    yield from _common_checks(machine, path, config, service, daemon)


def _common_checks(
    machine: Machine,
    path: Path,
    config: ClientConfig | MasterConfig,
    service: Mapping[str, str] | None,
    daemon: DaemonState,
) -> Iterator[tuple[str, Check]]:
    user = computer.daemon_user(machine, service) or machine.user
    yield "radio_devices", partial(radio.check_radio_devices, machine, config.radio, user)
    yield "radio", partial(radio.check_radio, machine, config.radio, path, daemon=daemon.running)
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
    """Run a check; an error becomes a finding, so that the other checks run as well."""
    try:
        found = check()
        if isawaitable(found):
            found = await found
    except Exception as error:  # noqa: BLE001 (a third-party driver may raise anything)
        return [_as_finding(machine, name, error)]
    return [found] if isinstance(found, Finding) else found


def _as_finding(machine: Machine, name: str, error: Exception) -> Finding:
    """Return the error of a check as a finding."""
    match error:
        case PermissionError():
            where = error.filename or "this"
            return skipped(name, f"the user {machine.user.name} may not read {where}: sudo tsgt doctor")
        case TsgtError():
            return failed(name, str(error))
        case OSError():
            return failed(name, f"{error.filename or name}: {error.strerror or error}")
        case ImportError():
            return failed(name, f"{error}: install tsgt again with its dependencies (pip install tsgt)")
    return failed(name, f"the check failed to run ({type(error).__name__}: {error}); please report it")
