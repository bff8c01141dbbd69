"""Conformance points 12, 15 and 16 (channel) of docs/explanation/simulated-radio.md; those of the chip are in test_chip_conformance*.py."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from harness.radio.air import SYMBOL_NS, Scene, frame, listening, modulation

from tsgt.simulation.lora import LinkModel
from tsgt.simulation.lora.link import FixedLoss

if TYPE_CHECKING:
    from tsgt.simulation.lora.frames import Modulation

# The paper's frame: preamble to 12.25 symbols, header to 20.25, payload to 68.25.
LATE_PAYLOAD = 40


def outcomes_when_sent_as(sent: Modulation, receiver: Modulation) -> list[str]:
    """Send one frame to a receiver; return the outcomes."""
    scene = Scene()
    scene.rx.listen(listening(modulation=receiver))
    scene.send(frame(modulation=sent))
    return scene.finish()


def test_conformance_12_match_is_received() -> None:
    """With equal settings the frame is received."""
    assert outcomes_when_sent_as(modulation(), modulation()) == ["received"]


@pytest.mark.parametrize(
    "changes",
    [
        {"spreading_factor": 8},
        {"spreading_factor": 10},
        {"bandwidth_hz": 125_000},
        {"bandwidth_hz": 500_000},
        {"inverted_iq": True},
        {"sync_word": 0x12},
        {"sync_word": 0x35},
        {"explicit_header": False},
        {"frequency_hz": 905e6 + 62_600},
        {"frequency_hz": 905e6 - 62_600},
    ],
    ids=str,
)
def test_conformance_12_mismatch_is_not_received(changes: dict[str, Any]) -> None:
    """With one different setting the frame is not detected, in either direction."""
    assert outcomes_when_sent_as(modulation(), modulation(**changes)) == []
    assert outcomes_when_sent_as(modulation(**changes), modulation()) == []


@pytest.mark.parametrize("low_data_rate", [False, True])
def test_conformance_12_low_data_rate_mismatch_is_not_received(*, low_data_rate: bool) -> None:
    """The header is received and the payload is damaged."""
    sent = modulation(low_data_rate=low_data_rate)
    receiver = modulation(low_data_rate=not low_data_rate)
    assert outcomes_when_sent_as(sent, receiver) == ["damaged"]


@pytest.mark.parametrize("offset_hz", [-62_400, 62_400])
def test_conformance_12_quarter_of_the_bandwidth_is_tolerated(offset_hz: float) -> None:
    """Carriers may differ by a quarter of the bandwidth."""
    assert outcomes_when_sent_as(modulation(frequency_hz=905e6 + offset_hz), modulation()) == ["received"]


def test_conformance_12_stopped_receiver_receives_nothing() -> None:
    """A radio that does not listen gets no events."""
    scene = Scene()
    scene.rx.listen(listening())
    scene.rx.listen(None)
    scene.send(frame())
    scene.finish()
    assert scene.listener.events == []


def test_conformance_12_own_frame_is_not_received() -> None:
    """A radio does not receive itself."""
    scene = Scene()
    scene.rx.listen(listening())
    scene.rx.transmit(frame())
    scene.finish()
    assert scene.listener.events == []


@pytest.mark.parametrize(("late_symbols", "outcomes"), [(2.9, ["received"]), (3.1, [])])
def test_conformance_15_five_preamble_symbols_are_needed(late_symbols: float, outcomes: list[str]) -> None:
    """A receiver that starts with less than five of eight preamble symbols left misses the frame."""
    scene = Scene()
    scene.send(frame())
    scene.at(late_symbols)
    scene.rx.listen(listening(late_symbols))
    assert scene.finish() == outcomes


def overlap(*sent: tuple[float, float], **changes: Any) -> tuple[list[str], list[bytes]]:
    """Send frames, each with its start in symbols and its power relative to the first; payloads identify the sender.

    Returns the outcomes, and the payloads received intact.
    """
    losses_db = {(f"tx{number}", "rx"): 80.0 - above_db for number, (_, above_db) in enumerate(sent)}
    scene = Scene(LinkModel(path_loss=FixedLoss(pairs_db=losses_db)))
    scene.rx.listen(listening())
    for number, (start, _) in sorted(enumerate(sent), key=lambda item: item[1][0]):
        settings = changes if number else {}
        scene.send(frame(start, payload=bytes([number]) * 34, **settings), f"tx{number}")
    outcomes = scene.finish()
    return outcomes, [reception.payload[:1] for reception in scene.listener.receptions if reception.crc_ok]


@pytest.mark.parametrize("start", [0.0, 2.0, 4.0, 6.0, 12.0])
def test_conformance_16_stronger_in_the_preamble_is_received(start: float) -> None:
    """A frame 6 dB stronger that starts in another's preamble is received, the other is not."""
    assert overlap((0.0, 0.0), (start, 6.0)) == (["received"], [b"\1"])


