from __future__ import annotations

from typing import Any

import pytest
from harness.radio.air import (
    SYMBOL_NS,
    RecordingListener,
    Scene,
    frame,
    link_with_snr,
    listening,
    modulation,
)

from tsgt.radio import airtime_us
from tsgt.simulation.lora import LinkModel
from tsgt.simulation.lora.frames import Header, Reception
from tsgt.simulation.lora.link import FixedLoss

IMPLICIT = modulation(explicit_header=False)


def receive(sent: dict[str, Any], receiver: dict[str, Any]) -> Reception:
    """Send one frame and return its reception."""
    scene = Scene()
    scene.rx.listen(listening(**receiver))
    scene.send(frame(**sent))
    scene.finish()
    (reception,) = scene.listener.receptions
    return reception


def test_reception_events_have_exact_times() -> None:
    """Lock at the fifth symbol, header 8 symbols after the preamble, end after the airtime."""
    scene = Scene()
    scene.rx.listen(listening())
    sent = scene.send(frame(10.0))
    scene.finish()
    airtime_ns = 1000 * airtime_us(34, spreading_factor=9, bandwidth_hz=250_000, coding_rate=6)
    assert scene.listener.events == [
        (sent.start_ns + 5 * SYMBOL_NS, "preamble"),
        (sent.start_ns + round(20.25 * SYMBOL_NS), "header"),
        (sent.start_ns + airtime_ns, "received"),
    ]


def test_reception_matches_the_link_budget() -> None:
    """Payload, header, power, SNR and frequency error are those of the frame at the receiver."""
    scene = Scene(LinkModel(path_loss=FixedLoss(default_db=100.0)))
    scene.rx.listen(listening(modulation=modulation(frequency_hz=905e6 - 10_000)))
    scene.sender("tx", crystal_ppm=10.0)
    sent = scene.send(frame(crc=False))
    scene.finish()
    (reception,) = scene.listener.receptions
    assert reception.payload == sent.payload
    assert reception.crc_ok
    assert reception.header == Header(34, 6, crc=False)
    assert reception.rssi_dbm == pytest.approx(-86.0)
    assert reception.snr_db == pytest.approx(-86.0 + 113.5, abs=0.05)
    assert reception.frequency_error_hz == pytest.approx(10_000 + 9_050)


def test_large_crystal_offset_prevents_reception() -> None:
    """Carriers more than a quarter of the bandwidth apart are not received."""
    scene = Scene()
    scene.rx.listen(listening())
    scene.sender("tx", crystal_ppm=70.0)
    scene.send(frame())
    assert scene.finish() == []


def test_back_to_back_frames_are_all_received() -> None:
    """A receiver in continuous mode receives consecutive frames."""
    scene = Scene()
    scene.rx.listen(listening())
    sent = scene.send(frame())
    for _ in range(5):
        sent = scene.send(frame(start_ns=sent.end_ns))
    assert scene.finish() == ["received"] * 6


def test_stopping_the_receiver_ends_a_reception_without_event() -> None:
    """The frame that it was locked to is not reported."""
    scene = Scene()
    scene.rx.listen(listening())
    scene.send(frame())
    scene.at(30.0)
    scene.rx.listen(None)
    scene.finish()
    assert [what for _, what in scene.listener.events] == ["preamble", "header"]


def test_restarting_the_receiver_loses_the_current_frame() -> None:
    """The next frame is received."""
    scene = Scene()
    scene.rx.listen(listening())
    sent = scene.send(frame(payload=b"first"))
    scene.at(15.0)
    scene.rx.listen(listening(15.0))
    scene.send(frame(start_ns=sent.end_ns, payload=b"second"))
    scene.finish()
    assert [what for _, what in scene.listener.events] == ["preamble", "preamble", "header", "received"]
    assert scene.listener.receptions[0].payload == b"second"


def test_listener_may_stop_the_receiver_in_a_callback() -> None:
    """A chip in single reception does so."""

    class Single(RecordingListener):
        def frame_ended(self, at_ns: int, reception: Reception | None) -> None:
            super().frame_ended(at_ns, reception)
            port.listen(None)

    scene = Scene()
    listener = Single()
    port = scene.air.join(listener, "single")
    port.listen(listening())
    sent = scene.send(frame())
    scene.send(frame(start_ns=sent.end_ns))
    scene.finish()
    assert listener.outcomes == ["received"]


def test_locked_receiver_ignores_later_frames() -> None:
    """A locked receiver misses frames that start on the channel, and is free afterwards."""
    scene = Scene(LinkModel(path_loss=FixedLoss(pairs_db={("far", "rx"): 100.0})))
    scene.rx.listen(listening())
    scene.send(frame(payload=b"near" * 8))
    scene.send(frame(30.0, payload=b"far" * 8), "far")
    scene.send(frame(120.0, payload=b"later"), "far")
    scene.finish()
    assert [reception.payload for reception in scene.listener.receptions] == [b"near" * 8, b"later"]


