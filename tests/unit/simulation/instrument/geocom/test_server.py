"""The instrument's side of GeoCOM: framing, checksums, transport codes, sequential execution."""

from __future__ import annotations

import asyncio

import pytest
from harness.instruments.total_stations import SETUP, Bench
from hypothesis import given
from hypothesis import strategies as st

from tsgt.simulation.instrument.geocom.server import COMMANDS, ForcedResponse, crc_16
from tsgt.simulation.kernel import run_virtual
from tsgt.station.geocom import Rpc


async def test_request_without_transaction_number() -> None:
    """The response has transaction 0."""
    response = await Bench().type(b"%R1Q,5003:\r\n")
    assert (response.transaction, response.code, response.values) == (0, 0, ["230001"])


@pytest.mark.parametrize("end", [b"\r", b"\n", b"\r\n"])
async def test_line_terminators(end: bytes) -> None:
    """CR, LF or both."""
    assert (await Bench().type(b"%R1Q,0,7:" + end)).transaction == 7


async def test_empty_lines_are_ignored() -> None:
    """A client that wakes the instrument with LF CR LF gets one response to its request."""
    bench = Bench()
    assert (await bench.type(b"\n\r\n%R1Q,0,3:\r\n")).transaction == 3
    assert await bench.quiet(1.0)


async def test_line_feed_discards_garbage() -> None:
    """The request after it is executed."""
    bench = Bench()
    assert (await bench.type(b"\x00\xffgarbage\n%R1Q,0,3:\r\n")).transaction == 3
    assert await bench.quiet(1.0)


async def test_request_in_parts() -> None:
    """It is executed at the end of the line."""
    bench = Bench()
    await bench.send(b"%R1Q,")
    await asyncio.sleep(1.0)
    assert (await bench.type(b"0,4:\r\n")).transaction == 4


@pytest.mark.parametrize(
    ("line", "com_code"),
    [
        (b"%R1Q,nonsense\r\n", 3078),
        (b"%R1Q,4711,1:\r\n", 3081),
        (b"%R1Q,2167,1:50\r\n", 3080),
        (b"%R1Q,2167,1:50,1,1\r\n", 3080),
        (b"%R1Q,2167,1:50,x\r\n", 3080),
        (b"%R1Q,0,1,5:\r\n", 3101),
    ],
)
async def test_malformed_request_gives_a_transport_code(line: bytes, com_code: int) -> None:
    """The code says why."""
    assert (await Bench().type(line)).com_code == com_code


@pytest.mark.parametrize(("reflector", "code"), [(0, 2), (1, 0), (2, 0), (3, 2)])
async def test_user_defined_prism_needs_a_reflector(reflector: int, code: int) -> None:
    """BAP_REFLTYPE: a prism or a tape; 0 is undefined."""
    bench = Bench()
    assert (await bench.type(b'%%R1Q,17032,1:"own",0.01,%d,"us"\r\n' % reflector)).code == code


async def test_checksums() -> None:
    """A request with a checksum gets a response with one."""
    bench = Bench()
    crc = crc_16(b"%R1Q,5003,9:")
    await bench.send(b"%%R1Q,5003,9,%d:\r\n" % crc)
    assert bench.port is not None
    line = (await bench.port.read()).data.strip()
    head, _, tail = line.partition(b":")
    mark, com_code, transaction, checksum = head.split(b",")
    assert int(checksum) == crc_16(b",".join((mark, com_code, transaction)) + b":" + tail)


def test_checksum_is_crc_16_arc() -> None:
    """By the published check value."""
    assert crc_16(b"123456789") == 0xBB3D


async def test_decimals() -> None:
    """The number of decimals can be set, to 15 at most."""
    bench = Bench()
    await bench.do((107, 4))
    assert len((await bench.ask(2107, 1)).values[0].partition(".")[2]) <= 4
    assert await bench.code(107, 16) == 2


async def test_requests_are_queued() -> None:
    """Requests wait in a short queue that drops the oldest."""
    bench = Bench()
    await bench.send(b"".join(b"%%R1Q,0,%d:\r\n" % number for number in range(1, 9)))
    answered = [(await bench.listen()).transaction for _ in range(5)]
    assert answered == [1, 5, 6, 7, 8]
    assert await bench.quiet(1.0)


