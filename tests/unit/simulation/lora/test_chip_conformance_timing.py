"""Conformance list for simulated chips (docs/explanation/simulated-radio.md), points 7, 17 and 18: pins, timing, the authors' node."""

from __future__ import annotations

import numpy as np
import pytest
from harness.hardware.chips import CAD, SLEEP, Bench

from tsgt.simulation.lora.modem import ChipTiming

FLAGS = 0x12
RX_DONE = 0x40


@pytest.fixture
def bench() -> Bench:
    """Return a chip in LoRa standby."""
    bench = Bench()
    bench.enter_lora()
    return bench


# 7: DIO0


@pytest.mark.parametrize(("mapping", "high"), [(0x00, False), (0x40, True), (0x80, False), (0xC0, True)])
def test_conformance_07_dio0_after_tx_done(bench: Bench, mapping: int, high: bool) -> None:  # noqa: FBT001
    """TxDone is on DIO0 with mapping 01, and with 11."""
    bench.write(0x40, mapping)
    bench.transmit(b"abcd")
    assert bench.chip.dio(0) is high


@pytest.mark.parametrize(("mapping", "high"), [(0x00, True), (0x40, False), (0x80, False), (0xC0, True)])
def test_conformance_07_dio0_after_rx_done(bench: Bench, mapping: int, high: bool) -> None:  # noqa: FBT001
    """RxDone is on DIO0 with mapping 00, and with 11."""
    bench.write(0x40, mapping)
    bench.listen()
    bench.receive(b"abcd")
    assert bench.chip.dio(0) is high


def test_conformance_07_dio0_after_cad_done(bench: Bench) -> None:
    """CadDone is on DIO0 with mapping 10."""
    bench.write(0x40, 0x80)
    bench.write(0x01, CAD)
    bench.timeline.advance(10_000_000)
    assert bench.chip.dio(0)


def test_conformance_07_a_pin_is_a_level_with_edges(bench: Bench) -> None:
    """Each change is reported once with its time; a second packet before clearing makes no second edge."""
    edges: list[tuple[int, bool]] = []
    bench.chip.on_dio(0, lambda at_ns, level: edges.append((at_ns, level)))
    bench.listen()
    first = bench.receive(b"abcd")
    bench.receive(b"efgh")
    cleared_ns = bench.timeline.now_ns()
    bench.write(FLAGS, RX_DONE)
    third = bench.receive(b"ijkl")
    delay_ns = round(0.74 * first.symbol_ns)
    assert edges == [(first.end_ns + delay_ns, True), (cleared_ns, False), (third.end_ns + delay_ns, True)]


def test_conformance_07_pins_follow_a_change_of_mapping(bench: Bench) -> None:
    """A mapping that is written after the flag was set shows at once (Adafruit, LoRaRF)."""
    edges: list[bool] = []
    bench.chip.on_dio(0, lambda _, level: edges.append(level))
    bench.transmit(b"abcd")
    assert not edges
    bench.write(0x40, 0x40)
    bench.write(0x40, 0x00)
    assert edges == [True, False]


def test_conformance_07_pins_are_low_in_fsk_mode(bench: Bench) -> None:
    """The flags of the LoRa modem are not on the pins in FSK mode."""
    edges: list[bool] = []
    bench.write(0x40, 0x40)
    bench.chip.on_dio(0, lambda _, level: edges.append(level))
    bench.transmit(b"abcd")
    bench.write(0x01, SLEEP)
    bench.write(0x01, 0x00)
    assert edges == [True, False]


# 17: timing


def test_conformance_17_tx_done_67_us_after_the_frame_with_jitter() -> None:
    """TxDone comes 67 us after the frame's last symbol, give or take a jitter of 3 us."""
    bench = Bench(ChipTiming())
    bench.enter_lora()
    bench.write(0x40, 0x40)
    edges: list[int] = []
    bench.chip.on_dio(0, lambda at_ns, level: edges.append(at_ns) if level else None)
    delays = []
    for _ in range(200):
        frame = bench.transmit(b"abcd")
        delays.append(edges[-1] - frame.end_ns)
        bench.write(FLAGS, 0xFF)
    assert np.mean(delays) == pytest.approx(67_000, abs=1_000)
    assert np.std(delays) == pytest.approx(3_000, rel=0.2)