def test_weaker_frame_with_frequency_offset_does_not_take_over() -> None:
    """Two senders at opposite ends of the frequency tolerance; the first one is received."""
    scene = Scene()
    scene.rx.listen(listening())
    scene.send(frame(modulation=modulation(frequency_hz=905.05e6), payload=b"first"), "one")
    scene.send(frame(6.0, modulation=modulation(frequency_hz=904.95e6), power_dbm=10.0), "other")
    scene.finish()
    assert [reception.payload for reception in scene.listener.receptions] == [b"first"]


def test_search_resumes_after_a_lost_header() -> None:
    """The preamble of a frame that started before is still detected, if enough of it is left."""
    scene = Scene()
    scene.rx.listen(listening(max_payload_bytes=20))
    scene.send(frame(payload=bytes(34), power_dbm=0.0), "long")
    sent = scene.send(frame(17.5, payload=bytes(10), power_dbm=14.0), "short")
    assert scene.finish() == ["lost", "received"]
    assert scene.listener.events[0] == (5 * SYMBOL_NS, "preamble")
    assert scene.listener.events[-1][0] == sent.end_ns


def test_payload_above_the_limit_is_dropped_at_the_header() -> None:
    """A header that announces more than the receiver accepts ends the reception."""
    scene = Scene()
    scene.rx.listen(listening(max_payload_bytes=33))
    sent = scene.send(frame())
    scene.finish()
    assert scene.listener.events[1:] == [(sent.header_end_ns, "lost")]


@pytest.mark.parametrize(
    ("sent", "receiver", "outcomes"),
    [(8, 6, ["received"]), (12, 8, ["received"]), (13, 8, []), (8, 20, ["received"])],
)
def test_preamble_may_exceed_the_setting_by_four_symbols(
    sent: int, receiver: int, outcomes: list[str]
) -> None:
    """A preamble of up to four symbols more than the setting is recognised, a shorter one always."""
    scene = Scene()
    scene.rx.listen(listening(preamble_symbols=receiver))
    scene.send(frame(preamble_symbols=sent))
    assert scene.finish() == outcomes


def test_late_receiver_detects_the_rest_of_a_long_preamble() -> None:
    """The part of the preamble that is received counts."""
    scene = Scene()
    scene.send(frame(preamble_symbols=30))
    scene.at(20.0)
    scene.rx.listen(listening(20.0))
    assert scene.finish() == ["received"]


def test_explicit_header_overrides_the_receiver_settings() -> None:
    """The receiver's coding rate, length and checksum setting do not matter."""
    reception = receive({"crc": False, "coding_rate": 8}, {"crc": True, "coding_rate": 5, "payload_bytes": 1})
    assert reception.header == Header(34, 8, crc=False)
    assert len(reception.payload) == 34


def test_implicit_header_gives_no_header_event() -> None:
    """Nothing is reported between lock and end."""
    scene = Scene()
    scene.rx.listen(listening(modulation=IMPLICIT))
    scene.send(frame(modulation=IMPLICIT))
    scene.finish()
    assert [what for _, what in scene.listener.events] == ["preamble", "received"]


@pytest.mark.parametrize(
    ("sent", "receiver", "crc_ok", "whole"),
    [
        ({"crc": False}, {"crc": True}, False, True),
        ({"crc": True}, {"crc": False}, True, True),
        ({"coding_rate": 8}, {}, False, False),
        ({}, {"payload_bytes": 20}, False, True),
        ({}, {"payload_bytes": 40}, False, False),
        ({}, {"payload_bytes": 40, "crc": False}, True, False),
    ],
    ids=str,
)
def test_implicit_header_uses_the_receiver_settings(
    sent: dict[str, Any],
    receiver: dict[str, Any],
    *,
    crc_ok: bool,
    whole: bool,
) -> None:
    """The receiver's length, coding rate and checksum must match the sender's."""
    settings = {"modulation": IMPLICIT}
    reception = receive(settings | sent, settings | receiver)
    assert reception.crc_ok == crc_ok
    assert len(reception.payload) == receiver.get("payload_bytes", 34)
    assert (frame().payload.startswith(reception.payload)) == whole


def test_damaged_payload_differs() -> None:
    """A payload with a wrong checksum has its length and wrong bytes."""
    scene = Scene(link_with_snr(-15.5))
    scene.rx.listen(listening())
    sent = scene.send(frame())
    for _ in range(50):
        sent = scene.send(frame(start_ns=sent.end_ns))
    scene.finish()
    damaged = [reception for reception in scene.listener.receptions if not reception.crc_ok]
    assert damaged
    assert all(len(reception.payload) == 34 for reception in damaged)
    assert all(reception.payload != sent.payload for reception in damaged)


@pytest.mark.parametrize(
    ("cut_symbols", "events"),
    [(3.0, []), (10.0, ["preamble", "lost"]), (30.0, ["preamble", "header", "damaged"])],
)
def test_cut_frame_is_reported_at_its_expected_end(cut_symbols: float, events: list[str]) -> None:
    """A receiver waits for the header or payload of a frame that was cut, and then reports it."""
    scene = Scene()
    scene.rx.listen(listening())
    sent = scene.send(frame())
    scene.at(cut_symbols)
    scene.sender("tx").stop_transmitting(round(cut_symbols * SYMBOL_NS))
    scene.finish()
    assert [what for _, what in scene.listener.events] == events
    if events[-1:] == ["damaged"]:
        assert scene.listener.events[-1][0] == sent.end_ns


