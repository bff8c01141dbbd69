"""The register sequence of the authors' C++ node on a simulated chip, against our driver."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest
from harness.hardware.cpp_node import CppNode
from harness.hardware.lab import lab, payload

from tsgt.radio import LoRaSettings

if TYPE_CHECKING:
    from harness.hardware.lab import Lab

MEASUREMENT_BYTES = 34
spreading_factors = pytest.mark.parametrize("spreading_factor", [8, 9])


@spreading_factors
async def test_node_receives_our_packets(spreading_factor: int) -> None:
    """A command of two bytes and a packet of maximum length arrive at the node."""
    async with lab(_settings(spreading_factor)) as bench:
        node = await _node(bench, spreading_factor)
        await bench.program.run(node.listen)
        for sent in (b"t1", payload(251)):
            receiving = asyncio.create_task(bench.program.run(node.receive))
            await bench.radio.transmit(sent)
            assert await receiving == sent


@spreading_factors
async def test_we_receive_the_nodes_packets(spreading_factor: int) -> None:
    """A measurement of the node arrives, transmitted at +20 dBm."""
    async with lab(_settings(spreading_factor)) as bench:
        node = await _node(bench, spreading_factor)
        assert await bench.program.run(lambda: node.send(payload(MEASUREMENT_BYTES)))
        packet = await bench.radio.receive()
        assert packet.payload == payload(MEASUREMENT_BYTES)
        assert packet.rssi_dbm == pytest.approx(20 - 80, abs=1)


@spreading_factors
async def test_node_responds_to_every_request(spreading_factor: int) -> None:
    """Thirty requests in a row are answered within the master's 250 ms."""
    async with lab(_settings(spreading_factor)) as bench:
        node = await _node(bench, spreading_factor)

        def answer(count: int) -> None:
            for number in range(count):
                node.listen()
                assert node.receive() == b"t1"
                assert node.send(bytes([number]) * MEASUREMENT_BYTES)

        answering = asyncio.create_task(bench.program.run(lambda: answer(30)))
        await asyncio.sleep(0.1)
        for number in range(30):
            sent = await bench.radio.transmit(b"t1")
            packet = await bench.radio.receive()
            assert packet.payload == bytes([number]) * MEASUREMENT_BYTES
            assert packet.received_at_ns - sent.done_at_ns < 250_000_000
            await asyncio.sleep(0.01)
        await answering


async def test_node_reads_consecutive_packets_from_the_fifo() -> None:
    """Consecutive packets through the whole FIFO, including the wrap, are read from their addresses."""
    async with lab(_settings(8)) as bench:
        node = await _node(bench, 8)

        def receive(count: int) -> list[bytes | None]:
            node.listen()
            return [node.receive() for _ in range(count)]

        sizes = (34, 2, 200, 34, 255, 9)
        receiving = asyncio.create_task(bench.program.run(lambda: receive(len(sizes))))
        await asyncio.sleep(0.1)
        for size in sizes:
            await bench.radio.transmit(payload(size))
        assert await receiving == [payload(size) for size in sizes]


async def test_node_needs_our_spreading_factor() -> None:
    """A node deployed before 2021 does not receive a master configured for later nodes."""
    async with lab(_settings(8)) as bench:
        node = await _node(bench, 9)
        await bench.program.run(node.listen)
        receiving = asyncio.create_task(bench.program.run(node.receive))
        await bench.radio.transmit(b"t1")
        assert await receiving is None


async def _node(bench: Lab, spreading_factor: int) -> CppNode:
    node = CppNode(bench.program, bench.chip, spreading_factor=spreading_factor)
    await bench.program.run(node.start)
    return node


def _settings(spreading_factor: int) -> LoRaSettings:
    return LoRaSettings(
        frequency_hz=905_000_000, spreading_factor=spreading_factor, bandwidth_hz=250_000, coding_rate=6
    )