async def test_running_command_can_be_aborted() -> None:
    """A single c ends it at once with code 8."""
    bench = Bench()
    await bench.do((9027, 1.0, 1.5, 0, 0, 0))
    start_ns = bench.timeline.now_ns()
    await bench.send(b"%R1Q,9029,50:1.0,1.0,0\r\n")
    await asyncio.sleep(0.5)
    await bench.send(b"c\r\n")
    assert bench.port is not None
    assert (await bench.port.read()).data == b"?\r\n"
    response = await bench.listen()
    assert (response.transaction, response.code) == (50, 8)
    assert bench.timeline.now_ns() - start_ns < 0.6e9
    await bench.do((0,))


async def test_wait_for_a_distance_is_bounded() -> None:
    """Without a distance it responds after the wait time."""
    bench = Bench()
    for wait_ms in (50, 500, 3000):
        start_ns = bench.timeline.now_ns()
        assert await bench.code(2167, wait_ms, 1) == 1285
        assert wait_ms < (bench.timeline.now_ns() - start_ns) / 1e6 < wait_ms + 90


async def test_forced_codes() -> None:
    """A test can force return codes, by command and number of uses."""
    bench = Bench()
    server = bench.instrument.server
    server.forced.append(ForcedResponse(code=1293, rpc=2008, times=2))
    server.forced.append(ForcedResponse(com_code=3108))
    assert (await bench.ask(0)).com_code == 3108
    assert [await bench.code(2008, 1, 1) for _ in range(3)] == [1293, 1293, 0]


@pytest.mark.slow
async def test_every_command_responds() -> None:
    """Each command with arbitrary parameters gives one well-formed response."""
    for rpc, (signature, _) in COMMANDS.items():
        bench = Bench()
        bench.instrument.settings.power_mode = 0
        parameters = ['"x"' if kind == "s" else "1" for kind in signature]
        response = await bench.ask(rpc, *parameters)
        assert response.com_code == 0, Rpc(rpc)
        assert await bench.quiet(2.0)


@given(st.binary(max_size=60))
def test_arbitrary_bytes_are_harmless(data: bytes) -> None:
    """After arbitrary bytes and a line feed it responds to a request."""

    async def run() -> None:
        bench = Bench(duration_s=1.0)
        await bench.send(data + b"\n")
        await asyncio.sleep(20.0)
        assert bench.port is not None
        bench.port.drain()
        assert (await bench.type(b"%R1Q,0,77:\r\n")).transaction == 77

    run_virtual(run)


async def test_settings_are_read_back() -> None:
    """Each setting reads as written."""
    bench = Bench()
    for write, read, *parameters in (
        (9031, 9030, 1),
        (9043, 9042, 1.5, 1.25, 0.5, 0.25, 1),
        (9041, 9040, 0.5, 0.25),
        (9007, 9008, 0.00001, 0.00002),
        (14002, 14001, 0, 0, 900_000),
        (17019, 17018, 4),
        (17021, 17022, 0),
        (17008, 17009, 7),
        (17037, 17036, 1),
        (17035, 17034, 2),
        (2020, 2021, 9),
        (2024, 2023, 0.0175),
        (2028, 2029, 0.00000065, 950.5, 21.5, 15.0),
        (2030, 2031, 1, 6370000.0, 0.13),
        (2010, 2009, 1.0, 2.0, 3.0, 1.5),
        (2016, 2014, 1, 1, 0, 0),
        (1059, 1058, 2),
        (107, 108, 9),
    ):
        await bench.do((write, *parameters))
        values = (await bench.ask(read)).values
        assert [float(value) for value in values] == [float(parameter) for parameter in parameters]


@pytest.mark.parametrize(
    "request_",
    [
        (2020, 14),
        (17008, 4),
        (17019, 5),
        (9047, 0, 5),
        (9031, 3),
        (14002, 0, 0, 1000),
        (1059, 4),
        (2008, 9, 1),
    ],
)
async def test_out_of_range_settings_are_rejected(request_: tuple[int, ...]) -> None:
    """With return code 2."""
    assert await Bench().code(*request_) == 2


async def test_continuous_measurement_is_reported() -> None:
    """Whether it runs can be queried."""
    bench = Bench()
    assert (await bench.ask(1070)).values == ["0"]
    await bench.do(*SETUP)
    assert (await bench.ask(1070)).values == ["1"]
