"""The simulated bus and pins as the driver sees them."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from harness.hardware.chips import NO_JITTER, Bench

from tsgt.simulation.kernel import run_virtual
from tsgt.simulation.lora import SimulatedHal

if TYPE_CHECKING:
    from tsgt.radio.sx127x import Edge, Hal


def packets(bench: Bench, hal: SimulatedHal, count: int) -> list[Edge]:
    """Receive packets, clearing the flags after each; return the reported edges."""
    edges: list[Edge] = []

    async def main() -> None:
        hal.on_dio0(edges.append)
        for _ in range(count):
            frame = bench.port.send(b"abcd")
            await asyncio.sleep((frame.end_ns + frame.symbol_ns - bench.timeline.now_ns()) / 1e9)
            assert hal.dio0()
            hal.transfer(bytes([0x92, 0xFF]))
            assert not hal.dio0()

    bench.enter_lora()
    bench.listen()
    run_virtual(main, bench.timeline)
    return edges


def test_transfers_and_reset_reach_the_chip() -> None:
    """Transfers and reset reach the chip."""
    bench = Bench()
    hal: Hal = SimulatedHal(bench.chip, stamp_sigma_ns=5)
    assert hal.stamp_sigma_ns == 5
    assert hal.transfer(bytes([0x42, 0])) == bytes([0, 0x12])
    hal.set_reset(low=True)
    assert hal.transfer(bytes([0x42, 0])) == bytes([0, 0])
    bench.timeline.advance(1_000_000)
    hal.set_reset(low=False)
    bench.timeline.advance(10_000_000)
    assert hal.transfer(bytes([0x42, 0])) == bytes([0, 0x12])
    hal.close()


def test_rising_edges_are_timestamped() -> None:
    """Each rising edge is reported with the chip's time; falling ones are not."""
    bench = Bench(NO_JITTER)
    edges = packets(bench, SimulatedHal(bench.chip), 3)
    assert len(edges) == 3
    assert edges[1].at_ns - edges[0].at_ns > 20_000_000
    assert all(edge.lost == 0 for edge in edges)


def test_missed_edges_are_counted() -> None:
    """The next reported edge carries the number of missed ones, if the host counts them."""
    bench = Bench()
    hal = SimulatedHal(bench.chip)
    hal.drop_edges(2)
    assert [edge.lost for edge in packets(bench, hal, 4)] == [2, 0]


def test_missed_edges_may_be_uncounted() -> None:
    """If the host does not count, only the level shows a missed edge."""
    bench = Bench()
    hal = SimulatedHal(bench.chip)
    hal.drop_edges(1, counted=False)
    assert [edge.lost for edge in packets(bench, hal, 3)] == [0, 0]


def test_edge_callback_does_not_interrupt_the_driver() -> None:
    """An edge caused by a register write is reported after the writing task yields."""
    bench = Bench()
    bench.enter_lora()
    bench.transmit(b"abcd")
    edges: list[Edge] = []

    async def main() -> None:
        hal = SimulatedHal(bench.chip)
        hal.on_dio0(edges.append)
        hal.transfer(bytes([0xC0, 0x40]))
        assert hal.dio0()
        assert not edges
        await asyncio.sleep(0)
        assert len(edges) == 1

    run_virtual(main, bench.timeline)