def test_cut_frame_does_not_interfere() -> None:
    """After it was cut."""
    scene = Scene()
    scene.rx.listen(listening())
    scene.send(frame(-40.0), "other")
    scene.at(-5.0)
    scene.sender("other").stop_transmitting(-5 * SYMBOL_NS)
    scene.rx.listen(listening(-5.0))
    scene.send(frame())
    assert scene.finish() == ["received"]


def test_preamble_is_detected_after_interference_ends() -> None:
    """A long preamble is detected once the interfering frame has ended."""
    scene = Scene()
    scene.send(frame(-60.0), "other")
    scene.at(-10.0)
    scene.rx.listen(listening(-10.0, preamble_symbols=20))
    scene.send(frame(preamble_symbols=20))
    assert scene.finish() == ["received"]
    assert 8.25 * SYMBOL_NS < scene.listener.events[0][0] <= 20 * SYMBOL_NS


def test_new_frame_cuts_the_previous_one() -> None:
    """A radio has one transmitter."""
    scene = Scene()
    scene.rx.listen(listening())
    scene.send(frame())
    scene.send(frame(30.0))
    scene.send(frame(100.0))
    assert scene.finish() == ["damaged", "received"]


def test_leaving_cuts_the_frame_and_frees_the_name() -> None:
    """The name can be used again."""
    scene = Scene()
    scene.rx.listen(listening())
    scene.send(frame())
    scene.at(30.0)
    scene.air.leave("tx")
    scene.air.leave("nobody")
    assert scene.finish() == ["damaged"]
    scene.air.join(RecordingListener(), "tx")


def test_names_are_unique() -> None:
    """A second radio with the same name is rejected."""
    with pytest.raises(ValueError, match="radio 'rx' has joined already"):
        Scene().air.join(RecordingListener(), "rx")


def test_attenuation_during_a_mission() -> None:
    """A radio behind an attenuation is not received until it is removed."""
    scene = Scene()
    scene.rx.listen(listening())
    scene.send(frame())
    scene.link.set_attenuation("tx", "rx", 80.0)
    scene.send(frame(100.0))
    scene.link.set_attenuation("tx", "rx", 0.0)
    scene.send(frame(200.0))
    scene.finish()
    assert [at_ns for at_ns, what in scene.listener.events if what == "received"] == [
        frame().end_ns,
        frame(200.0).end_ns,
    ]


def test_rssi_adds_noise_and_signals() -> None:
    """RSSI is the noise floor on a quiet channel, otherwise the sum with the signals in the band."""
    scene = Scene(LinkModel(path_loss=FixedLoss(default_db=80.0)))
    assert scene.rx.rssi_dbm(0) == pytest.approx(-116.5, abs=0.05)
    scene.rx.listen(listening())
    assert scene.rx.rssi_dbm(0) == pytest.approx(-113.5, abs=0.05)
    scene.send(frame(1.0), "one")
    scene.send(frame(2.0), "other")
    scene.send(frame(2.0, modulation=modulation(frequency_hz=910e6)), "elsewhere")
    assert scene.rx.rssi_dbm(SYMBOL_NS * 3 // 2) == pytest.approx(-66.0, abs=0.01)
    assert scene.rx.rssi_dbm(2 * SYMBOL_NS) == pytest.approx(-63.0, abs=0.02)
    scene.at(100.0)
    assert scene.rx.rssi_dbm(100 * SYMBOL_NS) == pytest.approx(-113.5, abs=0.05)


@pytest.mark.parametrize(
    ("at_symbols", "present"), [(0.5, False), (1.0, True), (12.25, True), (13.0, False), (60.0, False)]
)
def test_activity_detection_finds_preambles_only(at_symbols: float, *, present: bool) -> None:
    """It finds a preamble that filled the last symbol, and no payload."""
    scene = Scene()
    scene.send(frame())
    at_ns = round(at_symbols * SYMBOL_NS)
    scene.timeline.advance_to(at_ns)
    assert scene.rx.preamble_present(modulation(sync_word=0x12), at_ns) == present
    assert not scene.rx.preamble_present(modulation(spreading_factor=10), at_ns)
    assert not scene.rx.preamble_present(modulation(inverted_iq=True), at_ns)


def test_weak_preamble_is_no_activity() -> None:
    """A preamble below the detection threshold is not found."""
    scene = Scene(link_with_snr(-25.0))
    scene.send(frame())
    scene.at(5.0)
    assert not scene.rx.preamble_present(modulation(), 5 * SYMBOL_NS)


def test_decided_frames_are_dropped() -> None:
    """A frame is kept only while a frame that overlaps it is undecided."""
    scene = Scene()
    scene.rx.listen(listening())
    for number in range(1000):
        scene.send(frame(number * 40.0), f"tx{number % 2}")
        assert len(scene.air.frames) <= 4
    scene.at(1000 * 40.0 + 100.0)
    scene.send(frame(1000 * 40.0 + 100.0))
    assert len(scene.air.frames) == 1
