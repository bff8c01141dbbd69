"""``tsgt setup master``: from the questions to a running master, and the text for its stations."""

from __future__ import annotations

import secrets
from enum import StrEnum
from typing import TYPE_CHECKING

import click

from tsgt.cli.setup.common import (
    check_system,
    configuration_before,
    configure,
    differing,
    keep_configuration,
    prepare,
    radio_of,
)
from tsgt.cli.setup.mission import channel_text, mission_key, mission_of, mission_of_master, show_mission
from tsgt.cli.setup.options import answer, require_answers
from tsgt.cli.setup.session import SetupStopped
from tsgt.config import MasterConfig
from tsgt.errors import ConfigError
from tsgt.radio.planning import CHANNELS, REGIONS
from tsgt.radio.superframe.wire import KEY_BYTES
from tsgt.setup import MASTER, MasterAnswers, Mission, master_text

if TYPE_CHECKING:
    from tsgt.cli.setup.options import Common
    from tsgt.setup import System

SPREADING_FACTOR = 9
DEFAULT_STATIONS = 3


def run_master_setup(common: Common, *, region: str | None, stations: int | None) -> int:
    """Set up a master; return the exit code."""
    session = common.session(MASTER)
    made = False
    try:
        check_system(session)
        config = configuration_before(session, MasterConfig)
        before = None if config is None else MasterAnswers.of(config)
        staying = config if before is None and not common.replace_config else None
        if staying is None:
            known_region = region or (before and before.radio.region)
            require_answers(session, {"--region": known_region, "--stations": stations or before})
        prepare(session)
        if staying is not None:
            keep_configuration(session, common, staying, {"--region": region, "--stations": stations})
            return session.finish()
        chosen_region = answer(
            session,
            region,
            "--region",
            "Region whose law applies",
            click.Choice(list(REGIONS)),
            before and before.radio.region,
        )
        count = answer(
            session,
            stations,
            "--stations",
            "Number of stations",
            click.IntRange(1, 16),
            before.stations if before is not None else DEFAULT_STATIONS if session.ask else None,
        )
        key, source = _key(session.system, replace=common.replace_key)
        kept = config is not None and before is not None and before.radio.region == chosen_region
        shared = (
            mission_of(config.radio, key) if kept and config is not None else _new_mission(chosen_region, key)
        )
        session.report(
            "mission",
            ok=True,
            detail=f"{channel_text(shared)}; {source}",
        )
        made = source is not KeySource.BEFORE
        radio = radio_of(session, common, shared, None if before is None else before.radio)
        answers = MasterAnswers(stations=count, radio=radio)
        configure(
            session, common, master_text(answers), key=key, contradicted=differing(common, before, answers)
        )
    except SetupStopped:
        pass
    code = session.finish()
    if code == 0 and not session.dry_run:
        if made or (session.ask and click.confirm("Show the text for the stations again?", default=False)):
            if not session.quiet:
                show_mission(mission_of_master(session.system))
        else:
            session.say("The text for the stations: sudo tsgt setup mission")
    return code


class KeySource(StrEnum):
    """Where the key of a master's mission comes from."""

    BEFORE = "the key of before"
    FIRST = "a new key"
    REPLACED = "a new key instead of the one of before: all stations need the new text, and --replace-key"


def _key(system: System, *, replace: bool) -> tuple[bytes, KeySource]:
    """Return the key of the machine; a new one if there is none, or if it is to be replaced."""
    try:
        before = mission_key(system)
    except ConfigError:
        return secrets.token_bytes(KEY_BYTES), KeySource.FIRST
    if replace:
        return secrets.token_bytes(KEY_BYTES), KeySource.REPLACED
    return before, KeySource.BEFORE


def _new_mission(region: str, key: bytes) -> Mission:
    """Return a mission on the channel of its region, with the modem settings of the paper."""
    channel = CHANNELS[region]
    return Mission(
        region=region,
        frequency_hz=channel.frequency_hz,
        bandwidth_hz=channel.bandwidth_hz,
        spreading_factor=SPREADING_FACTOR,
        coding_rate=6,
        preamble_symbols=8,
        sync_word=0x34,
        key=key,
    )
