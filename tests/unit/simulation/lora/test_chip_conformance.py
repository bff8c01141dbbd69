"""Conformance list for simulated chips (docs/explanation/simulated-radio.md), points 1 to 6, 13, 19, 20: bus, registers, transmission.

Points 7, 17 and 18 are in test_chip_conformance_timing.py, 8 to 12 and 14 in test_chip_conformance_receiving.py, 15 and
16 in test_air_conformance.py.
"""

from __future__ import annotations

import pytest
from harness.hardware.chips import CAD, RXCONTINUOUS, RXSINGLE, SLEEP, STDBY, TX, Bench

MASK, FLAGS = 0x11, 0x12
RX_DONE, CRC_ERROR, VALID_HEADER, TX_DONE = 0x40, 0x20, 0x10, 0x08


@pytest.fixture
def bench() -> Bench:
    """Return a chip in LoRa standby."""
    bench = Bench()
    bench.enter_lora()
    return bench


# 1: the gate of LongRangeMode


def test_conformance_01_long_range_mode_changes_in_sleep_only() -> None:
    """From FSK standby 0x80 gives 0x00, and then 0x81 gives LoRa standby (LoRaRF's way)."""
    bench = Bench()
    assert bench.read(0x01) == 0x09
    bench.write(0x01, 0x80)
    assert bench.read(0x01) == 0x00
    bench.write(0x01, 0x81)
    assert bench.read(0x01) == 0x81


def test_conformance_01_leaving_lora_takes_sleep_too(bench: Bench) -> None:
    """LoRa standby written without bit 7 stays LoRa; sleep first, and it goes."""
    bench.write(0x01, 0x01)
    assert bench.read(0x01) == 0x81
    bench.write(0x01, 0x00)
    assert bench.read(0x01) == 0x80
    bench.write(0x01, 0x00)
    assert bench.read(0x01) == 0x00


# 2: pages


def test_conformance_02_settings_written_in_fsk_mode_do_not_reach_lora() -> None:
    """Registers from 0x0D to 0x3F exist twice; the others are common."""
    bench = Bench()
    bench.write(0x1D, 0x99)
    bench.write(0x0A, 0x07)
    bench.write(0x40, 0x12)
    bench.enter_lora()
    assert bench.read(0x1D) == 0x72
    assert bench.read(0x0A) == 0x07
    assert bench.read(0x40) == 0x12


def test_conformance_02_access_shared_reg_shows_the_fsk_page(bench: Bench) -> None:
    """With bit 6 of RegOpMode the FSK page is visible in LoRa mode; the LoRa page is unchanged afterwards."""
    bench.write(0x39, 0x34)
    bench.write(0x01, 0xC1)
    assert bench.read(0x01) == 0xC1
    assert bench.read(0x39) == 0xF5
    bench.write(0x39, 0x77)
    bench.write(0x01, 0x81)
    assert bench.read(0x39) == 0x34


# 3: FIFO


def test_conformance_03_a_burst_stays_at_address_zero_and_moves_the_pointer(bench: Bench) -> None:
    """Writing and reading the FIFO moves RegFifoAddrPtr, byte by byte, and touches no other register."""
    bench.write(0x0D, 0x20)
    bench.write(0x00, 1, 2, 3)
    assert bench.read(0x0D) == 0x23
    assert bench.read(0x01) == 0x81
    bench.write(0x0D, 0x20)
    assert bench.chip.transfer(bytes(4))[1:] == bytes([1, 2, 3])
    assert bench.read(0x0D) == 0x23


def test_conformance_03_the_pointer_wraps(bench: Bench) -> None:
    """After 255 comes 0."""
    bench.write_fifo(0xFE, b"abcd")
    assert bench.read(0x0D) == 2
    assert bench.read_fifo(0xFE, 4) == b"abcd"
    assert bench.read_fifo(0x00, 2) == b"cd"


def test_conformance_03_other_addresses_increment(bench: Bench) -> None:
    """A burst over registers goes from one to the next; MISO shows the old values while writing."""
    assert bench.chip.transfer(bytes([0x86, 1, 2, 3])) == bytes([0, 0x6C, 0x80, 0x00])
    assert bench.chip.transfer(bytes([0x06, 0, 0, 0])) == bytes([0, 1, 2, 3])


