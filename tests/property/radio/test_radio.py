"""The simulated chip survives any bus access, and the driver any packets."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
from harness.files.damage import examples
from harness.hardware.chips import Bench
from harness.hardware.radios import PAPER, make_side, running_timeline
from hypothesis import given
from hypothesis import strategies as st

from tsgt.simulation.kernel import VirtualTimeline, run_virtual
from tsgt.simulation.lora import Air, LinkModel, SX1276Chip
from tsgt.simulation.lora.frames import Frame, Header, Modulation, Reception

MS = 1_000_000

# --- arbitrary traffic on the bus

OP_MODE, FIFO = 0x01, 0x00
VERSION = 0x42

addresses = st.one_of(
    st.integers(0, 0x7F), st.sampled_from([FIFO, OP_MODE, 0x0D, 0x11, 0x12, 0x1D, 0x1E, 0x22, 0x40])
)
modes = st.sampled_from([*range(0x80, 0x90), *range(0x08), 0xC5])
writes = st.builds(
    lambda address, data: bytes([0x80 | address]) + data, addresses, st.binary(min_size=1, max_size=20)
)
mode_writes = st.builds(lambda mode: bytes([0x80 | OP_MODE, mode]), modes)
reads = st.builds(lambda address, count: bytes([address]) + bytes(count), addresses, st.integers(0, 20))
bus_actions = st.one_of(
    st.tuples(
        st.just("transfer"), st.one_of(writes, mode_writes, mode_writes, reads, st.binary(max_size=300))
    ),
    st.tuples(st.just("exchange"), st.integers(0, 255)),
    st.tuples(st.just("select"), st.booleans()),
    st.tuples(st.just("reset_us"), st.integers(0, 200)),
    st.tuples(st.just("wait_us"), st.integers(0, 300_000)),
    st.tuples(st.just("send"), st.binary(min_size=1, max_size=255)),
    st.tuples(st.just("receive"), st.binary(min_size=1, max_size=255)),
)


@examples(200)
@given(actions=st.lists(bus_actions, min_size=5, max_size=40))
@pytest.mark.slow
def test_arbitrary_bus_traffic_never_breaks_the_chip(actions: list[tuple[str, object]]) -> None:
    """After any bus access and reset every register reads, and a reset restores a working chip."""
    timeline = VirtualTimeline()
    air = Air(timeline, np.random.default_rng(0), LinkModel())
    chip, peer = (
        SX1276Chip(timeline, partial(air.join, name=name), np.random.default_rng(0))
        for name in ("chip", "peer")
    )
    levels: list[bool] = []
    chip.on_dio(0, lambda _at_ns, level: levels.append(level))
    _enter_lora(peer, timeline)
    for action, value in actions:
        match action, value:
            case "transfer", bytes():
                assert len(chip.transfer(value)) == len(value)
            case "exchange", int():
                assert 0 <= chip.exchange(value) <= 0xFF
            case "select", bool():
                (chip.select if value else chip.deselect)()
            case "reset_us", int():
                chip.set_reset(True)
                timeline.advance(value * 1000)
                chip.set_reset(False)
            case "wait_us", int():
                timeline.advance(value * 1000)
            case "send", bytes():
                _enter_lora(chip, timeline)
                _start_sending(chip, value)
                timeline.advance(MS)
            case "receive", bytes():
                _enter_lora(chip, timeline)
                chip.transfer(b"\x81\x85")
                timeline.advance(MS)
                _start_sending(peer, value)
                timeline.advance(30 * MS)
    assert all(0 <= chip.transfer(bytes([address, 0]))[1] <= 0xFF for address in range(0x80))
    assert all(levels[n] != levels[n + 1] for n in range(len(levels) - 1))

    _reset(chip, timeline)
    fresh = Bench()
    for address in set(range(1, 0x80)) - {0x1B, 0x2C}:  # all but the two that read what is on the channel
        assert chip.transfer(bytes([address, 0]))[1] == fresh.read(address), f"register {address:#04x}"
    _reset(peer, timeline)
    _enter_lora(chip, timeline)
    _enter_lora(peer, timeline)
    for sender, receiver in ((chip, peer), (peer, chip)):
        receiver.transfer(b"\x92\xff")
        receiver.transfer(b"\x81\x85")
        timeline.advance(MS)
        _start_sending(sender, b"as good as new")
        timeline.advance(100 * MS)
        assert receiver.transfer(bytes([0x12, 0]))[1] == 0x50, "RxDone and ValidHeader"
        start = receiver.transfer(bytes([0x10, 0]))[1]
        receiver.transfer(bytes([0x8D, start]))
        assert receiver.transfer(bytes(15))[1:] == b"as good as new"
        receiver.transfer(b"\x81\x81")


def _reset(chip: SX1276Chip, timeline: VirtualTimeline) -> None:
    chip.deselect()
    chip.set_reset(True)
    timeline.advance(MS)
    chip.set_reset(False)
    timeline.advance(10 * MS)
    assert chip.transfer(bytes([VERSION, 0]))[1] == 0x12


def _enter_lora(chip: SX1276Chip, timeline: VirtualTimeline) -> None:
    """From a reset to LoRa STDBY at the chip's own settings, with CRC."""
    for value in (0x00, 0x80, 0x81):
        chip.transfer(bytes([0x80 | OP_MODE, value]))
    chip.transfer(b"\x9e\x74")
    timeline.advance(MS)


