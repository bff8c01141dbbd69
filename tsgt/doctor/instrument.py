"""Checks of the instrument: response, licence, battery and level."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tsgt.config import BridgeInstrumentConfig, LeicaInstrumentConfig, TcpAddress
from tsgt.doctor.finding import failed, note, ok, skipped
from tsgt.doctor.serial_line import line_holder
from tsgt.errors import InstrumentError
from tsgt.recording import LOW_BATTERY_PERCENT

if TYPE_CHECKING:
    from tsgt.config import InstrumentConfig
    from tsgt.doctor.finding import Finding
    from tsgt.doctor.machine import Machine
    from tsgt.station import ClientStatus
    from tsgt.station.geocom import GeoComConnection
    from tsgt.station.leica import Identity

LOW_PERCENT = 50  # Minimum on the evening before a day in the field

LEVEL_RAD = math.radians(2 / 60)  # Half of the range of a Leica compensator
_NAMES = ("instrument", "licence", "battery", "level")

_STOP = "the running client has the instrument open: sudo systemctl stop tsgt-client, then tsgt doctor again"

AUTOMATIC = 1  # TMC_INCLINE_PRG: automatic inclination mode (GeoCOM reference manual, TMC_GetAngle1)


@dataclass(frozen=True, slots=True, kw_only=True)
class DaemonState:
    """State of the daemon on this machine, which owns instrument and radio; ``status``: of a client that responds."""

    running: bool
    status: ClientStatus | None = None


async def check_instrument(machine: Machine, config: InstrumentConfig, daemon: DaemonState) -> list[Finding]:
    """Check the instrument, directly or by the status of the running client."""
    if daemon.status is not None:
        return _from_status(daemon.status)
    if daemon.running:
        return [skipped(name, _STOP) for name in _NAMES]
    if isinstance(config, BridgeInstrumentConfig):
        return [check_program(machine, config)]
    return await _ask(machine, config)


def check_program(machine: Machine, config: BridgeInstrumentConfig) -> Finding:
    """Check that the bridge program exists; only the client starts it."""
    program = config.command[0]
    where = machine.which(program)
    if where is None:
        return failed(
            "instrument",
            f"the program {program} does not exist or is not executable: command under [instrument]; chmod +x {program}",
        )
    return ok(
        "instrument",
        f"{where} exists; `tsgt status` shows whether it finds the instrument when the client is running",
    )


def _from_status(status: ClientStatus) -> list[Finding]:
    if status.instrument is None:
        found = [failed("instrument", f"the running client has none: {status.problem or 'no reason given'}")]
    elif status.problem:
        found = [
            failed("instrument", f"{status.instrument}, reported by the running client: {status.problem}")
        ]
    else:
        found = [ok("instrument", f"{status.instrument}, reported by the running client")]
    found.append(_check_battery(status.battery_percent, external=False))
    return [*found, *(skipped(name, _STOP) for name in ("licence", "level"))]


async def _ask(machine: Machine, config: LeicaInstrumentConfig) -> list[Finding]:
    if (reason := _unreachable_reason(machine, config)) is not None:
        return [skipped(name, reason) for name in _NAMES]
    # Imported here: a master, and a client with another instrument, need none of it.
    from tsgt.station.geocom import connect  # noqa: PLC0415
    from tsgt.station.leica import identify  # noqa: PLC0415

    try:
        connection = await connect(
            machine.open_port(config.port), config.baud, machine.clock, checksum=config.checksum
        )
    except InstrumentError as error:
        return [failed("instrument", str(error)), *_without_response(1)]
    found: list[Finding] = []
    try:
        identity = await identify(connection)
        found += [
            check_identity(identity, config, connection.port.baud),
            _check_licence(identity),
            _check_battery(identity.battery_percent, external=bool(identity.external_power)),
        ]
        found.append(await _level(connection))
    except InstrumentError as error:
        found.append(failed(_NAMES[len(found)], str(error)))
    finally:
        await connection.close()
    return [*found, *_without_response(len(found))]


def _without_response(number: int) -> list[Finding]:
    """Return skipped checks from a number on."""
    return [skipped(name, "the instrument does not respond") for name in _NAMES[number:]]


def _unreachable_reason(machine: Machine, config: LeicaInstrumentConfig) -> str | None:
    """Return the reason why the line cannot be opened, if a check of the line has reported it already."""
    if isinstance(config.port, TcpAddress):
        return None
    if not config.port.exists():
        return "the serial device does not exist"
    if not machine.user.may_use(config.port.resolve()):
        return f"the user {machine.user.name} may not use the line: sudo tsgt doctor"
    if holder := line_holder(machine, config.port):
        return f"the line is open in {holder}"
    return None


def check_identity(identity: Identity, config: LeicaInstrumentConfig, baud: int | None) -> Finding:
    """Check model and capabilities of the instrument."""
    text = (
        f"{identity.model or 'nameless'}, number {identity.serial_number or 'unknown'}, "
        f"firmware {identity.firmware or 'unknown'}"
    )
    if not identity.atr:
        return failed(
            "instrument",
            f"{text}: without automatic target recognition (ATR) it cannot track a prism; use another instrument",
        )
    if baud is None:
        return ok("instrument", f"{text}, responds at {config.port}")
    if baud != config.baud:
        return note(
            "instrument",
            f"{text}, responds at {baud} baud, not at {config.baud}; the search takes time at each start: set the "
            f"instrument to {config.baud}, or baud = {baud}",
        )
    return ok("instrument", f"{text}, responds at {baud} baud")


def _check_licence(identity: Identity) -> Finding:
    if identity.robotic is None:
        return skipped("licence", "the licence GeoCOM Robotic is only checked by a search")
    if not identity.robotic:
        return failed(
            "licence",
            "the licence GeoCOM Robotic is missing: the instrument does not search or lock onto a prism by command; buy it "
            "from a dealer, and lock on by hand meanwhile",
        )
    return ok("licence", "the licence GeoCOM Robotic is present")


def _check_battery(percent: int | None, *, external: bool) -> Finding:
    if percent is None:
        return skipped("battery", "the instrument does not report it")
    text = f"{percent} %"
    if external:
        return ok("battery", f"on external power; internal battery {text}")
    if percent < LOW_BATTERY_PERCENT:
        return failed("battery", f"{text}: change the instrument's battery")
    if percent < LOW_PERCENT:
        return note("battery", f"{text}: not enough for a day; charge it, or bring another one")
    return ok("battery", text)


async def _level(connection: GeoComConnection) -> Finding:
    """Read the compensator; the instrument needs to be level only where it will measure."""
    from tsgt.station.geocom import (  # noqa: PLC0415 (as above)
        Outcome,
        Rpc,
        name_of,
        outcome_of,
    )
    from tsgt.station.leica import numeric_values  # noqa: PLC0415 (as above)

    reply = await connection.call(Rpc.TMC_GET_ANGLE1, AUTOMATIC)
    values = numeric_values(reply, 6)
    if outcome_of(reply.code, has_values=values is not None) is Outcome.TILT:
        return note("level", "not level, or the compensator is off: level it where it will measure")
    if values is None:
        return skipped("level", f"the instrument does not report it (code {name_of(reply.code)})")
    tilt_rad = math.hypot(*values[4:6])
    text = f"{60 * math.degrees(tilt_rad):.1f}' off the plumb line"
    if tilt_rad > LEVEL_RAD:
        return note("level", f"{text}, near the limit of its compensator: level it")
    return ok("level", text)
