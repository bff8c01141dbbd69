"""Reception of the simulated SX1276 beyond the conformance list: settings, status registers, activity detection."""

from __future__ import annotations

import pytest
from harness.hardware.chips import CAD, SLEEP, STDBY, Bench

from tsgt.simulation.lora.frames import Header, Reception

FLAGS, MODEM_STAT = 0x12, 0x18
RX_DONE, VALID_HEADER, CAD_DONE, CAD_DETECTED = 0x40, 0x10, 0x04, 0x01


@pytest.fixture
def bench() -> Bench:
    """Return a chip in LoRa standby."""
    bench = Bench()
    bench.enter_lora()
    return bench


# --- receiving


def test_receiver_starts_101_us_after_the_write(bench: Bench) -> None:
    """The channel gets the receiver settings with the time at which the receiver is ready."""
    bench.write(0x23, 64)
    bench.write(0x22, 12)
    written_ns = bench.timeline.now_ns()
    bench.listen()
    listening = bench.port.listening
    assert listening is not None
    assert listening.since_ns == written_ns + 101_000
    assert (listening.max_payload_bytes, listening.payload_bytes, listening.preamble_symbols) == (64, 12, 8)
    assert (listening.coding_rate, listening.crc) == (5, True)


def test_iq_of_transmitter_and_receiver_are_independent(bench: Bench) -> None:
    """RegInvertIQ 0x67, as in a LoRaWAN node: transmits normal and receives inverted chirps."""
    bench.write(0x33, 0x67)
    bench.listen()
    assert bench.port.listening is not None
    assert bench.port.listening.modulation.inverted_iq
    assert not bench.transmit(b"x").modulation.inverted_iq


def test_narrow_receiver_has_a_frequency_offset(bench: Bench) -> None:
    """With the settings of errata 2.3 a receiver at 31.25 kHz is tuned one bandwidth below its RegFrf."""
    bench.write(0x1D, 0x42)
    bench.write(0x31, 0x43)
    bench.write(0x2F, 0x44)
    bench.write(0x06, 0x6C, 0x82, 0x00)
    bench.listen()
    assert bench.port.listening is not None
    assert bench.port.listening.modulation.frequency_hz == 434e6


def test_carrier_change_with_fast_hop_loses_the_reception(bench: Bench) -> None:
    """With FastHopOn a new carrier takes effect at once."""
    bench.write(0x44, 0xAD)
    bench.listen()
    frame = bench.port.send(b"abcd")
    bench.write(0x06, 0xE2, 0x40, 0x00)
    assert bench.port.listening is not None
    assert bench.port.listening.modulation.frequency_hz == 905e6
    bench.timeline.advance_to(frame.end_ns + frame.symbol_ns)
    assert bench.read(FLAGS) == 0


def test_modem_status_follows_a_reception(bench: Bench) -> None:
    """RegModemStat goes from idle over searching, locked and header known back to searching."""
    assert bench.read(MODEM_STAT) == 0b10000
    bench.listen()
    assert bench.read(MODEM_STAT) == 0b00100
    frame = bench.port.send(b"abcd", coding_rate=7)
    bench.timeline.advance_to(frame.preamble_end_ns)
    assert bench.read(MODEM_STAT) == 0b00111
    bench.timeline.advance_to(frame.header_end_ns)
    assert bench.read(MODEM_STAT) == 0b011_01111
    assert bench.read(FLAGS) == VALID_HEADER
    bench.timeline.advance_to(frame.end_ns + frame.symbol_ns)
    assert bench.read(MODEM_STAT) == 0b011_00100
    bench.write(0x01, STDBY)
    assert bench.read(MODEM_STAT) == 0b011_10000


def test_headers_and_packets_are_counted_until_sleep(bench: Bench) -> None:
    """A header counts when it is valid, a packet when its payload is."""
    bench.listen()
    for _ in range(300):
        bench.receive(b"abcd")
    bench.receive(b"abcd", crc_ok=False)
    assert bench.chip.transfer(bytes([0x14, 0, 0, 0, 0]))[1:] == bytes([1, 45, 1, 44])
    bench.write(0x01, STDBY)
    assert bench.read(0x15) == 45
    bench.write(0x01, SLEEP)
    assert bench.chip.transfer(bytes([0x14, 0, 0, 0, 0]))[1:] == bytes(4)


