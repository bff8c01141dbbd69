"""The text of a mission: what it carries, and which damage is detected."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tsgt.setup import Mission, MissionError, decode_mission, encode_mission, hand_over_lines

MISSION = Mission(
    region="EU868",
    frequency_hz=869_850_000,
    bandwidth_hz=250_000,
    spreading_factor=9,
    coding_rate=6,
    preamble_symbols=8,
    sync_word=0x34,
    key=hashlib.sha256(b"a key").digest(),
)
TEXT = encode_mission(MISSION)


@given(key=st.binary(min_size=32, max_size=32), region=st.sampled_from([None, "EU433", "CA915"]))
def test_text_carries_channel_and_key(key: bytes, region: str | None) -> None:
    """Any key; a mission without a region, too."""
    mission = replace(MISSION, key=key, region=region)
    assert decode_mission(encode_mission(mission)) == mission


def test_text_has_the_compact_alphabet_of_qr_codes() -> None:
    """Capitals, digits and the slash."""
    assert set(TEXT) <= set("ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789/")


def test_text_may_be_typed_from_its_groups() -> None:
    """With spaces and line ends, in small letters, and with 0, 1 and 8 for O, I and B."""
    typed = "\n".join(hand_over_lines(TEXT)).lower()
    assert decode_mission(typed) == MISSION
    *fields, key, check = TEXT.split("/")
    confused = key.replace("O", "0").replace("I", "1").replace("B", "8")
    assert confused != key
    assert decode_mission("/".join((*fields, confused, check))) == MISSION


@given(st.data())
def test_every_wrong_character_is_detected(data: st.DataObject) -> None:
    """One at any place, for any other that is not read as the same one."""
    place = data.draw(st.integers(0, len(TEXT) - 1))
    same = {"0": "O", "1": "I", "8": "B"}
    other = data.draw(st.sampled_from("ACDEFGHJKLMNPQRSTUVWXYZ2345679/"))
    damaged = TEXT[:place] + other + TEXT[place + 1 :]
    if damaged != TEXT and same.get(TEXT[place]) != other:
        with pytest.raises(MissionError):
            decode_mission(damaged)


@given(st.integers(0, len(TEXT) - 1))
def test_every_missing_end_is_detected(length: int) -> None:
    """Of a text that was copied in part."""
    with pytest.raises(MissionError):
        decode_mission(TEXT[:length])


def test_messages_say_what_to_do() -> None:
    """The key alone, a part of the text, and a wrong character."""
    for text, told in (
        (MISSION.key.hex(), "begins with TSGT1/"),
        (TEXT[:40], "not complete"),
        (TEXT[:-1] + ("A" if TEXT[-1] != "A" else "C"), "checksum"),
    ):
        with pytest.raises(MissionError, match=told) as caught:
            decode_mission(text)
        assert "sudo tsgt setup mission" in str(caught.value)
