"""The mission of a master for its stations: read from its configuration and key, shown as text and QR code."""

from __future__ import annotations

import io
import re
import sys
from typing import TYPE_CHECKING

import click

from tsgt.cli.setup.options import answer
from tsgt.config import MasterConfig, load
from tsgt.errors import ConfigError
from tsgt.radio.superframe.wire import KEY_BYTES
from tsgt.setup import KEY, MASTER, Mission, MissionError, decode_mission, encode_mission, hand_over_lines

if TYPE_CHECKING:
    from tsgt.cli.setup.session import Session
    from tsgt.config import ModemConfig
    from tsgt.setup import System

_MAX_BYTES = 10_000


def mission_of_master(system: System) -> Mission:
    """Return the mission of the master on a system; raises ConfigError if there is none, or its key cannot be read."""
    config = load(system.path(MASTER.config), MasterConfig)
    return mission_of(config.radio, mission_key(system))


def mission_key(system: System) -> bytes:
    """Return the key on a system; raises ConfigError if there is none that can be read."""
    text = system.read(KEY)
    if text is None:
        raise ConfigError(
            f"{KEY} is missing, or only root may read it: sudo tsgt setup mission", path=system.path(KEY)
        )
    digits = text.strip()
    if re.fullmatch(rf"[0-9A-Fa-f]{{{2 * KEY_BYTES}}}", digits) is None:
        raise ConfigError(f"{KEY}: not a key", path=system.path(KEY))
    return bytes.fromhex(digits)


def mission_of(radio: ModemConfig, key: bytes) -> Mission:
    """Return the mission with the channel of a configuration and a key."""
    return Mission(
        region=radio.region,
        frequency_hz=round(radio.frequency_mhz * 1e6),
        bandwidth_hz=round(radio.bandwidth_khz * 1e3),
        spreading_factor=radio.spreading_factor,
        coding_rate=radio.coding_rate,
        preamble_symbols=radio.preamble_symbols,
        sync_word=radio.sync_word,
        key=key,
    )


def channel_text(mission: Mission) -> str:
    """Return the channel of a mission as text."""
    region = f", {mission.region}" if mission.region else ""
    return f"{mission.frequency_hz / 1e6:g} MHz, SF {mission.spreading_factor}, {mission.bandwidth_hz / 1e3:g} kHz{region}"


def given_mission(session: Session, given: str | None, before: Mission | None) -> Mission:
    """Return the mission that a station takes part in: that of a file or text, or the one of before.

    Raises MissionError for a text that is none.
    """
    text = answer(
        session,
        given,
        "--mission",
        "The mission's text or its file, as the master shows it",
        str,
        None if before is None else "the one of before",
    )
    if before is not None and text == "the one of before":
        return before
    return decode_mission(_content(text))


def _content(given: str) -> str:
    """Return the content of a file, or the given text itself."""
    if re.sub(r"\s", "", given).upper().startswith("TSGT1/"):  # the groups to read out have spaces in it
        return given
    try:
        with open(given, encoding="utf-8", errors="replace") as file:  # noqa: PTH123 (a text may be no path at all)
            return file.read(_MAX_BYTES)
    except (OSError, ValueError):
        raise MissionError(
            f"{given[:60]} is neither a file nor the text of a mission; `sudo tsgt setup mission` on the master shows it"
        ) from None


def show_mission(mission: Mission) -> None:
    """Print the text of a mission for its stations; on a terminal also as QR code, and in groups to read out."""
    text = encode_mission(mission)
    if not sys.stdout.isatty():
        click.echo(text)
        return
    import segno

    drawn = io.StringIO()
    segno.make_qr(text, error="m").terminal(out=drawn, compact=True)
    click.echo(drawn.getvalue())
    click.echo(text)
    click.echo("\nThe same in groups, to read out; spaces do not matter:")
    for line in hand_over_lines(text):
        click.echo(f"  {line}")
    click.echo("""
On each station, with the text, or with a file on a USB stick (sudo tsgt setup mission > mission.txt):
  sudo tsgt setup station --mission mission.txt
It is secret: anybody who has it can take part. Delete the copies.""")
