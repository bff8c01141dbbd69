"""The parts of the setup that a station and a master have in common: before the questions, and after them."""

from __future__ import annotations

import secrets
import time
from contextlib import aclosing
from dataclasses import asdict, replace
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, TypeVar

import click

from tsgt import service
from tsgt.cli import doctor
from tsgt.cli.config import problems_at_start
from tsgt.cli.doctor import LABELS
from tsgt.cli.setup.options import answer
from tsgt.config import Model, SuperframeConfig, WiringConfig, find_problems
from tsgt.doctor import run_checks
from tsgt.errors import RadioError
from tsgt.log import configure_logging
from tsgt.radio import LoRaSettings
from tsgt.radio.planning import DIPOLE_DBI, MIN_POWER_DBM
from tsgt.setup import (
    KEY,
    USER,
    SetupError,
    State,
    Step,
    WiringSearch,
    WriteFile,
    before_restart,
    clock_step,
    compare_configuration,
    configuration_step,
    differing_answers,
    find_radio,
    journal_step,
    key_step,
    of_mission,
    services_step,
    spi_devices,
    spi_step,
    start_step,
    system_step,
    user_step,
    uses_network,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence
    from pathlib import Path

    from tsgt.cli.setup.options import Common
    from tsgt.cli.setup.session import Session
    from tsgt.config import ClientConfig, MasterConfig
    from tsgt.doctor import Finding
    from tsgt.setup import MasterAnswers, Mission, RadioAnswers, StationAnswers

M = TypeVar("M", bound=Model)

_SPI_WAIT_S = 3.0
_SPI_POLL_S = 0.2


def check_system(session: Session) -> None:
    """Check the system, before anything is changed."""
    configure_logging("error")  # the steps say everything
    session.do(system_step(session.system, session.role, dry_run=session.dry_run))


def prepare(session: Session) -> None:
    """Enable SPI, and make the user of the services."""
    system = session.system
    enabled = session.do(spi_step(system))
    if system.live and not session.dry_run:
        until_s = time.monotonic() + _SPI_WAIT_S
        while enabled and not spi_devices(system) and time.monotonic() < until_s:
            time.sleep(_SPI_POLL_S)
        if not spi_devices(system):
            session.fail("spi", "enabled, but there is no /dev/spidev* before the next boot: sudo reboot")
    session.do(user_step(system))


def differing(
    common: Common,
    before: StationAnswers | MasterAnswers | None,
    answers: StationAnswers | MasterAnswers,
    *,
    found: Collection[str] = (),
) -> list[str]:
    """Return the names of the answers that the configuration of before has otherwise; ``found``: not asked for."""
    if before is None:
        return []
    wiring = ("wiring",) if common.search == WiringSearch() else ()
    return differing_answers(before, answers, found=(*found, *wiring))


def configuration_before(session: Session, model: type[M]) -> M | None:
    """Return the configuration that the machine has; None without a valid one."""
    path = session.system.path(session.role.config)
    found = find_problems(path)[0] if path.exists() else None
    return found if isinstance(found, model) else None


def is_running(session: Session) -> bool:
    """Whether the service is running, and so owns radio and instrument."""
    system = session.system
    return system.live and system.run(("systemctl", "is-active", session.role.unit)).code == 0


def radio_of(session: Session, common: Common, mission: Mission, before: RadioAnswers | None) -> RadioAnswers:
    """Return the answers for the radio: the mission's channel, the antenna, and the wiring, by asking the chip."""
    gain_dbi = float(
        answer(
            session,
            common.antenna_gain_dbi,
            "--antenna-gain-dbi",
            "Gain of the antenna in dBi, less the loss of its cable (2.15: a dipole)",
            float,
            DIPOLE_DBI if before is None else before.antenna_gain_dbi,
        )
    )
    settings = LoRaSettings(
        frequency_hz=mission.frequency_hz,
        spreading_factor=mission.spreading_factor,
        bandwidth_hz=mission.bandwidth_hz,
        coding_rate=mission.coding_rate,
        preamble_symbols=mission.preamble_symbols,
        sync_word=mission.sync_word,
        power_dbm=MIN_POWER_DBM,
    )
    wiring = _wiring(session, common, settings, None if before is None else before.wiring)
    radio = of_mission(
        mission, antenna_gain_dbi=gain_dbi, licence=common.licence, power_dbm=None, wiring=wiring
    )
    if before is None:
        return radio
    if _channel(before) == _channel(radio):
        return replace(radio, licence=common.licence or before.licence, power_dbm=before.power_dbm)
    if before.licence is not None and common.licence is None:
        # It would lift the limits of another country.
        session.report(
            "licence",
            ok=True,
            detail=f'the licence "{before.licence}" is for the former channel, and is not kept; --licence states one',
        )
    return radio


def _channel(radio: RadioAnswers) -> tuple[str | None, float, float]:
    """Return what licence and power are valid for."""
    return radio.region, radio.frequency_mhz, radio.bandwidth_khz


def _wiring(
    session: Session, common: Common, settings: LoRaSettings, before: WiringConfig | None
) -> WiringConfig:
    """Return the wiring with which the radio responds; in an image the given one.

    Of a given wiring, what no option names is that of ``before``.
    """
    system, search = session.system, common.search
    wanted = None if before is None else search.applied_to(before)
    if not system.live:
        wiring = wanted or next(search.wirings(["spidev0.0"]))
        session.report("radio", ok=True, detail=f"not asked in an image; {_shown(wiring)}")
        return wiring
    if before is not None and is_running(session):
        if wanted != before:
            session.fail("radio", f"in use by the running service: sudo systemctl stop {session.role.unit}")
        session.report("radio", ok=True, detail=f"in use by the running service; {_shown(before)}")
        return before
    if session.dry_run and not spi_devices(system):
        wiring = next(search.wirings(["spidev0.0"]))
        session.report("radio", ok=True, detail="would be asked when SPI is enabled")
        return wiring
    if before is not None and search != WiringSearch():
        search = search.completed_from(before)
    candidates = [*([] if wanted is None else [wanted]), *search.wirings(spi_devices(system))]
    machine = doctor.this_machine()
    try:
        found = service.run(
            lambda: find_radio(dict.fromkeys(candidates), machine.open_hal, settings, machine.clock)
        )
    except RadioError as error:
        if session.dry_run and candidates:
            session.report("radio", ok=True, detail=f"not found yet ({error})")
            return candidates[0]
        session.fail(
            "radio",
            f"{error}. See docs/how-to/wire-the-radio.md, in a clone or in /usr/share/doc/tsgt",
        )
    session.report("radio", ok=True, detail=f"responds; {_shown(found)}; nothing was transmitted")
    return found


def _shown(wiring: WiringConfig) -> str:
    select = "by the kernel" if wiring.nss_pin < 0 else f"BCM {wiring.nss_pin}"
    return (
        f"spidev{wiring.spi_bus}.{wiring.spi_device}, chip select {select}, DIO0 BCM {wiring.dio0_pin}, "
        f"backend {wiring.backend}"
    )


def configure(
    session: Session,
    common: Common,
    text: str | None,
    *,
    key: bytes | None,
    key_is_used: bool = True,
    contradicted: Sequence[str] = (),
    expected: Collection[str] = (),
) -> None:
    """Install key, configuration and service, check the machine, and start the service.

    ``text``: of the configuration; None keeps the one that is there. ``key``: None keeps the one that is there.
    ``key_is_used``: whether the configuration names the file of the key. ``contradicted``: names of the answers that the
    one that is there has otherwise. ``expected``: checks that fail until the machine is complete, because the instrument is
    still missing.
    """
    system, role = session.system, session.role
    placing_key = (
        key_step(system, key, replace=common.replace_key)
        if key_is_used
        else Step(name="key", detail=f"not used: {role.config} does not name {KEY}")
    )
    if not placing_key.ok:
        session.do(placing_key)
    # Before the key is replaced: with the key of one mission and the channel of another it could talk to neither.
    placing, checked = _configuration(session, common, text, contradicted, new_key=key is not None)
    services = services_step(system, role, network=uses_network(checked))
    session.do(before_restart(system, role, placing_key))
    if not session.dry_run:
        _check(session, checked)
    session.do(before_restart(system, role, placing))
    session.do(before_restart(system, role, services))
    session.do(journal_step(system))
    session.do(clock_step(system, role))
    if session.dry_run:
        return
    _check_machine(session, expected)
    session.do(start_step(system, role))


def keep_configuration(
    session: Session, common: Common, config: ClientConfig | MasterConfig, options: dict[str, object]
) -> None:
    """Set up the rest of a machine that has a configuration of a kind that setup does not write; ``options``: for it."""
    options |= {
        "--antenna-gain-dbi": common.antenna_gain_dbi,
        "--licence": common.licence,
        **{f"--{name.replace('_', '-')}": value for name, value in asdict(common.search).items()},
        "--replace-key": common.replace_key or None,
    }
    given = [name for name, value in options.items() if value is not None]
    if given:
        session.fail(
            "configuration",
            f"{session.role.config} stays, as its instrument, radio or protocol is of a kind that setup does not write: "
            f"{', '.join(given)} would not be in force; edit it, or --replace-config",
        )
    protocol = config.protocol
    key_file = protocol.key_file if isinstance(protocol, SuperframeConfig) else None
    configure(
        session,
        common,
        None,
        key=None,
        key_is_used=key_file is not None and key_file.absolute() == session.system.path(KEY).absolute(),
    )


def _configuration(
    session: Session, common: Common, text: str | None, contradicted: Sequence[str], *, new_key: bool
) -> tuple[Step, str]:
    """Return the step that writes the configuration, or keeps the one of before, and the text that is then in force."""
    system, role = session.system, session.role
    before = system.read(role.config)
    if text is None:
        assert before is not None  # noqa: S101 (our own caller)
        text = before
    compared = compare_configuration(before, text, role.config)
    for line in compared.differences:
        session.say(f"{'':8}{line}")
    replacing, declined = common.replace_config, False
    if compared.differences and session.ask and not replacing and not session.dry_run:
        default = compared.state is State.FROM_SETUP
        replacing = click.confirm(f"Replace {role.config} by these lines (+)?", default=default)
        declined = not replacing
    stays = declined or (compared.state is State.EDITED and not replacing)
    if stays and contradicted:
        session.fail(
            "configuration",
            f"{role.config} stays as it was, with other values than asked for: {', '.join(contradicted)}; --replace-config "
            "replaces it",
        )
    step = configuration_step(system, role, text, replace=replacing)
    if declined:
        step = Step(name="configuration", detail=f"{role.config} stays as it was")
    checked = before if stays and before is not None else text
    if not session.dry_run:
        _check(session, checked, without_key=new_key)
    return step, checked


def _check(session: Session, text: str, *, without_key: bool = False) -> None:
    """Stop the setup if the daemon would not start with a configuration, before that is put into its place."""
    system, role = session.system, session.role
    path = system.path(role.config)
    trial = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.toml")
    user = system.user_id(USER)
    try:
        WriteFile(name=f"{PurePosixPath(role.config).parent}/{trial.name}", text=text).carry_out(system)
        content, problems = find_problems(trial)
        if content is not None:
            owner = user[0] if system.uid == 0 and user is not None else None
            problems = problems_at_start(trial, content, key_owner=owner)
    except SetupError as error:
        session.fail("configuration", str(error))
    finally:
        trial.unlink(missing_ok=True)
    key = system.path(KEY).absolute()
    for problem in problems:
        if not (without_key and problem.path is not None and problem.path.absolute() == key):
            session.fail("configuration", str(problem).replace(str(trial), role.config))


def _check_machine(session: Session, expected: Collection[str]) -> None:
    system, role = session.system, session.role
    if not system.live:
        session.report(
            "doctor", ok=True, detail="not run in an image: sudo tsgt doctor on the machine itself"
        )
        return
    findings = service.run(lambda: _findings(system.path(role.config)))
    session.doctor = {each.name: {"ok": each.ok, "detail": each.detail} for each in findings}
    for each in findings:
        if each.ok is False:
            session.say(f"{'':8}{LABELS[each.outcome]:7} {each.name.replace('_', ' ')}: {each.detail}")
    failed = [each.name for each in findings if each.ok is False]
    serious = [name for name in failed if name not in expected]
    made = sum(each.ok is not None for each in findings)
    if serious:
        session.report(
            "doctor", ok=False, detail=f"failed: {', '.join(serious)}; sudo tsgt doctor repeats it"
        )
    elif failed:
        session.report("doctor", ok=True, detail=f"{made} checks; to be completed: {', '.join(failed)}")
    else:
        session.report("doctor", ok=True, detail=f"all {made} checks passed")


async def _findings(path: Path) -> list[Finding]:
    async with aclosing(run_checks(doctor.this_machine(), path)) as findings:
        return [finding async for finding in findings]
