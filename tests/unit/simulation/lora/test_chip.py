"""The simulated SX1276 beyond the conformance list: bus, transmission, pins, FSK mode, faults."""

from __future__ import annotations

import asyncio
import time

import numpy as np
import pytest
from harness.hardware.chips import (
    CAD,
    FSRX,
    FSTX,
    NO_JITTER,
    RXCONTINUOUS,
    RXSINGLE,
    SLEEP,
    STDBY,
    TX,
    Bench,
    FakePort,
)
from hypothesis import given
from hypothesis import strategies as st

from tsgt.simulation.kernel import LoopTimeline, VirtualTimeline
from tsgt.simulation.lora import SX1276Chip

FLAGS, TX_DONE = 0x12, 0x08


@pytest.fixture
def bench() -> Bench:
    """Return a chip in LoRa standby."""
    bench = Bench()
    bench.enter_lora()
    return bench


# --- the bus


def test_access_may_be_split_into_bytes(bench: Bench) -> None:
    """Address and data may be exchanged byte by byte while NSS is low; each write takes effect at its byte."""
    bench.chip.select()
    assert bench.chip.exchange(0x80 | 0x39) == 0x00
    assert bench.chip.exchange(0x34) == 0x12
    assert bench.chip.exchange(0x99) == 0x65
    bench.chip.deselect()
    assert bench.read(0x39) == 0x34
    assert bench.read(0x3A) == 0x99


@given(st.lists(st.binary(min_size=1, max_size=20), min_size=1, max_size=12))
def test_transfer_equals_bytewise_exchange(windows: list[bytes]) -> None:
    """Also across the ends of registers and FIFO."""
    at_once, one_by_one = Bench(), Bench()
    for bench in (at_once, one_by_one):
        bench.enter_lora()
    for data in windows:
        one_by_one.chip.select()
        expected = bytes(map(one_by_one.chip.exchange, data))
        one_by_one.chip.deselect()
        assert at_once.chip.transfer(data) == expected
        assert at_once.chip.warnings == one_by_one.chip.warnings


def test_nothing_is_exchanged_without_chip_select(bench: Bench) -> None:
    """Traffic for another chip on the bus is ignored."""
    for byte in (0x80 | 0x39, 0x34):
        assert bench.chip.exchange(byte) == 0x00
    assert bench.read(0x39) == 0x12


def test_power_on_values() -> None:
    """Registers of both pages have the data sheet's reset values."""
    bench = Bench()
    common = {0x06: 0x6C, 0x07: 0x80, 0x09: 0x4F, 0x0A: 0x09, 0x0B: 0x2B, 0x0C: 0x20, 0x44: 0x2D, 0x4D: 0x84}
    for address, value in (common | {0x24: 0x05, 0x39: 0xF5, 0x3B: 0x82}).items():
        assert bench.read(address) == value
    bench.write(0x01, 0x00)
    bench.write(0x01, 0x81)
    lora = {0x0E: 0x80, 0x1D: 0x72, 0x1E: 0x70, 0x1F: 0x64, 0x21: 0x08, 0x22: 0x01, 0x23: 0xFF, 0x31: 0xC3}
    for address, value in (common | lora | {0x33: 0x27, 0x37: 0x0A, 0x39: 0x12, 0x3B: 0x1D}).items():
        assert bench.read(address) == value


def test_image_calibration_completes_immediately() -> None:
    """The start bit clears itself."""
    bench = Bench()
    bench.write(0x3B, 0xC2)
    assert bench.read(0x3B) == 0x82


# --- the start of a frame on the air


@pytest.mark.parametrize(
    ("modes", "delay_ns"), [((TX,), 180_000), ((FSTX, TX), 120_000), ((SLEEP, TX), 430_000)]
)
def test_frame_starts_after_oscillator_synthesizer_and_ramp(
    bench: Bench, modes: tuple[int, ...], delay_ns: int
) -> None:
    """From STDBY a frame starts 180 us after the write, from SLEEP 250 us later, from FSTX 60 us earlier."""
    for mode in modes:
        bench.write(0x01, mode)
    written_ns = bench.timeline.now_ns()
    bench.timeline.advance(1_000_000)
    assert bench.port.frames[0].start_ns == written_ns + delay_ns


def test_standby_does_not_speed_up_the_oscillator(bench: Bench) -> None:
    """STDBY on the way from SLEEP does not shorten the oscillator's start."""
    bench.write(0x01, SLEEP)
    woken_ns = bench.timeline.now_ns()
    bench.write(0x01, STDBY)
    bench.timeline.advance(100_000)
    bench.write(0x01, TX)
    bench.timeline.advance(1_000_000)
    assert bench.port.frames[0].start_ns == woken_ns + 250_000 + 180_000


