"""The simulated serial line: transfer times, bit rates, unplugging, faults."""

from __future__ import annotations

import asyncio

import pytest
from harness.instruments.total_stations import Bench

from tsgt.errors import InstrumentError
from tsgt.simulation.instrument import LineFault
from tsgt.simulation.instrument.serial_line import line_ns


async def test_transfer_times() -> None:
    """At 9600 bits per second request and response take a millisecond per byte, plus the processing time."""
    bench = Bench()
    bench.instrument.baud = 9600
    response = await bench.ask(5004)
    line_time_ns = line_ns(len("%R1Q,5004,1:\r\n") + len(response.chunk.data), 9600)
    assert line_time_ns == 38 * 10_000_000_000 // 9600
    assert 20e6 <= response.chunk.at_ns - line_time_ns <= 60e6


async def test_wrong_bit_rate_gives_garbage() -> None:
    """At the right bit rate and after a line feed it responds again."""
    bench = Bench()
    port = await bench.line.open(9600)
    port.write(b"%R1Q,0,1:\r\n")
    assert b"%R1P" not in (await port.read()).data
    await port.close()
    await bench.send(b"\n")
    await bench.do((0,))


async def test_unplugged_cable() -> None:
    """A waiting read and all other calls fail until the port is reopened with the cable plugged in."""
    bench = Bench()
    await bench.do((0,))
    port = bench.port
    assert port is not None
    waiting = asyncio.create_task(port.read())
    await asyncio.sleep(0.1)
    bench.line.plugged = False
    with pytest.raises(InstrumentError, match="unplugged"):
        await waiting
    with pytest.raises(InstrumentError):
        port.write(b"\n")
    with pytest.raises(InstrumentError, match="plug the cable in"):
        await bench.line.open(115_200)
    bench.line.plugged = True
    with pytest.raises(InstrumentError):
        port.drain()
    bench.port = None
    await bench.do((0,))


async def test_port_is_exclusive() -> None:
    """A second open fails until the first is closed."""
    bench = Bench()
    port = await bench.line.open(115_200)
    with pytest.raises(InstrumentError, match="already open"):
        await bench.line.open(115_200)
    await port.close()
    await (await bench.line.open(115_200)).close()


async def test_cancelled_read_loses_no_bytes() -> None:
    """A later read returns them."""
    bench = Bench()
    await bench.send(b"%R1Q,0,1:\r\n")
    assert bench.port is not None
    while True:
        try:
            async with asyncio.timeout(0.002):
                chunk = await bench.port.read()
            break
        except TimeoutError:
            pass
    assert chunk.data == b"%R1P,0,1:0\r\n"


async def test_drain_discards_unread_bytes() -> None:
    """drain() returns them once."""
    bench = Bench()
    await bench.send(b"%R1Q,0,1:\r\n")
    await asyncio.sleep(1.0)
    assert bench.port is not None
    assert bench.port.drain() == b"%R1P,0,1:0\r\n"
    assert bench.port.drain() == b""


WHOLE = b"%R1P,0,1:0\r\n"


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (LineFault.TRUNCATED, WHOLE[:6]),
        (LineFault.DUPLICATED, WHOLE + WHOLE),
        (LineFault.SPLIT, WHOLE),
        (LineFault.DELAYED, WHOLE),
        (LineFault.DROPPED, b""),
        (LineFault.NONE, WHOLE),
    ],
)
async def test_fault_applies_to_one_response(fault: LineFault, expected: bytes) -> None:
    """Later responses are intact."""
    bench = Bench()
    bench.line.faults.script.append(fault)
    await bench.send(b"%R1Q,0,1:\r\n")
    await asyncio.sleep(10.0)
    assert bench.port is not None
    assert bench.port.drain() == expected
    await bench.do((0,))


@pytest.mark.parametrize("fault", [LineFault.GARBAGE, LineFault.CORRUPTED])
async def test_fault_with_garbage(fault: LineFault) -> None:
    """The response contains bytes that the instrument did not send."""
    bench = Bench()
    bench.line.faults.script.append(fault)
    await bench.send(b"%R1Q,0,1:\r\n")
    await asyncio.sleep(1.0)
    assert bench.port is not None
    assert bench.port.drain() not in (b"", WHOLE)


async def test_dropped_requests_and_responses() -> None:
    """A request whose response is dropped is still executed."""
    bench = Bench()
    bench.line.faults.drop_responses = True
    await bench.send(b"%R1Q,1004,1:1\r\n")
    assert await bench.quiet(1.0)
    assert bench.instrument.settings.laser
    bench.line.faults.drop_responses, bench.line.faults.drop_requests = False, True
    await bench.send(b"%R1Q,1004,1:0\r\n")
    assert await bench.quiet(1.0)
    assert bench.instrument.settings.laser
