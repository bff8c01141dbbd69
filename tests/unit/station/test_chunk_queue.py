"""What a port has received and its owner has not read."""

from __future__ import annotations

import asyncio

import pytest

from tsgt.errors import InstrumentError
from tsgt.station.serial import Chunk
from tsgt.station.serial.chunk_queue import ChunkQueue

ONE, TWO, THREE = Chunk(b"one", 1), Chunk(b"two", 2), Chunk(b"three", 3)


async def test_cancelled_reader_loses_nothing() -> None:
    """Also when data has arrived and has not been returned yet."""
    queue = ChunkQueue()
    reading = asyncio.ensure_future(queue.read())
    await asyncio.sleep(0)
    queue.put(ONE)
    reading.cancel()
    with pytest.raises(asyncio.CancelledError):
        await reading
    assert await queue.read() == ONE


async def test_data_before_the_loss_is_read_first() -> None:
    """Then the first reason is raised."""
    queue = ChunkQueue()
    queue.put(ONE)
    queue.fail("unplugged")
    queue.fail("closed")
    assert await queue.read() == ONE
    with pytest.raises(InstrumentError, match="unplugged"):
        await queue.read()
    with pytest.raises(InstrumentError, match="unplugged"):
        queue.drain()


async def test_waiting_reader_notices_the_loss() -> None:
    """Without further data."""
    queue = ChunkQueue()
    reading = asyncio.ensure_future(queue.read())
    await asyncio.sleep(0)
    queue.fail("unplugged")
    with pytest.raises(InstrumentError, match="unplugged"):
        await reading


async def test_full_queue_drops_the_oldest() -> None:
    """Unread data must not fill the memory."""
    queue = ChunkQueue(max_chunks=2)
    for chunk in (ONE, TWO, THREE):
        queue.put(chunk)
    assert queue.drain() == b"twothree"
    assert queue.drain() == b""