def test_conformance_03_fifo_is_inaccessible_in_sleep(bench: Bench) -> None:
    """In SLEEP the FIFO reads as zeros, ignores writes, and loses its content."""
    bench.write_fifo(0, b"abc")
    bench.write(0x01, SLEEP)
    bench.write_fifo(0, b"xyz")
    assert bench.read_fifo(0, 3) == bytes(3)
    bench.write(0x01, STDBY)
    assert bench.read_fifo(0, 3) not in (b"abc", b"xyz")


# 4 and 5: sending


def test_conformance_04_payload_starts_at_tx_base(bench: Bench) -> None:
    """The payload is taken from FifoTxBaseAddr, 0x80 after a reset, wherever the pointer is."""
    bench.write_fifo(0x00, b"wrong place")
    bench.write_fifo(0x80, b"right")
    bench.write(0x0D, 0x00)
    bench.write(0x22, 5)
    bench.write(0x01, TX)
    bench.timeline.advance(1_000_000)
    assert bench.port.frames[0].payload == b"right"


def test_conformance_04_payload_wraps(bench: Bench) -> None:
    """A payload near the end of the FIFO continues at its start, and stays in the FIFO."""
    assert bench.transmit(b"0123456789", base=0xFB).payload == b"0123456789"
    assert bench.read_fifo(0x00, 5) == b"56789"


@pytest.mark.parametrize("low_frequency_bit", [0x00, 0x08])
def test_conformance_05_standby_after_tx_done(bench: Bench, low_frequency_bit: int) -> None:
    """RegOpMode reads TX until TxDone, then STDBY; bit 3 stays."""
    bench.write(0x01, STDBY | low_frequency_bit)
    bench.write(0x01, TX | low_frequency_bit)
    bench.timeline.advance(1_000_000)
    frame = bench.port.frames[0]
    bench.timeline.advance_to(frame.end_ns + 66_000)
    assert bench.read(0x01) == TX | low_frequency_bit
    assert not bench.read(FLAGS)
    bench.timeline.advance(2_000)
    assert bench.read(0x01) == STDBY | low_frequency_bit
    assert bench.read(FLAGS) == TX_DONE


# 6: flags


def test_conformance_06_flags_are_sticky_and_cleared_by_ones(bench: Bench) -> None:
    """A flag stays until a one is written to its bit; zeros leave flags alone; ones set nothing."""
    bench.listen()
    bench.receive(b"abcd")
    assert bench.read(FLAGS) == RX_DONE | VALID_HEADER
    bench.write(FLAGS, RX_DONE)
    assert bench.read(FLAGS) == VALID_HEADER
    bench.receive(b"efgh", crc_ok=False)
    assert bench.read(FLAGS) == RX_DONE | VALID_HEADER | CRC_ERROR
    bench.write(FLAGS, 0x00)
    assert bench.read(FLAGS) == RX_DONE | VALID_HEADER | CRC_ERROR
    bench.write(FLAGS, 0xFF)
    assert bench.read(FLAGS) == 0x00


def test_conformance_06_masked_flags_are_not_set(bench: Bench) -> None:
    """A masked flag neither shows in RegIrqFlags nor on DIO."""
    bench.write(MASK, RX_DONE)
    bench.listen()
    bench.receive(b"abcd")
    assert bench.read(FLAGS) == VALID_HEADER
    assert not bench.chip.dio(0)


def test_conformance_06_masking_a_flag_that_is_set_lowers_its_pin(bench: Bench) -> None:
    """DIO follows flag and mask."""
    bench.listen()
    bench.receive(b"abcd")
    assert bench.chip.dio(0)
    bench.write(MASK, RX_DONE)
    assert not bench.chip.dio(0)


# 13: version and reset


def test_conformance_13_version_and_reset() -> None:
    """The version is 0x12; held in reset the chip reads as 0x00; afterwards all is as after power-on."""
    bench = Bench()
    bench.enter_lora()
    bench.write(0x39, 0x34)
    assert bench.read(0x42) == 0x12
    bench.chip.set_reset(True)
    assert bench.read(0x42) == 0x00
    bench.timeline.advance(1_000_000)
    bench.chip.set_reset(False)
    bench.timeline.advance(5_000_000)
    assert bench.read(0x42) == 0x12
    assert bench.read(0x01) == 0x09
    bench.enter_lora()
    assert bench.read(0x39) == 0x12
    assert not bench.chip.warnings


def test_conformance_13_reset_aborts_all_operations(bench: Bench) -> None:
    """A reset cuts the frame on the air, lowers the pins and stops the receiver."""
    bench.write(0x01, TX)
    bench.timeline.advance(1_000_000)
    bench.chip.set_reset(True)
    bench.timeline.advance(1_000_000_000)
    bench.chip.set_reset(False)
    assert bench.port.stopped_ns == [bench.timeline.now_ns() - 1_000_000_000]
    assert not bench.chip.dio(0)
    assert bench.port.listening is None