@pytest.mark.parametrize(
    ("spreading_factor", "symbols"), [(7, 0.74), (8, 0.74), (9, 0.76), (10, 0.80), (11, 0.81), (12, 0.90)]
)
def test_conformance_17_rx_done_a_fraction_of_a_symbol_after_the_frame(
    spreading_factor: int, symbols: float
) -> None:
    """RxDone comes 0.74 to 0.9 symbols after the frame's end on the air."""
    bench = Bench()
    bench.enter_lora(spreading_factor=spreading_factor)
    edges: list[int] = []
    bench.chip.on_dio(0, lambda at_ns, _: edges.append(at_ns))
    bench.listen()
    frame = bench.receive(b"abcd")
    assert edges == [frame.end_ns + round(symbols * frame.symbol_ns)]


def test_conformance_17_airtime_by_the_formula() -> None:
    """The authors' 34 bytes at SF9, 250 kHz, 4/6 are on the air for 139.776 ms, and 2 bytes for 53.76 ms."""
    bench = Bench()
    bench.enter_lora(spreading_factor=9)
    bench.write(0x1D, 0x84)
    frame = bench.transmit(bytes(34))
    assert frame.end_ns - frame.start_ns == 139_776_000
    frame = bench.transmit(bytes(2))
    assert frame.end_ns - frame.start_ns == 53_760_000


# 18: the authors' node


def write_as_norlab(bench: Bench) -> None:
    """Initialise as the authors' lora_radio.cpp does, in its order."""
    for address, value in (
        *((0x01, bench.read(0x01) & 0xF8), (0x01, 0x88), (0x06, 0xE2), (0x07, 0x40), (0x08, 0x00)),
        *((0x39, 0x34), (0x26, 0x04), (0x1D, 0x84), (0x1E, 0x94), (0x1F, 0x08), (0x23, 0xFF), (0x22, 0x40)),
        *((0x24, 0x00), (0x0D, bench.read(0x0F)), (0x0C, 0x23), (0x01, 0x89), (0x0A, 0x08), (0x09, 0x8F)),
        *((0x4D, bench.read(0x4D) | 0x07), (0x0B, 0x3B)),
    ):
        bench.write(address, value)


def test_conformance_18_the_authors_node_sends() -> None:
    """Its initialisation and transmission work with DIO mapping 0xF0 and the low-frequency bit set at 905 MHz."""
    bench = Bench()
    write_as_norlab(bench)
    for address, *values in ((0x01, 0x89), (0x40, 0xF0), (0x12, 0xFF), (0x0E, 0), (0x0D, 0), (0x22, 34)):
        bench.write(address, *values)
    bench.write(0x00, *range(34))
    bench.write(0x01, bench.read(0x01) & ~0x07 | 3)
    polls = 0
    while not bench.chip.dio(0):
        bench.timeline.advance(1_000_000)
        polls += 1
    assert polls == 141
    frame = bench.port.frames[0]
    assert frame.payload == bytes(range(34))
    assert frame.power_dbm == 20.0
    assert frame.modulation.frequency_hz == 905e6
    assert frame.modulation.sync_word == 0x34
    assert frame.coding_rate == 6
    assert bench.read(0x01) == 0x89


def test_conformance_18_the_authors_node_receives() -> None:
    """Its reception works: DIO0 by mapping 0xF0, RxCurrentAddr, and the FIFO one byte per transfer."""
    bench = Bench()
    write_as_norlab(bench)
    bench.write(0x12, 0xFF)
    bench.write(0x40, 0xF0)
    bench.write(0x01, bench.read(0x01) & ~0x07 | 5)
    bench.timeline.advance(1_000_000)
    for payload in (b"t1", bytes(range(34))):
        bench.receive(payload)
        assert bench.chip.dio(0)
        assert not bench.read(0x12) & 0x20
        bench.write(0x12, 0x40)
        assert not bench.chip.dio(0)
        bench.write(0x0D, bench.read(0x10))
        assert bytes(bench.read(0x00) for _ in range(bench.read(0x13))) == payload
