"""Conformance list for simulated chips (docs/explanation/simulated-radio.md), points 8 to 12 and 14: reception."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from harness.hardware.chips import CAD, FSRX, FSTX, RXCONTINUOUS, RXSINGLE, SLEEP, STDBY, TX, Bench

from tsgt.simulation.kernel import VirtualTimeline
from tsgt.simulation.lora import Air, LinkModel

RX_BASE, CURRENT, FLAGS, NB_BYTES = 0x0F, 0x10, 0x12, 0x13
RX_TIMEOUT, RX_DONE, CRC_ERROR, VALID_HEADER = 0x80, 0x40, 0x20, 0x10


@pytest.fixture
def bench() -> Bench:
    """Return a chip in LoRa standby."""
    bench = Bench()
    bench.enter_lora()
    return bench


# 8 to 11: receiving


def test_conformance_08_packets_follow_each_other_in_the_fifo(bench: Bench) -> None:
    """In RXCONTINUOUS each packet is stored after the one before, and RxCurrentAddr says where."""
    bench.listen()
    for payload, start in ((b"first", 0), (b"second", 5), (b"third", 11)):
        bench.receive(payload)
        assert bench.read(CURRENT) == start
        assert bench.read(NB_BYTES) == len(payload)
        assert bench.read(0x25) == start + len(payload) - 1
        assert bench.read_fifo(start, len(payload)) == payload
        assert bench.read(0x01) == RXCONTINUOUS


def test_conformance_08_packets_wrap_in_the_fifo(bench: Bench) -> None:
    """A packet that meets the end of the FIFO goes on at address 0, not at RxBase."""
    bench.write(RX_BASE, 0x10)
    bench.listen()
    bench.receive(bytes(230))
    bench.receive(b"0123456789abcdef")
    assert bench.read(CURRENT) == 0xF6
    assert bench.read_fifo(0xF6, 16) == b"0123456789abcdef"
    assert bench.read_fifo(0x00, 6) == b"abcdef"


def test_conformance_08_entering_reception_again_starts_at_rx_base(bench: Bench) -> None:
    """The write pointer returns to RxBase when RX is entered from another mode."""
    bench.write(RX_BASE, 0x40)
    bench.listen()
    bench.receive(b"abcd")
    bench.write(0x01, STDBY)
    bench.listen()
    bench.receive(b"efgh")
    assert bench.read(CURRENT) == 0x40
    assert bench.read_fifo(0x40, 4) == b"efgh"


def test_conformance_09_a_single_reception_times_out(bench: Bench) -> None:
    """RxTimeout comes SymbTimeout symbols and 0.3 ms after the start, then STDBY."""
    bench.write(0x1F, 20)
    bench.write(0x01, RXSINGLE)
    started_ns = bench.timeline.now_ns() + 101_000
    expected_ns = started_ns + 20 * 1_024_000 + 305_000
    bench.timeline.advance_to(expected_ns - 1_000)
    assert bench.read(0x01) == RXSINGLE
    bench.timeline.advance(2_000)
    assert bench.read(FLAGS) == RX_TIMEOUT
    assert bench.read(0x01) == STDBY
    assert bench.port.listening is None


@pytest.mark.parametrize("crc_ok", [True, False])
def test_conformance_09_a_single_reception_ends_in_standby(bench: Bench, crc_ok: bool) -> None:  # noqa: FBT001
    """A preamble stops the time-out, and after one packet, good or bad, the chip is in STDBY."""
    bench.write(0x1F, 8)
    bench.write(0x01, RXSINGLE)
    bench.timeline.advance(1_000_000)
    bench.receive(b"long enough for the time-out to be past", crc_ok=crc_ok)
    assert not bench.read(FLAGS) & RX_TIMEOUT
    assert bench.read(FLAGS) & RX_DONE
    assert bench.read(0x01) == STDBY
    assert bench.port.listening is None


def test_conformance_09_a_lost_lock_times_out_a_single_reception(bench: Bench) -> None:
    """If the header does not arrive, RxTimeout ends a single reception; a continuous one goes on searching."""
    bench.write(0x01, RXSINGLE)
    bench.timeline.advance(1_000_000)
    frame = bench.port.send(b"abcd", header_ok=False)
    bench.timeline.advance_to(frame.header_end_ns)
    assert bench.read(FLAGS) == RX_TIMEOUT
    assert bench.read(0x01) == STDBY
    bench.write(FLAGS, 0xFF)
    bench.listen()
    frame = bench.port.send(b"abcd", header_ok=False)
    bench.timeline.advance_to(frame.end_ns + frame.symbol_ns)
    assert not bench.read(FLAGS)
    assert bench.read(0x01) == RXCONTINUOUS


def test_conformance_10_a_bad_payload_sets_both_flags_in_one_step(bench: Bench) -> None:
    """RxDone and PayloadCrcError come in the same instant, with the data in the FIFO."""
    seen: list[int] = []
    bench.chip.on_dio(0, lambda _at_ns, _level: seen.append(bench.read(FLAGS)))
    bench.listen()
    bench.receive(b"damaged", crc_ok=False)
    assert seen == [RX_DONE | CRC_ERROR | VALID_HEADER]
    assert bench.read_fifo(bench.read(CURRENT), bench.read(NB_BYTES)) == b"damaged"


@pytest.mark.parametrize("crc", [True, False])
def test_conformance_10_the_header_says_whether_there_is_a_crc(bench: Bench, crc: bool) -> None:  # noqa: FBT001
    """Bit 6 of RegHopChannel is the sender's choice, whatever the receiver's own setting is."""
    bench.listen()
    bench.receive(b"abcd", crc=crc)
    assert bool(bench.read(0x1C) & 0x40) is crc
    assert bench.read(FLAGS) == RX_DONE | VALID_HEADER


def test_conformance_11_writing_the_same_mode_keeps_a_reception(bench: Bench) -> None:
    """RXCONTINUOUS written in the middle of a packet changes nothing."""
    bench.listen()
    frame = bench.port.send(b"abcd")
    bench.timeline.advance_to(frame.header_end_ns + 1)
    bench.write(0x01, RXCONTINUOUS)
    bench.timeline.advance_to(frame.end_ns + frame.symbol_ns)
    assert bench.read(FLAGS) & RX_DONE


@pytest.mark.parametrize("when", ["preamble", "payload", "before RxDone"])
def test_conformance_11_leaving_reception_is_silent(bench: Bench, when: str) -> None:
    """STDBY in the middle of a packet ends it without a flag, up to the very end."""
    bench.listen()
    frame = bench.port.send(b"abcd")
    bench.timeline.advance_to(
        {
            "preamble": frame.start_ns + 1,
            "payload": frame.header_end_ns - 1,
            "before RxDone": frame.end_ns + 1,
        }[when]
    )
    bench.write(FLAGS, 0xFF)
    bench.write(0x01, STDBY)
    bench.write(FLAGS, VALID_HEADER)
    bench.timeline.advance(100_000_000)
    assert bench.read(FLAGS) == 0
    assert bench.port.listening is None


# 12: half duplex, and what keeps two chips apart


def pair_on_the_air() -> tuple[Bench, Bench]:
    """Return two chips in LoRa standby on an undisturbed channel."""
    timeline = VirtualTimeline()
    air = Air(timeline, np.random.default_rng(1), LinkModel())
    sender, receiver = (
        Bench(timeline=timeline, join=partial(air.join, name=name)) for name in ("sender", "receiver")
    )
    for bench in (sender, receiver):
        bench.enter_lora()
        bench.write(0x09, 0x8F)
    return sender, receiver


def send_on_the_air(sender: Bench, payload: bytes) -> None:
    """Transmit, and wait for the end."""
    sender.write_fifo(0x80, payload)
    sender.write(0x22, len(payload))
    sender.write(0x01, TX)
    sender.timeline.advance(1_000_000_000)


def test_conformance_12_equal_settings_are_received() -> None:
    """Two chips with the same settings receive each other."""
    sender, receiver = pair_on_the_air()
    receiver.listen()
    send_on_the_air(sender, b"hello")
    assert receiver.read(FLAGS) == RX_DONE | VALID_HEADER
    assert receiver.read_fifo(0, 5) == b"hello"


@pytest.mark.parametrize(
    "registers",
    [
        pytest.param(((0x1E, 0x84),), id="SF8"),
        pytest.param(((0x1D, 0x82),), id="250 kHz"),
        pytest.param(((0x33, 0x67), (0x3B, 0x19)), id="inverted IQ"),
        pytest.param(((0x39, 0x34),), id="sync word"),
        pytest.param(((0x1D, 0x73), (0x22, 5)), id="implicit header"),
        pytest.param(((0x06, 0x6C), (0x07, 0x82), (0x08, 0x04)), id="31.5 kHz off"),
    ],
)
def test_conformance_12_different_settings_are_not_received(registers: tuple[tuple[int, int], ...]) -> None:
    """With one different setting nothing is received."""
    sender, receiver = pair_on_the_air()
    for address, value in registers:
        receiver.write(address, value)
    receiver.listen()
    send_on_the_air(sender, b"hello")
    assert receiver.read(FLAGS) == 0
    assert receiver.read(0x01) == RXCONTINUOUS


def test_conformance_12_low_data_rate_must_agree() -> None:
    """With LowDataRateOptimize on one side only, no good packet arrives; the header may."""
    sender, receiver = pair_on_the_air()
    receiver.write(0x26, 0x08)
    receiver.listen()
    send_on_the_air(sender, b"hello")
    assert receiver.read(FLAGS) & (RX_DONE | CRC_ERROR) != RX_DONE


@pytest.mark.parametrize(
    "registers",
    [
        pytest.param(((0x06, 0x6C), (0x07, 0x81), (0x08, 0xF0)), id="30.3 kHz off"),
        pytest.param(((0x0A, 0x00), (0x0B, 0x00), (0x0C, 0xC0)), id="ramp, over-current, LNA"),
        pytest.param(((0x31, 0x43), (0x2F, 0x40), (0x26, 0x04)), id="IF and AGC"),
        pytest.param(((0x1D, 0x78), (0x22, 77)), id="coding rate and length with a header"),
        pytest.param(((0x1E, 0x70),), id="receiver without CRC"),
    ],
)
def test_conformance_12_some_differences_do_not_matter(registers: tuple[tuple[int, int], ...]) -> None:
    """A quarter of the bandwidth is tolerated; what the header says and what is analogue is not the receiver's."""
    sender, receiver = pair_on_the_air()
    for address, value in registers:
        receiver.write(address, value)
    receiver.listen()
    send_on_the_air(sender, b"hello")
    assert receiver.read(FLAGS) == RX_DONE | VALID_HEADER