@pytest.mark.parametrize("error_hz", [0.0, 5_000.0, -12_345.0])
def test_frequency_error(bench: Bench, error_hz: float) -> None:
    """RegFei decodes to the frequency error by the data sheet's formula."""
    bench.listen()
    frame = bench.port.send(b"abcd", frequency_error_hz=error_hz)
    bench.timeline.advance_to(frame.end_ns + frame.symbol_ns)
    fei = int.from_bytes(bench.chip.transfer(bytes([0x28, 0, 0, 0]))[1:], "big")
    signed = fei - 2**20 if fei & 0x80000 else fei
    assert signed * 2**24 / 32e6 * 125 / 500 == pytest.approx(error_hz, abs=0.1)


def test_implicit_header_sets_valid_header_with_rx_done(bench: Bench) -> None:
    """As the data sheet says."""
    bench.write(0x1D, 0x73)
    bench.write(0x22, 4)
    bench.listen()
    assert bench.port.listening is not None
    assert not bench.port.listening.modulation.explicit_header
    frame = bench.port.send(b"abcd")
    bench.timeline.advance_to(frame.end_ns)
    assert bench.read(FLAGS) == 0
    bench.timeline.advance_to(frame.end_ns + frame.symbol_ns)
    assert bench.read(FLAGS) == RX_DONE | VALID_HEADER
    assert bench.read(0x1C) & 0x40


@pytest.mark.parametrize(
    ("spreading_factor", "optimize", "threshold", "receives"),
    [(6, 0xC3, 0x0A, False), (6, 0xC5, 0x0A, False), (6, 0xC5, 0x0C, True), (7, 0xC5, 0x0C, False)],
)
def test_spreading_factor_6_needs_its_own_detection(
    bench: Bench,
    spreading_factor: int,
    optimize: int,
    threshold: int,
    receives: bool,  # noqa: FBT001
) -> None:
    """SF6 works with RegDetectOptimize 5 and RegDetectionThreshold 0x0C, no other does."""
    bench.write(0x1E, spreading_factor << 4)
    bench.write(0x1D, 0x73)
    bench.write(0x31, optimize)
    bench.write(0x37, threshold)
    bench.listen()
    assert (bench.port.listening is not None) is receives


def test_random_numbers(bench: Bench) -> None:
    """The lowest bit of RegRssiWideband is noise."""
    bench.listen()
    ones = sum(bench.read(0x2C) & 1 for _ in range(1000))
    assert 400 < ones < 600


def test_delayed_event_of_an_earlier_reception_is_ignored(bench: Bench) -> None:
    """Events from before the current reception, delayed by a socket, do not belong to it."""
    bench.listen()
    listening = bench.port.listening
    assert listening is not None
    frame = bench.port.send(b"abcd")
    bench.write(0x01, STDBY)
    bench.timeline.advance_to(frame.end_ns)
    bench.listen()
    bench.port.listener.preamble_detected(frame.start_ns)
    assert bench.read(MODEM_STAT) == 0b00100
    bench.port.listener.header_received(frame.header_end_ns, Header(4, 5, crc=True))
    bench.port.listener.frame_ended(frame.end_ns, Reception(b"abcd", True, Header(4, 5, True), 8, -60, 0))
    bench.timeline.advance(100_000_000)
    assert bench.read(FLAGS) == 0


# --- activity detection


@pytest.mark.parametrize("preamble", [True, False])
@pytest.mark.parametrize("spreading_factor", [7, 9, 12])
def test_activity_detection(spreading_factor: int, preamble: bool) -> None:  # noqa: FBT001
    """CAD takes about two symbols, finds a preamble or none, and ends in STDBY."""
    bench = Bench()
    bench.enter_lora(spreading_factor=spreading_factor)
    bench.port.preamble = preamble
    edges: list[int] = []
    bench.chip.on_dio(0, lambda at_ns, _: edges.append(at_ns))
    bench.write(0x40, 0x80)
    written_ns = bench.timeline.now_ns()
    bench.write(0x01, CAD)
    bench.timeline.advance(100_000_000)
    symbol_ns = 2**spreading_factor * 8_000
    assert 1.7 < (edges[0] - written_ns - 101_000) / symbol_ns < 2.3
    assert bench.read(FLAGS) == (CAD_DONE | CAD_DETECTED if preamble else CAD_DONE)
    assert bench.read(0x01) == STDBY