# 19: read-back


def test_conformance_19_writable_registers_read_back(bench: Bench) -> None:
    """Every writable register holds every value written to it."""
    # The FIFO, the mode and the flags have rules of their own; these others belong to the modem.
    not_plain = {0x00, 0x01, 0x10, *range(0x12, 0x1D), 0x25, 0x28, 0x29, 0x2A, 0x2C, 0x42, 0x5B}
    for address in set(range(0x80)) - not_plain:
        for value in (0xFF, 0x00, 0xA5, 0x5A):
            bench.write(address, value)
            assert bench.read(address) == value, f"register {address:#04x}"


def test_conformance_19_read_only_registers_ignore_writes(bench: Bench) -> None:
    """Status registers cannot be overwritten."""
    bench.listen()
    bench.receive(b"abcd")
    bench.write(0x01, STDBY)
    for address in (0x10, *range(0x13, 0x1D), 0x25, 0x28, 0x29, 0x2A, 0x42):
        before = bench.read(address)
        bench.write(address, before ^ 0xFF)
        assert bench.read(address) == before, f"register {address:#04x}"


@pytest.mark.parametrize("mode", [TX, RXCONTINUOUS, RXSINGLE, CAD])
def test_conformance_19_op_mode_reads_back_at_once(bench: Bench, mode: int) -> None:
    """The mode reads as requested from the write on, before the chip has got there."""
    bench.write(0x01, mode)
    assert bench.read(0x01) == mode


# 20: misuse


def test_conformance_20_proper_use_gives_no_warning(bench: Bench) -> None:
    """Transmission and reception within the data sheet's limits."""
    bench.transmit(b"abcd")
    bench.listen()
    bench.receive(b"abcd")
    bench.chip.set_sck(10_000_000)
    assert bench.chip.warnings == []


@pytest.mark.parametrize(
    ("registers", "warning"),
    [
        (((0x1E, 0x64), (0x31, 0xC5), (0x37, 0x0C)), "SF6 with explicit header"),
        (((0x1E, 0x64), (0x1D, 0x73)), "DetectOptimize"),
        (((0x22, 0),), "PayloadLength 0"),
        (((0x21, 5),), "preamble of 5 symbols"),
        (((0x1E, 0xB4),), "LowDataRateOptimize off at SF11"),
        (((0x26, 0x08),), "LowDataRateOptimize on at SF7"),
        (((0x24, 5),), "hopping"),
        (((0x1D, 0xF2),), "undefined bandwidth"),
    ],
)
def test_conformance_20_illegal_settings_give_a_warning(
    bench: Bench, registers: tuple[tuple[int, int], ...], warning: str
) -> None:
    """A setting that the data sheet forbids gives one warning when it is used."""
    for address, value in registers:
        bench.write(address, value)
    assert not bench.chip.warnings
    for _ in range(2):
        bench.write(0x01, TX)
        bench.timeline.advance(1_000_000_000)
        bench.write(0x01, STDBY)
    assert len(bench.chip.warnings) == 1
    assert warning in bench.chip.warnings[0]


def test_conformance_20_carrier_change_while_receiving_gives_a_warning(bench: Bench) -> None:
    """RegFrf may be written in SLEEP and STDBY only, unless FastHopOn is set."""
    bench.listen()
    bench.write(0x44, 0xAD)
    bench.write(0x06, 0xE2, 0x40, 0x00)
    assert not bench.chip.warnings
    bench.write(0x44, 0x2D)
    bench.write(0x06, 0xE2, 0x40, 0x00)
    assert "RegFrf" in bench.chip.warnings[0]


def test_conformance_20_misuse_of_bus_and_pins_gives_a_warning(bench: Bench) -> None:
    """FIFO access in SLEEP, a bus clock that is too fast, a reset that is too short or not waited for."""
    bench.write(0x01, SLEEP)
    bench.read(0x00)
    bench.chip.set_sck(20_000_000)
    bench.chip.set_reset(True)
    bench.timeline.advance(50_000)
    bench.chip.set_reset(False)
    bench.read(0x42)
    fifo, clock, pulse, wait = bench.chip.warnings
    assert "FIFO" in fifo
    assert "10 MHz" in clock
    assert "100 us" in pulse
    assert "5 ms" in wait