@pytest.mark.parametrize("mode", [SLEEP, STDBY, FSTX, TX, FSRX, CAD])
def test_conformance_12_only_a_receiver_receives(mode: int) -> None:
    """In any mode but reception nothing is received, transmission included."""
    sender, receiver = pair_on_the_air()
    receiver.write(0x22, 100)
    receiver.write(0x01, mode)
    send_on_the_air(sender, b"hello")
    assert not receiver.read(FLAGS) & (RX_DONE | VALID_HEADER)


# 14: signal strength


@pytest.mark.parametrize("frequency", [(0x6C, 0x80, 0x00), (0xE2, 0x40, 0x00)], ids=["434 MHz", "905 MHz"])
@pytest.mark.parametrize(
    ("rssi_dbm", "snr_db"), [(-40.0, 12.0), (-80.0, 9.25), (-107.0, 0.0), (-115.0, -4.5), (-125.0, -12.25)]
)
def test_conformance_14_strength_decodes_to_the_channel_values(
    bench: Bench, frequency: tuple[int, int, int], rssi_dbm: float, snr_db: float
) -> None:
    """The data sheet's formulas return power and SNR of the packet, with SNR above and below zero."""
    bench.write(0x06, *frequency)
    bench.listen()
    frame = bench.port.send(b"abcd", rssi_dbm=rssi_dbm, snr_db=snr_db)
    bench.timeline.advance_to(frame.end_ns + frame.symbol_ns)
    offset = -157 if frequency[0] == 0xE2 else -164
    snr = (bench.read(0x19) ^ 0x80) - 0x80
    assert snr / 4 == snr_db
    strength = bench.read(0x1A)
    decoded = offset + strength + snr / 4 if snr < 0 else offset + strength * 16 / 15
    assert decoded == pytest.approx(rssi_dbm, abs=0.54)


def test_conformance_14_current_rssi(bench: Bench) -> None:
    """RegRssiValue is the current power on the channel."""
    bench.listen()
    bench.port.channel_dbm = -97.3
    assert -164 + bench.read(0x1B) == -97
