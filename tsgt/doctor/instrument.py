"""Checks of the instrument: whether it answers, and is licensed, charged and level."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tsgt.config import BridgeInstrumentConfig, LeicaInstrumentConfig
from tsgt.doctor.finding import failed, note, ok, skipped
from tsgt.doctor.serial_line import line_holder
from tsgt.errors import InstrumentError

if TYPE_CHECKING:
    from tsgt.config import InstrumentConfig
    from tsgt.doctor.finding import Finding
    from tsgt.doctor.machine import Machine
    from tsgt.station import ClientStatus
    from tsgt.station.geocom import GeoComConnection
    from tsgt.station.leica import Identity

LOW_PERCENT = 50
"""For the evening before: a day takes more."""

EMPTY_PERCENT = 20

LEVEL_RAD = math.radians(2 / 60)
"""Half of what the compensator of a Leica corrects."""

_NAMES = ("instrument", "licence", "battery", "level")

_STOP = (
    "the client that runs here has the instrument: sudo systemctl stop tsgt-client, then tsgt doctor again"
)

AUTOMATIC = 1
"""TMC_INCLINE_PRG: measured inclination where it is needed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunningDaemon:
    """The daemon of this machine, as far as it runs.

    Attributes
    ----------
    runs
        Whether it does, and so has instrument and radio.
    status
        What a client says of itself; None where it was not asked, or does not answer.
    """

    runs: bool
    status: ClientStatus | None = None


async def check_instrument(
    machine: Machine, config: InstrumentConfig, daemon: RunningDaemon
) -> list[Finding]:
    """Tell how the instrument does: by itself, or as the client that has it says.

    Parameters
    ----------
    machine
        Opens the line.
    config
        What stands under ``[instrument]``.
    daemon
        Has the line, if it runs.
    """
    if daemon.status is not None:
        return _as_the_client_says(daemon.status)
    if daemon.runs:
        return [skipped(name, _STOP) for name in _NAMES]
    if isinstance(config, BridgeInstrumentConfig):
        return [check_program(machine, config)]
    return await _ask(machine, config)


def check_program(machine: Machine, config: BridgeInstrumentConfig) -> Finding:
    """Tell whether the program that knows the instrument is there; only the client starts it."""
    program = config.command[0]
    where = machine.which(program)
    if where is None:
        return failed(
            "instrument",
            f"there is no program {program}, or it is not executable: command under [instrument]; chmod +x {program}",
        )
    return ok(
        "instrument",
        f"{where} is there; whether it finds the instrument is seen when the client runs: tsgt status",
    )


def _as_the_client_says(status: ClientStatus) -> list[Finding]:
    if status.instrument is None:
        found = [
            failed(
                "instrument", f"the client that runs here has none: {status.problem or 'it does not say why'}"
            )
        ]
    elif status.problem:
        found = [
            failed("instrument", f"{status.instrument}, says the client that runs here: {status.problem}")
        ]
    else:
        found = [ok("instrument", f"{status.instrument}, says the client that runs here")]
    found.append(_judge_battery(status.battery_percent, external=False))
    return [*found, *(skipped(name, _STOP) for name in ("licence", "level"))]


async def _ask(machine: Machine, config: LeicaInstrumentConfig) -> list[Finding]:
    if (reason := _out_of_reach(machine, config)) is not None:
        return [skipped(name, reason) for name in _NAMES]
    # Only here: a master, and a client with another instrument, need none of it.
    from tsgt.station.geocom import connect  # noqa: PLC0415
    from tsgt.station.leica import identify  # noqa: PLC0415

    try:
        connection = await connect(
            machine.open_port(config.port), config.baud, machine.clock, checksum=config.checksum
        )
    except InstrumentError as error:
        return [failed("instrument", str(error)), *_unanswered(1)]
    found: list[Finding] = []
    try:
        identity = await identify(connection)
        found += [
            judge_identity(identity, config, connection.port.baud),
            _judge_licence(identity),
            _judge_battery(identity.battery_percent, external=bool(identity.external_power)),
        ]
        found.append(await _level(connection))
    except InstrumentError as error:
        found.append(failed(_NAMES[len(found)], str(error)))
    finally:
        await connection.close()
    return [*found, *_unanswered(len(found))]


def _unanswered(number: int) -> list[Finding]:
    """Return findings for all checks from a number on."""
    return [skipped(name, "the instrument does not answer") for name in _NAMES[number:]]


def _out_of_reach(machine: Machine, config: LeicaInstrumentConfig) -> str | None:
    """Say why the line cannot be opened, as far as that has been said by the checks of the line already."""
    if not config.port.exists():
        return "there is no line to it"
    if not machine.user.may_use(config.port.resolve()):
        return f"you, {machine.user.name}, may not use the line: sudo tsgt doctor asks it"
    if holder := line_holder(machine, config.port):
        return f"the line is open in {holder}"
    return None


def judge_identity(identity: Identity, config: LeicaInstrumentConfig, baud: int) -> Finding:
    """Tell who answers, and whether it can do what is needed of it."""
    text = (
        f"{identity.model or 'nameless'}, number {identity.serial_number or 'unknown'}, "
        f"firmware {identity.firmware or 'unknown'}"
    )
    if not identity.atr:
        return failed(
            "instrument",
            f"{text}: it has no target recognition (ATR), and cannot follow a prism; take another one",
        )
    if baud != config.baud:
        return note(
            "instrument",
            f"{text}, answers at {baud} baud, not at {config.baud}; finding that out takes time at each start: set the "
            f"instrument to {config.baud}, or baud = {baud}",
        )
    return ok("instrument", f"{text}, answers at {baud} baud")


def _judge_licence(identity: Identity) -> Finding:
    if identity.robotic is None:
        return skipped(
            "licence", "whether it has the licence GeoCOM Robotic is seen when it is to search a prism"
        )
    if not identity.robotic:
        return failed(
            "licence",
            "the licence GeoCOM Robotic is missing: it will not search or lock onto a prism by itself; a dealer sells it, "
            "and a person can lock it on by its keys meanwhile",
        )
    return ok("licence", "it has the licence GeoCOM Robotic")


def _judge_battery(percent: int | None, *, external: bool) -> Finding:
    if percent is None:
        return skipped("battery", "the instrument does not say")
    text = f"{percent} %"
    if external:
        return ok("battery", f"on external power; its own battery has {text}")
    if percent < EMPTY_PERCENT:
        return failed("battery", f"{text}: change the instrument's battery")
    if percent < LOW_PERCENT:
        return note("battery", f"{text}: not enough for a day; charge it, or take another one along")
    return ok("battery", text)


async def _level(connection: GeoComConnection) -> Finding:
    """Read the compensator; only an instrument that stands where it will measure needs to be level."""
    from tsgt.station.geocom import (  # noqa: PLC0415 (as above)
        Rpc,
        Verdict,
        name_of,
        verdict,
    )
    from tsgt.station.leica import numbers  # noqa: PLC0415 (as above)

    reply = await connection.call(Rpc.TMC_GET_ANGLE1, AUTOMATIC)
    values = numbers(reply, 6)
    if verdict(reply.code, has_values=values is not None) is Verdict.TILT:
        return note("level", "it is not level, or its compensator is off: level it where it is to measure")
    if values is None:
        return skipped("level", f"the instrument does not say (code {name_of(reply.code)})")
    tilt_rad = math.hypot(*values[4:6])
    text = f"{60 * math.degrees(tilt_rad):.1f}' off the plumb line"
    if tilt_rad > LEVEL_RAD:
        return note("level", f"{text}, near the end of what its compensator corrects: level it")
    return ok("level", text)
