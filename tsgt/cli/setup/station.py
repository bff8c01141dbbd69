"""``tsgt setup station``: from the questions to a running client."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click
from pydantic import TypeAdapter, ValidationError

from tsgt import service
from tsgt.cli import doctor
from tsgt.cli.setup.common import (
    check_system,
    configuration_before,
    configure,
    differing,
    is_running,
    keep_configuration,
    prepare,
    radio_of,
)
from tsgt.cli.setup.mission import channel_text, given_mission, mission_key, mission_of
from tsgt.cli.setup.options import answer, require_answers
from tsgt.cli.setup.session import SetupStopped
from tsgt.config import ClientConfig, InstrumentPort, TcpAddress
from tsgt.errors import ConfigError
from tsgt.setup import (
    CLIENT,
    DEFAULT_BAUD,
    NO_INSTRUMENT,
    MissionError,
    Ports,
    StationAnswers,
    client_text,
    find_instruments,
)

if TYPE_CHECKING:
    from tsgt.cli.setup.options import Common
    from tsgt.cli.setup.session import Session
    from tsgt.setup import FoundInstrument, Mission

DEFAULT_PRISM_TYPE = "mini_360"
PRISM_TYPES = ("round", "mini", "tape", "360", "mini_360", "mini_zero", "grz121", "mpr122")
"""Reflectors whose constant the instrument knows; any other needs its constant in the configuration."""

_WITHOUT_INSTRUMENT = {"serial_port", "instrument", "latency_timer"}
"""Checks that fail without an instrument."""


def run_station_setup(
    common: Common,
    *,
    station: int | None,
    prism: int | None,
    mission: str | None,
    instrument: str | None,
    prism_type: str | None,
) -> int:
    """Set up a station; return the exit code."""
    session = common.session(CLIENT)
    try:
        check_system(session)
        config = configuration_before(session, ClientConfig)
        before = None if config is None else StationAnswers.of(config)
        known = None if config is None or before is None else _known_mission(session, config)
        if instrument not in (None, "none"):
            _port(instrument)
        staying = config if before is None and not common.replace_config else None
        if staying is None:
            require_answers(
                session,
                {
                    "--station": station or before,
                    "--mission": mission or known,
                    "--prism-type": prism_type or before,
                },
            )
        prepare(session)
        if staying is not None:
            keep_configuration(
                session,
                common,
                staying,
                {
                    "--station": station,
                    "--prism": prism,
                    "--mission": mission,
                    "--instrument": instrument,
                    "--prism-type": prism_type,
                },
            )
            return session.finish()
        shared = _mission(session, mission, known)
        number = answer(
            session,
            station,
            "--station",
            "Number of the station",
            click.IntRange(1, 16),
            _of(before, "station"),
        )
        tracked = prism or (_of(before, "prism") if station in (None, _of(before, "station")) else None)
        tracked = answer(
            session,
            prism,
            "--prism",
            "Number of the prism that it tracks",
            click.IntRange(1, 16),
            tracked or number,
        )
        reflector = answer(
            session,
            prism_type,
            "--prism-type",
            "Reflector on the robot",
            click.Choice(list(dict.fromkeys([*PRISM_TYPES, *([before.prism_type] if before else [])]))),
            _of(before, "prism_type") or (DEFAULT_PRISM_TYPE if session.ask else None),
        )
        radio = radio_of(session, common, shared, None if before is None else before.radio)
        port, baud = _instrument(session, instrument, before)
        answers = StationAnswers(
            station=number,
            prism=tracked,
            port=port,
            baud=baud,
            checksum=before.checksum if before is not None else False,
            prism_type=reflector,
            prism_constant_mm=before.prism_constant_mm if before and before.prism_type == reflector else None,
            radio=radio,
        )
        expected = _WITHOUT_INSTRUMENT if port == NO_INSTRUMENT else ()
        configure(
            session,
            common,
            client_text(answers),
            key=shared.key,
            contradicted=differing(
                common, before, answers, found=("baud", "port") if instrument is None else ("baud",)
            ),
            expected=expected,
        )
    except SetupStopped:
        pass
    return session.finish()


def _of(before: StationAnswers | None, name: str) -> int | str | None:
    return None if before is None else getattr(before, name)


def _known_mission(session: Session, config: ClientConfig) -> Mission | None:
    """Return the mission of a configuration; None without its key."""
    try:
        return mission_of(config.radio, mission_key(session.system))
    except ConfigError:
        return None


def _mission(session: Session, given: str | None, known: Mission | None) -> Mission:
    try:
        shared = given_mission(session, given, known)
    except MissionError as error:
        session.fail("mission", str(error))
    session.report("mission", ok=True, detail=f"{channel_text(shared)}; checksum correct")
    return shared


def _instrument(session: Session, given: str | None, before: StationAnswers | None) -> tuple[str, int]:
    """Return port and baud rate of the instrument; a port of its own stands for one that is not there yet."""
    system = session.system
    if given == "none" or (given is None and not system.live and before is None):
        session.report("instrument", ok=True, detail="none yet: connect it later, and call this again")
        return NO_INSTRUMENT, DEFAULT_BAUD
    # A service that waits for an instrument has none open: it is looked for.
    in_use = before is not None and before.port != NO_INSTRUMENT and is_running(session)
    if before is not None and given in (None, before.port) and (in_use or not system.live):
        session.report("instrument", ok=True, detail=f"{before.port}, as before")
        return before.port, before.baud
    if given is not None and not system.live:
        session.report("instrument", ok=True, detail=f"{given}, not asked in an image")
        return given, DEFAULT_BAUD
    machine = doctor.this_machine()
    ports = [_port(given)] if given is not None else sorted((machine.dev / "serial" / "by-id").glob("*"))
    access = Ports(open_port=machine.open_port, holder=machine.port_holder)
    if ports:
        session.say(f"{'':8}asking for an instrument at {', '.join(map(str, ports))} ...")
    found, silent = service.run(lambda: find_instruments(ports, access, machine.clock))
    for port, reason in silent.items():
        session.say(f"{'':8}{port}: {reason}")
    return _chosen(session, found, silent, given, before)


def _chosen(
    session: Session,
    found: list[FoundInstrument],
    silent: dict[Path | TcpAddress, str],
    given: str | None,
    before: StationAnswers | None,
) -> tuple[str, int]:
    if not found:
        if before is not None and given is None and before.port == NO_INSTRUMENT:
            return _instrument(session, "none", before)
        if before is not None and given is None:
            session.report("instrument", ok=True, detail=f"{before.port} as before; it does not respond now")
            return before.port, before.baud
        if session.ask and click.confirm("No instrument responds. Go on without?", default=False):
            return _instrument(session, "none", before)
        reason = next(iter(silent.values()), "there is no serial adapter in /dev/serial/by-id")
        session.fail("instrument", f"{reason}. To go on without: --instrument none")
    chosen = found[0]
    if len(found) > 1:
        if not session.ask:
            ports = "; ".join(f"{each.port}: {each}" for each in found)
            session.fail(
                "instrument", f"{len(found)} instruments respond, choose one by --instrument: {ports}"
            )
        for number, each in enumerate(found, start=1):
            session.say(f"  {number}  {each.port}: {each}")
        chosen = found[click.prompt("Which one", type=click.IntRange(1, len(found)), default=1) - 1]
    session.report("instrument", ok=True, detail=f"{chosen}, {chosen.port}")
    return str(chosen.port), DEFAULT_BAUD if chosen.baud is None else chosen.baud


def _port(given: str) -> Path | TcpAddress:
    """Return the port that an option names; a usage error for an impossible one."""
    try:
        return TypeAdapter[Path | TcpAddress](InstrumentPort).validate_python(given)
    except ValidationError as error:
        raise click.UsageError(f"--instrument {given}: {error.errors()[0]['msg']}") from error