@pytest.mark.parametrize("after_ns", [100_000, 20_000_000])
def test_standby_aborts_a_transmission(bench: Bench, after_ns: int) -> None:
    """The frame is cut, or never starts, and there is no TxDone."""
    bench.write(0x01, TX)
    bench.timeline.advance(after_ns)
    bench.write(0x01, STDBY)
    aborted_ns = bench.timeline.now_ns()
    bench.timeline.advance(1_000_000_000)
    assert bench.port.stopped_ns == ([aborted_ns] if bench.port.frames else [])
    assert bool(bench.port.frames) is (after_ns > 180_000)
    assert bench.read(FLAGS) == 0


def test_continuous_transmission(bench: Bench) -> None:
    """With TxContinuousMode frames follow each other until the mode changes."""
    bench.write(0x1E, 0x7C)
    bench.write(0x01, TX)
    bench.timeline.advance(200_000_000)
    first, second, *_ = bench.port.frames
    assert second.start_ns == first.end_ns
    assert bench.read(0x01) == TX
    assert bench.read(FLAGS) == 0


def test_frame_settings_come_from_the_registers(bench: Bench) -> None:
    """Modulation, coding, preamble and power."""
    bench.write(0x06, 0xD9, 0x06, 0x66)
    bench.write(0x1D, 0x94)
    bench.write(0x1E, 0xC4)
    bench.write(0x20, 0x01, 0x02)
    bench.write(0x26, 0x08)
    bench.write(0x33, 0x66)
    bench.write(0x39, 0x34)
    bench.write(0x09, 0x8C)
    frame = bench.transmit(b"abc")
    assert frame.modulation.frequency_hz == pytest.approx(868.1e6, abs=61)
    assert frame.modulation.bandwidth_hz == 500_000
    assert frame.modulation.spreading_factor == 12
    assert frame.modulation.sync_word == 0x34
    assert frame.modulation.inverted_iq
    assert frame.modulation.low_data_rate
    assert frame.modulation.explicit_header
    assert frame.coding_rate == 6
    assert frame.crc
    assert frame.preamble_symbols == 0x102
    assert frame.power_dbm == 14.0


@pytest.mark.parametrize(
    ("pa_config", "pa_dac", "power_dbm"),
    [(0x80, 0x84, 2), (0x8F, 0x84, 17), (0x8F, 0x87, 20), (0xFF, 0x07, 20), (0x4F, 0x84, -26.8)],
)
def test_output_power(bench: Bench, pa_config: int, pa_dac: int, power_dbm: float) -> None:
    """PA_BOOST gives 2 to 17 dBm, 20 with RegPaDac; RFO is not connected and only leaks."""
    bench.write(0x09, pa_config)
    bench.write(0x4D, pa_dac)
    assert bench.transmit(b"x").power_dbm == pytest.approx(power_dbm)


def test_carrier_takes_effect_with_its_last_byte(bench: Bench) -> None:
    """RegFrfMsb and Mid alone change nothing."""
    bench.write(0x06, 0xE2, 0x40)
    assert bench.transmit(b"x").modulation.frequency_hz == 434e6
    bench.write(0x08, 0x00)
    assert bench.transmit(b"x").modulation.frequency_hz == 905e6


# --- pins


@pytest.mark.parametrize(
    ("pin", "mapping", "mode"), [(1, 0x00, RXSINGLE), (1, 0x20, CAD), (3, 0x00, CAD), (4, 0x00, CAD)]
)
def test_other_pins(bench: Bench, pin: int, mapping: int, mode: int) -> None:
    """DIO1 shows RxTimeout or CadDetected, DIO3 CadDone, DIO4 CadDetected."""
    bench.port.preamble = True
    bench.write(0x1F, 8)
    bench.write(0x40, mapping)
    bench.write(0x01, mode)
    assert not bench.chip.dio(pin)
    bench.timeline.advance(1_000_000_000)
    assert bench.chip.dio(pin)


@pytest.mark.parametrize(("mapping", "crc_ok"), [(0x01, True), (0x02, False)])
def test_header_and_checksum_on_dio3(bench: Bench, mapping: int, crc_ok: bool) -> None:  # noqa: FBT001
    """DIO3 shows ValidHeader with mapping 01 and PayloadCrcError with 10."""
    bench.write(0x40, mapping)
    bench.listen()
    assert not bench.chip.dio(3)
    bench.receive(b"abcd", crc_ok=crc_ok)
    assert bench.chip.dio(3)


def test_state_on_dio4_and_dio5(bench: Bench) -> None:
    """DIO4 with 01 is PllLock, DIO5 with 00 ModeReady."""
    bench.write(0x41, 0x40)
    assert (bench.chip.dio(4), bench.chip.dio(5)) == (False, True)
    bench.write(0x01, FSRX)
    assert (bench.chip.dio(4), bench.chip.dio(5)) == (False, False)
    bench.timeline.advance(60_000)
    assert (bench.chip.dio(4), bench.chip.dio(5)) == (True, True)


