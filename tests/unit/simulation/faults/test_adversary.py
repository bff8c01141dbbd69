"""The replay attacker: what it sends, and how often."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import numpy as np
from harness.radio.plain_radio import PlainRadio

from tsgt.simulation.kernel import VirtualClock
from tsgt.simulation.lora.adversary import MAX_NOISE_BYTES, ReplayAttacker

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

    from tsgt.radio import Radio

CAPTURED = [bytes([number]) * 10 for number in range(1, 5)]


async def _sent(per_s: float, captured: list[bytes], seconds: float) -> list[bytes]:
    clock = VirtualClock(0)
    radio, packets = PlainRadio(clock), list[bytes]()
    radio.on_sent = packets.append
    for payload in captured:
        radio.deliver(payload)

    @asynccontextmanager
    async def open_radio() -> AsyncGenerator[Radio]:
        yield radio

    attacker = ReplayAttacker(clock, np.random.default_rng(1), per_s)
    running = asyncio.create_task(attacker.run(open_radio))
    await clock.sleep_until(round(seconds * 1e9))
    running.cancel()
    await asyncio.wait([running])
    assert attacker.sent == len(packets)
    return packets


async def test_packet_rate() -> None:
    """Packets come at the given average rate, each after the end of the previous one."""
    packets = await _sent(2.0, [], 1000.0)
    assert 1000 / (0.5 + 0.05) * 0.93 < len(packets) < 1000 / (0.5 + 0.05) * 1.07


async def test_noise_without_captured_packets() -> None:
    """Random bytes of all lengths."""
    packets = await _sent(5.0, [], 200.0)
    assert {len(packet) for packet in packets} == set(range(1, MAX_NOISE_BYTES + 1))


def _bits_off(packet: bytes, payload: bytes) -> int:
    return sum((a ^ b).bit_count() for a, b in zip(packet, payload, strict=True))


async def test_captured_packets_are_replayed() -> None:
    """A quarter each: noise, unchanged packets, truncated packets, packets with one flipped bit."""
    packets = await _sent(5.0, CAPTURED, 400.0)
    whole = [packet for packet in packets if packet in CAPTURED]
    cut = [packet for packet in packets if len(packet) < 10 and any(p.startswith(packet) for p in CAPTURED)]
    flipped = [
        packet for packet in packets if len(packet) == 10 and 1 in {_bits_off(packet, p) for p in CAPTURED}
    ]
    assert len(packets) > 1200
    for kind in (whole, cut, flipped):
        assert 0.2 < len(kind) / len(packets) < 0.3
    assert set(whole) == set(CAPTURED)
    assert whole.count(CAPTURED[-1]) > len(whole) / 2