@pytest.mark.parametrize("start", [0.0, 4.0, 12.0, 15.0, LATE_PAYLOAD])
def test_conformance_16_weaker_does_no_harm(start: float) -> None:
    """A frame 6 dB stronger is received, wherever the weaker one starts."""
    outcomes, payloads = overlap((0.0, 0.0), (start, -6.0))
    assert (outcomes[0], payloads) == ("received", [b"\0"])


@pytest.mark.parametrize("above_db", [-5.9, 0.0, 5.9])
@pytest.mark.parametrize("start", [4.0, 9.0, 15.0])
def test_conformance_16_within_6_db_in_preamble_and_header_nothing_is_received(
    start: float, above_db: float
) -> None:
    """Two frames of similar power that overlap from early on are both lost."""
    outcomes, payloads = overlap((0.0, 0.0), (start, above_db))
    assert set(outcomes) <= {"lost"}
    assert payloads == []


@pytest.mark.parametrize("above_db", [-5.9, 0.0, 20.0])
def test_conformance_16_after_the_header_the_first_is_damaged(above_db: float) -> None:
    """A frame that is interfered with after its header has a wrong checksum; the later one is lost in any case."""
    assert overlap((0.0, 0.0), (LATE_PAYLOAD, above_db)) == (["damaged"], [])


def test_conformance_16_early_preamble_may_be_disturbed() -> None:
    """Interference that ends before the last five preamble symbols has no effect."""
    scene = Scene()
    scene.send(frame(-66.25 + 1.0), "earlier")  # it ends three symbols after the next begins
    scene.at(-10.0)
    scene.rx.listen(listening(-10.0))
    scene.send(frame(0.0, preamble_symbols=8))
    assert scene.finish() == ["received"]


def test_conformance_16_sum_of_interferers_counts() -> None:
    """Two weaker frames that are harmless individually are too strong together."""
    assert overlap((0.0, 0.0), (9.0, -7.0))[0] == ["received"]
    assert overlap((0.0, 0.0), (9.0, -7.0), (10.0, -7.0))[0] == ["lost"]


@pytest.mark.parametrize(("above_db", "outcomes"), [(12.9, ["received"]), (13.1, ["damaged"])])
def test_conformance_16_other_spreading_factors_are_nearly_orthogonal(
    above_db: float, outcomes: list[str]
) -> None:
    """SF9 tolerates SF10 that is up to 13 dB stronger."""
    other = modulation(spreading_factor=10)
    assert overlap((0.0, 0.0), (LATE_PAYLOAD, above_db), modulation=other)[0] == outcomes


def test_conformance_16_end_to_end_is_no_overlap() -> None:
    """Consecutive frames without a gap are both received."""
    scene = Scene()
    scene.rx.listen(listening())
    first = scene.send(frame(), "one")
    scene.send(frame(start_ns=first.end_ns), "other")
    assert scene.finish() == ["received", "received"]
    assert first.end_ns == round(68.25 * SYMBOL_NS)
