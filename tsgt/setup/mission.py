"""The text that takes a mission's channel and key from the master to its stations, as a file, a QR code, or typed. Sans-I/O.

All radios of a mission need the same modem settings and the same key; a station that gets them in one piece cannot have
one of them wrong. The text has capitals, digits and ``/``, the compact alphabet of QR codes, and ends with a checksum.
"""

from __future__ import annotations

import base64
import hashlib
import re
from dataclasses import dataclass
from typing import Final

from tsgt.errors import TsgtError
from tsgt.radio.superframe.wire import KEY_BYTES

_TAG: Final = "TSGT1"
_FIELDS: Final = 10
_CHECK_CHARACTERS: Final = 6
_LINE_GROUPS: Final = 6
_NO_REGION: Final = "NONE"
_MISREAD: Final = str.maketrans("018", "OIB")
"""Digits that base 32 does not have, for letters that look like them."""

_HELP: Final = "`sudo tsgt setup mission` on the master shows it again"


class MissionError(TsgtError):
    """A text that is no mission's, or was damaged on the way."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mission:
    """What all radios of a mission share."""

    region: str | None
    frequency_hz: int
    bandwidth_hz: int
    spreading_factor: int
    coding_rate: int
    preamble_symbols: int
    sync_word: int
    key: bytes


def encode_mission(mission: Mission) -> str:
    """Return the text of a mission, one line without spaces."""
    key = base64.b32encode(mission.key).decode("ascii").rstrip("=")
    numbers = (
        mission.frequency_hz,
        mission.bandwidth_hz,
        mission.spreading_factor,
        mission.coding_rate,
        mission.preamble_symbols,
        mission.sync_word,
    )
    body = "/".join((_TAG, mission.region or _NO_REGION, *map(str, numbers), key))
    return f"{body}/{_check_sum(body)}"


def decode_mission(text: str) -> Mission:
    """Return the mission of a text; spaces, line ends and capitals do not matter. Raises MissionError with what is wrong."""
    clean = re.sub(r"\s", "", text).upper()
    parts = clean.split("/")
    if parts[0] != _TAG:
        raise MissionError(
            f"this is not the text of a mission, which begins with {_TAG}/: {_HELP}; a key file alone is not enough, as the "
            "radios also need the same channel"
        )
    if len(parts) != _FIELDS:
        raise MissionError(
            f"the text of the mission is not complete: {len(parts)} of {_FIELDS} parts between slashes. Copy all of it; {_HELP}"
        )
    *fields, key_text, check = parts
    key_text, check = key_text.translate(_MISREAD), check.translate(_MISREAD)
    body = "/".join((*fields, key_text))
    if check != _check_sum(body):
        raise MissionError(
            f"the checksum of the mission's text does not fit: a character is wrong or missing. Scan or copy it again; {_HELP}"
        )
    try:
        key = base64.b32decode(key_text + "=" * (-len(key_text) % 8))
        frequency_hz, bandwidth_hz, spreading_factor, coding_rate, preamble, sync_word = map(int, fields[2:])
    except ValueError as error:
        raise MissionError(f"the text of the mission has impossible parts ({error}); {_HELP}") from error
    if len(key) != KEY_BYTES:
        raise MissionError(
            f"the key in the text of the mission has {len(key)} bytes, not {KEY_BYTES}; {_HELP}"
        )
    return Mission(
        region=None if fields[1] == _NO_REGION else fields[1],
        frequency_hz=frequency_hz,
        bandwidth_hz=bandwidth_hz,
        spreading_factor=spreading_factor,
        coding_rate=coding_rate,
        preamble_symbols=preamble,
        sync_word=sync_word,
        key=key,
    )


def hand_over_lines(text: str) -> list[str]:
    """Return the text of a mission in groups of four characters, to be read out or typed."""
    groups = [text[first : first + 4] for first in range(0, len(text), 4)]
    return [" ".join(groups[first : first + _LINE_GROUPS]) for first in range(0, len(groups), _LINE_GROUPS)]


def _check_sum(body: str) -> str:
    digest = hashlib.sha256(body.encode("ascii", "replace")).digest()
    return base64.b32encode(digest).decode("ascii")[:_CHECK_CHARACTERS]