def test_in_real_time_edges_carry_their_exact_time() -> None:
    """On an asyncio loop callbacks are late, but their time argument is the chip's."""

    async def main() -> None:
        timeline = LoopTimeline(asyncio.get_running_loop())
        port = FakePort(VirtualTimeline())
        chip = SX1276Chip(timeline, port.join, np.random.default_rng(1), timing=NO_JITTER)
        edge: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        chip.on_dio(0, lambda at_ns, _level: edge.set_result(at_ns))
        for address, value in ((0x01, 0x00), (0x01, SLEEP), (0x01, STDBY), (0x1D, 0x92), (0x40, 0x40)):
            chip.transfer(bytes([0x80 | address, value]))
        before_ns = time.monotonic_ns()
        chip.transfer(bytes([0x81, TX]))
        at_ns = await edge
        assert at_ns == port.frames[0].end_ns + 67_000
        assert port.frames[0].start_ns - before_ns < 10_000_000

    asyncio.run(main())


# --- FSK mode and faults


def test_fsk_mode_sends_nothing() -> None:
    """FSK mode is not simulated, which is warned about."""
    bench = Bench()
    bench.write(0x01, 0x0B)
    bench.timeline.advance(1_000_000_000)
    assert bench.read(0x01) == 0x0B
    assert not bench.port.frames
    assert "FSK" in bench.chip.warnings[0]


@pytest.mark.parametrize(("level", "answer"), [(False, 0x00), (True, 0xFF)])
def test_disconnected_bus(bench: Bench, level: bool, answer: int) -> None:  # noqa: FBT001
    """MISO stays at one level and writes have no effect, also after a reset."""
    bench.chip.disconnect_bus(level)
    assert bench.read(0x42) == answer
    bench.write(0x39, 0x34)
    bench.chip.set_reset(True)
    bench.chip.set_reset(False)
    assert bench.read(0x42) == answer
    bench.chip.reconnect_bus()
    assert bench.read(0x42) == 0x12


def test_supply_dip_resets_the_chip(bench: Bench) -> None:
    """Registers are as after power-on, reception ends, and the pin falls."""
    bench.listen()
    bench.receive(b"abcd")
    levels: list[bool] = []
    bench.chip.on_dio(0, lambda _, level: levels.append(level))
    bench.chip.power_on_reset()
    assert bench.read(0x01) == 0x09
    assert bench.port.listening is None
    assert levels == [False]


def test_hung_chip_ignores_writes_until_a_reset(bench: Bench) -> None:
    """It can be read but does nothing."""
    bench.write(0x01, TX)
    bench.timeline.advance(1_000_000)
    bench.chip.hang()
    bench.timeline.advance(1_000_000_000)
    bench.write(0x01, STDBY)
    assert bench.read(0x01) == TX
    assert bench.read(FLAGS) == 0
    assert bench.port.stopped_ns
    bench.chip.set_reset(True)
    bench.timeline.advance(1_000_000)
    bench.chip.set_reset(False)
    bench.timeline.advance(10_000_000)
    bench.enter_lora()
    bench.transmit(b"abcd")
    assert bench.read(FLAGS) == TX_DONE


def test_suppressed_tx_done(bench: Bench) -> None:
    """The frame is sent, the chip stays in TX without a flag, and the next one is normal."""
    bench.chip.drop_tx_done()
    frame = bench.transmit(b"abcd")
    bench.timeline.advance(1_000_000_000)
    assert frame.payload == b"abcd"
    assert bench.read(0x01) == TX
    assert bench.read(FLAGS) == 0
    bench.write(0x01, STDBY)
    assert not bench.port.stopped_ns
    bench.transmit(b"efgh")
    assert bench.read(FLAGS) == TX_DONE


def test_random_bus_traffic_is_harmless() -> None:
    """Ten thousand random accesses raise nothing, and after a reset the chip transmits normally."""
    rng = np.random.default_rng(7)
    bench = Bench()
    for _ in range(10_000):
        bench.chip.transfer(rng.bytes(int(rng.integers(1, 5))))
        if rng.random() < 0.3:
            bench.chip.transfer(
                bytes([0x81, int(rng.choice([SLEEP, STDBY, TX, RXCONTINUOUS, RXSINGLE, CAD]))])
            )
        bench.timeline.advance(int(rng.exponential(1e6)))
        if bench.port.listening is not None and rng.random() < 0.2:
            bench.port.send(rng.bytes(int(rng.integers(1, 256))))
    assert bench.port.frames
    bench.chip.set_reset(True)
    bench.chip.set_reset(False)
    bench.enter_lora()
    bench.write(FLAGS, 0xFF)
    assert bench.transmit(b"abcd").payload == b"abcd"
    assert bench.read(FLAGS) == TX_DONE
