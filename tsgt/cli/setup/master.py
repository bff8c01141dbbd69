"""``tsgt setup master``: from the questions to a running master, and the text for its stations."""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING

import click

from tsgt.cli.setup.common import (
    configuration_before,
    configure,
    differing,
    keep_configuration,
    prepare,
    radio_of,
)
from tsgt.cli.setup.mission import channel_text, mission_key, mission_of, mission_of_master, show_mission
from tsgt.cli.setup.options import answer
from tsgt.cli.setup.session import SetupStopped
from tsgt.config import MasterConfig
from tsgt.errors import ConfigError
from tsgt.radio.planning import CHANNELS, REGIONS
from tsgt.radio.superframe.wire import KEY_BYTES
from tsgt.setup import MASTER, MasterAnswers, Mission, master_text

if TYPE_CHECKING:
    from tsgt.cli.setup.options import Common

SPREADING_FACTOR = 9
DEFAULT_STATIONS = 3


def run_master_setup(common: Common, *, region: str | None, stations: int | None) -> int:
    """Set up a master; return the exit code."""
    session = common.session(MASTER)
    made = False
    try:
        prepare(session)
        config = configuration_before(session, MasterConfig)
        before = None if config is None else MasterAnswers.of(config)
        if config is not None and before is None and not common.replace_config:
            keep_configuration(session, common, {"--region": region, "--stations": stations})
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
        try:
            key, made = mission_key(session.system), False
        except ConfigError:
            key, made = secrets.token_bytes(KEY_BYTES), True
        kept = config is not None and before is not None and before.radio.region == chosen_region
        shared = (
            mission_of(config.radio, key) if kept and config is not None else _new_mission(chosen_region, key)
        )
        session.report(
            "mission",
            ok=True,
            detail=f"{channel_text(shared)}; {'a new key' if made else 'the key of before'}",
        )
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
