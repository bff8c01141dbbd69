"""The real driver on simulated chips: host delays and timestamp jitter."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest
from harness.hardware.radios import MS, PAPER, running_timeline

from tsgt.simulation.kernel import VirtualClock
from tsgt.simulation.lora import Air, HostDelay, LinkModel, TimestampJitter, radio_opener

PACKETS = 400


async def _starts_ms(delay: HostDelay, *, lead_ns: int) -> list[float]:
    """Schedule a packet each second, with this lead time; return how late each started."""
    clock, late_ms = VirtualClock(0), []
    air = Air(running_timeline(), np.random.default_rng(0), LinkModel())
    async with radio_opener(air, "here", clock, np.random.default_rng(1), PAPER, delay)() as radio:
        for second in range(1, PACKETS + 1):
            at_ns = second * 1000 * MS
            await clock.sleep_until(at_ns - lead_ns)
            late_ms.append(((await radio.transmit(b"x", at_ns=at_ns)).started_at_ns - at_ns) / MS)
    return late_ms


async def test_host_wake_up_is_late() -> None:
    """A transmission prepared in time starts 0.3 ms late in the median, 3 ms once in a hundred, and never early."""
    late_ms = await _starts_ms(HostDelay(), lead_ns=100 * MS)
    assert min(late_ms) > 0
    assert np.median(late_ms) == pytest.approx(0.3, rel=0.15)
    assert np.quantile(late_ms, 0.99) == pytest.approx(3.0, rel=0.4)


async def test_short_lead_time_delays_the_start() -> None:
    """A host that needs 10 ms to prepare a packet cannot start within 4 ms."""
    late_ms = await _starts_ms(HostDelay(work_ms=10.0, wake_median_ms=0.0), lead_ns=4 * MS)
    assert late_ms == pytest.approx([6.0] * PACKETS, abs=0.1)


async def test_radio_whose_closing_is_cancelled_leaves_the_air() -> None:
    """A daemon that is cancelled while it closes its radio can open it again at once."""
    clock = VirtualClock(0)
    air = Air(running_timeline(), np.random.default_rng(0), LinkModel())
    opener = radio_opener(air, "here", clock, np.random.default_rng(1), PAPER)
    sending, closes = [], asyncio.Event()

    async def close_during_a_transmission() -> None:
        async with opener() as radio:
            sending.append(asyncio.create_task(radio.transmit(b"hello")))
            await asyncio.sleep(0.01)
            closes.set()

    closing = asyncio.create_task(close_during_a_transmission())
    await closes.wait()
    await asyncio.sleep(0.01)
    closing.cancel()
    await asyncio.wait([closing, *sending])
    async with opener() as radio:
        await radio.transmit(b"hello")


async def test_timestamp_jitter() -> None:
    """Timestamps at both ends have the given jitter, and the radio states it."""
    clock = VirtualClock(0)
    air = Air(running_timeline(), np.random.default_rng(0), LinkModel())
    jitter = [TimestampJitter(20_000, np.random.default_rng(seed)) for seed in (1, 2)]
    one, other = (
        radio_opener(air, name, clock, np.random.default_rng(3), PAPER, jitter=each)
        for name, each in zip(("here", "there"), jitter, strict=True)
    )
    sent_ns, received_ns = [], []
    async with one() as here, other() as there:
        for second in range(1, PACKETS + 1):
            sent = await here.transmit(b"x", at_ns=second * 1000 * MS)
            packet = await there.receive()
            assert sent.stamp_sigma_ns == packet.stamp_sigma_ns == round(np.hypot(3_000, 20_000))
            sent_ns.append(sent.done_at_ns - sent.started_at_ns)
            received_ns.append(packet.received_at_ns - sent.started_at_ns)
    assert np.std(sent_ns) == pytest.approx(20_200, rel=0.15)
    assert np.std(received_ns) == pytest.approx(20_200, rel=0.15)
    assert abs(np.corrcoef(sent_ns, received_ns)[0, 1]) < 0.2