def _start_sending(chip: SX1276Chip, payload: bytes) -> None:
    chip.transfer(b"\x81\x81")
    chip.transfer(b"\x92\xff")
    chip.transfer(b"\x8d\x80")
    chip.transfer(b"\x80" + payload)
    chip.transfer(bytes([0xA2, len(payload)]))
    chip.transfer(b"\x81\x83")


# --- arbitrary packets on the air


@dataclass(frozen=True)
class Sent:
    """A packet of one of the others: how long after the one before it starts, and what it is."""

    after_us: int
    sender: int
    frame: Frame


@dataclass(frozen=True)
class OwnPacket:
    """A packet that our driver sends amid the others."""

    after_us: int
    payload: bytes


OURS = Modulation(
    frequency_hz=float(PAPER.frequency_hz),
    spreading_factor=PAPER.spreading_factor,
    bandwidth_hz=float(PAPER.bandwidth_hz),
    inverted_iq=False,
    sync_word=PAPER.sync_word,
    explicit_header=True,
    low_data_rate=False,
)
SENDERS = 3

# Most packets are such as the driver takes; the others differ in one thing.
modulations = st.one_of(
    *[st.just(OURS)] * 12,
    st.builds(partial(replace, OURS), sync_word=st.integers(0, 255)),
    st.builds(partial(replace, OURS), spreading_factor=st.integers(7, 12)),
    st.builds(partial(replace, OURS), bandwidth_hz=st.sampled_from([125_000.0, 500_000.0])),
    st.builds(partial(replace, OURS), frequency_hz=st.floats(904.8e6, 905.2e6)),
    st.builds(partial(replace, OURS), inverted_iq=st.booleans()),
    st.builds(partial(replace, OURS), explicit_header=st.booleans()),
    st.builds(partial(replace, OURS), low_data_rate=st.booleans()),
)
# 80 dB of loss and noise at -113.5 dBm: at -46 dBm most of the packets of SF 9 arrive, at -49 dBm few.
powers_dbm = st.sampled_from([17.0, 10.0, 10.0, 10.0, -46.0, -47.0, -48.0, -49.0, -52.0])
frames = st.builds(
    Frame,
    modulation=modulations,
    coding_rate=st.integers(5, 8),
    crc=st.sampled_from([True, True, False]),
    preamble_symbols=st.sampled_from([6, 8, 8, 8, 10, 30]),
    payload=st.one_of(st.binary(min_size=1, max_size=30), st.integers(100, 255).map(bytes)),
    power_dbm=powers_dbm,
    start_ns=st.just(0),
)
pauses_us = st.one_of(st.integers(0, 400_000), st.integers(0, 8).map(lambda steps: steps * 50_000))
sent = st.builds(Sent, pauses_us, st.integers(0, SENDERS - 1), frames)
air_actions = st.one_of(
    sent, sent, sent, st.builds(OwnPacket, pauses_us, st.binary(min_size=1, max_size=255))
)


@examples(150)
@given(actions=st.lists(air_actions, min_size=3, max_size=25))
@pytest.mark.slow
def test_arbitrary_packets_never_break_the_driver(actions: list[Sent | OwnPacket]) -> None:
    """After any packets, bursts and collisions the driver receives a valid one; all delivered packets were sent."""

    async def run() -> None:
        timeline = running_timeline()
        air = Air(timeline, np.random.default_rng(0), LinkModel())
        others = [air.join(_Deaf(), f"other {number}") for number in range(SENDERS)]
        ours = make_side(air, "ours")
        await ours.radio.start(PAPER)
        trusted = set()
        busy_until_ns = 0
        for action in actions:
            await asyncio.sleep(action.after_us / 1e6)
            if isinstance(action, OwnPacket):
                await ours.radio.transmit(action.payload)
                continue
            frame = replace(action.frame, start_ns=timeline.now_ns())
            others[action.sender].transmit(frame)
            busy_until_ns = max(busy_until_ns, frame.end_ns)
            if frame.crc:
                trusted.add(frame.payload)
        await asyncio.sleep(max(0, busy_until_ns - timeline.now_ns()) / 1e9 + 0.1)
        received = [await ours.radio.receive() for _ in range(ours.radio.statistics.received)]
        assert {packet.payload for packet in received} <= trusted

        good = Frame(
            OURS, 6, crc=True, preamble_symbols=8, payload=b"good", power_dbm=10.0, start_ns=timeline.now_ns()
        )
        others[0].transmit(good)
        packet = await asyncio.wait_for(ours.radio.receive(), 1)
        assert packet.payload == b"good"
        await ours.radio.close()
        statistics = ours.radio.statistics
        assert (statistics.lost_edges, statistics.tx_timeouts, statistics.resets) == (0, 0, 0)

    run_virtual(run)


class _Deaf:
    """The antenna of a radio that only sends."""

    def preamble_detected(self, at_ns: int) -> None:
        """Ignore it."""

    def header_received(self, at_ns: int, header: Header) -> None:
        """Ignore it."""

    def frame_ended(self, at_ns: int, reception: Reception | None) -> None:
        """Ignore it."""
