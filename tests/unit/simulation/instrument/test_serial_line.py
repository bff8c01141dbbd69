"""A simulated cable: pace, speeds, plug, and what goes wrong on it."""

from __future__ import annotations

import asyncio

import pytest
from harness.total_stations import Bench

from tsgt.errors import InstrumentError
from tsgt.simulation.instrument import LineFault
from tsgt.simulation.instrument.serial_line import line_ns


async def test_bytes_take_their_time() -> None:
    """At 9600 bits per second question and answer take a millisecond a byte, besides the thinking."""
    bench = Bench()
    bench.instrument.baud = 9600
    answer = await bench.ask(5004)
    line_time_ns = line_ns(len("%R1Q,5004,1:\r\n") + len(answer.chunk.data), 9600)
    assert line_time_ns == 38 * 10_000_000_000 // 9600
    assert 20e6 <= answer.chunk.at_ns - line_time_ns <= 60e6


async def test_another_speed_gives_garbage() -> None:
    """Nothing that comes is a line, though something comes; at the right speed and after a line feed it answers."""
    bench = Bench()
    port = await bench.line.open(9600)
    port.write(b"%R1Q,0,1:\r\n")
    assert b"%R1P" not in (await port.read()).data
    await port.close()
    await bench.send(b"\n")
    await bench.do((0,))


async def test_a_pulled_cable() -> None:
    """Whoever waits gets an error, and so does everything else, until it is opened anew with the cable in."""
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


async def test_one_program_at_a_time() -> None:
    """A second one is refused until the first has closed the port."""
    bench = Bench()
    port = await bench.line.open(115_200)
    with pytest.raises(InstrumentError, match="already open"):
        await bench.line.open(115_200)
    await port.close()
    await (await bench.line.open(115_200)).close()


async def test_reading_may_be_cancelled() -> None:
    """No byte is lost by it."""
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


async def test_what_was_not_read_can_be_thrown_away() -> None:
    """drain() returns it once."""
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
async def test_faults_of_one_answer(fault: LineFault, expected: bytes) -> None:
    """Each does what it says to the next answer, and only to that one."""
    bench = Bench()
    bench.line.faults.script.append(fault)
    await bench.send(b"%R1Q,0,1:\r\n")
    await asyncio.sleep(10.0)
    assert bench.port is not None
    assert bench.port.drain() == expected
    await bench.do((0,))


@pytest.mark.parametrize("fault", [LineFault.GARBAGE, LineFault.CORRUPTED])
async def test_garbage_on_the_line(fault: LineFault) -> None:
    """There are bytes that nobody sent."""
    bench = Bench()
    bench.line.faults.script.append(fault)
    await bench.send(b"%R1Q,0,1:\r\n")
    await asyncio.sleep(1.0)
    assert bench.port is not None
    assert bench.port.drain() not in (b"", WHOLE)


async def test_deaf_and_mute() -> None:
    """Nothing gets through in one direction: the instrument acts on what it hears all the same."""
    bench = Bench()
    bench.line.faults.drop_responses = True
    await bench.send(b"%R1Q,1004,1:1\r\n")
    assert await bench.quiet(1.0)
    assert bench.instrument.settings.laser
    bench.line.faults.drop_responses, bench.line.faults.drop_requests = False, True
    await bench.send(b"%R1Q,1004,1:0\r\n")
    assert await bench.quiet(1.0)
    assert bench.instrument.settings.laser
