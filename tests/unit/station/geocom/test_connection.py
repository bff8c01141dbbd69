"""The GeoCOM connection: every reply belongs to its request, whatever the line does."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING

import pytest
from harness.instruments.geocom_line import (
    REPLY_S,
    Cable,
    FakeInstrument,
    cut,
    damaged,
    doubled,
    garbage_before,
    late,
    not_taken,
    silent,
    torn,
)
from structlog.testing import capture_logs

from tsgt.errors import InstrumentError
from tsgt.simulation.kernel import VirtualClock
from tsgt.station.geocom import GeoComConnection, Rpc, connect

if TYPE_CHECKING:
    from harness.instruments.geocom_line import Fault, MemoryPort

MS = 1_000_000


async def connected(
    *, checksum: bool = False, baud: int = 115_200
) -> tuple[GeoComConnection, FakeInstrument]:
    """Return a connection to an instrument that responds."""
    instrument = FakeInstrument(checksums=checksum, baud=baud)
    port = await Cable(instrument).open(baud)
    return GeoComConnection(port, VirtualClock(0), checksum=checksum), instrument


async def check_echo(connection: GeoComConnection, number: int) -> None:
    """Call a procedure and check that the reply belongs to it."""
    reply = await connection.call(Rpc.TMC_GET_FULL_MEAS, number, timeout_s=1.0)
    assert (reply.code, reply.values) == (0, (number,))


def now_s() -> float:
    """Time of the event loop."""
    return asyncio.get_running_loop().time()


async def test_reply_has_code_and_values() -> None:
    """Numbers as numbers and strings as strings."""
    connection, instrument = await connected()
    reply = await connection.call(Rpc.BAP_SET_PRISM_TYPE2, 9, 'a, "b"')
    assert reply.code == 0
    assert reply.values == (9, 'a, "b"')
    assert instrument.requests[0].startswith(b"%R1Q,17030,")


async def test_reply_is_timestamped_at_first_byte() -> None:
    """The time of the last byte minus the duration of all bytes, ten bits each."""
    connection, _ = await connected(baud=9600)
    reply = await connection.call(Rpc.TMC_GET_FULL_MEAS, 150)
    length = len("%R1P,0,1:0,150\r\n")
    assert reply.sent_ns == 0
    assert reply.first_byte_ns == 20 * MS - round(length * 10 / 9600 * 1e9)


async def test_reply_in_pieces_is_timestamped_at_first_byte() -> None:
    """Not when the line was complete."""
    connection, instrument = await connected()
    instrument.faults.append(torn(5))
    reply = await connection.call(Rpc.TMC_GET_FULL_MEAS, 150)
    assert reply.first_byte_ns == 20 * MS - round(5 * 10 / 115_200 * 1e9)


@pytest.mark.parametrize(
    "fault",
    [
        doubled,
        torn(3),
        torn(20),
        late(0.9),
        late(1.1),
        late(1.9),
        damaged,
        silent,
        cut(12),
        cut(2),
        garbage_before(b"\x00\xff%R1"),
        garbage_before(b"%R1P,0,7:0,12.3"),
        garbage_before(b"\r\n\n\r??"),
        garbage_before(b"%R1P,0,9:0,1,2,3\r\n"),
        garbage_before(b"%" * 5000),
        not_taken(3074),
        not_taken(3080),
        not_taken(3087),
        not_taken(3093),
        not_taken(3100),
        not_taken(3101),
        not_taken(3107),
        not_taken(3108),
        not_taken(3109),
    ],
)
async def test_single_fault_loses_no_reply(fault: Fault) -> None:
    """All later replies are correct."""
    connection, instrument = await connected()
    await check_echo(connection, 1)
    instrument.faults.append(fault)
    for number in range(2, 6):
        await check_echo(connection, number)


async def test_late_reply_is_dropped() -> None:
    """It arrives after its call has failed; the line is resynchronised."""
    connection, instrument = await connected()
    instrument.faults.extend([late(4.5), silent, silent, silent])
    with pytest.raises(InstrumentError, match="does not respond"):
        await connection.call(Rpc.TMC_GET_FULL_MEAS, 1, timeout_s=1.0)
    assert now_s() == pytest.approx(4.0)
    await asyncio.sleep(0.495)
    await check_echo(connection, 2)


async def test_call_waits_for_reply_to_cancelled_call() -> None:
    """An instrument takes one request at a time."""
    connection, instrument = await connected()
    instrument.faults.append(late(0.8))
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.1):
            await connection.call(Rpc.TMC_GET_FULL_MEAS, 1)
    await check_echo(connection, 2)
    assert now_s() == pytest.approx(0.8 + REPLY_S)
    assert len(instrument.requests) == 2


async def test_wait_for_cancelled_call_ends_at_its_timeout() -> None:
    """Then the line is resynchronised."""
    connection, instrument = await connected()
    instrument.faults.append(silent)
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.1):
            await connection.call(Rpc.TMC_GET_FULL_MEAS, 1, timeout_s=2.0)
    await check_echo(connection, 2)
    assert now_s() == pytest.approx(2.0 + 2 * REPLY_S)


async def test_concurrent_calls_are_serialised() -> None:
    """The second request is sent after the first reply."""
    connection, instrument = await connected()
    await asyncio.gather(check_echo(connection, 1), check_echo(connection, 2))
    assert now_s() == pytest.approx(2 * REPLY_S)
    assert len(instrument.requests) == 2


async def test_silence_raises_with_advice() -> None:
    """After the timeout and three attempts to resynchronise."""
    connection, instrument = await connected()
    instrument.faults.extend([silent] * 100)
    with pytest.raises(
        InstrumentError, match="line: the instrument does not respond any more; check that it is on"
    ):
        await connection.call(Rpc.TMC_GET_FULL_MEAS, 1, timeout_s=1.0)
    assert now_s() == pytest.approx(4.0)


async def test_silent_procedure_is_repeated_once() -> None:
    """The instrument replies to other requests."""
    connection, instrument = await connected()
    instrument.faults.extend([silent, garbage_before(b"x"), silent])
    with capture_logs() as logs, pytest.raises(InstrumentError, match=r"no reply .* to TMC_GET_FULL_MEAS"):
        await connection.call(Rpc.TMC_GET_FULL_MEAS, 1, timeout_s=1.0)
    assert len(instrument.requests) == 2
    assert [entry["event"] for entry in logs] == ["instrument_silent"]


@pytest.mark.parametrize("fault", [silent, damaged])
async def test_moving_procedure_is_not_repeated(fault: Fault) -> None:
    """It may have been executed; a second change of face would undo the first."""
    connection, instrument = await connected()
    instrument.faults.append(fault)
    with pytest.raises(InstrumentError, match="to AUT_CHANGE_FACE"):
        await connection.call(Rpc.AUT_CHANGE_FACE, 0, 0, 0)
    assert len(instrument.requests) == 1
    await check_echo(connection, 2)


async def test_moving_procedure_is_not_repeated_after_error_without_transaction() -> None:
    """The error may be the late one of an earlier request."""
    connection, instrument = await connected()
    instrument.faults.append(not_taken(3101))
    reply = await connection.call(Rpc.AUT_CHANGE_FACE, 0, 0, 0)
    assert reply.code == 3101
    assert len(instrument.requests) == 1


@pytest.mark.parametrize(("code", "times"), [(3081, 1), (3080, 3), (3109, 3)])
async def test_com_code_is_returned(code: int, times: int) -> None:
    """An unknown procedure at once; a temporary error after three attempts."""
    connection, instrument = await connected()
    instrument.faults.extend([not_taken(code)] * times)
    assert (await connection.call(Rpc.TMC_SET_PRISM_CORR, 0.0)).code == code
    assert not instrument.faults


async def test_damaged_replies_raise() -> None:
    """Three in a row are a fault of the cable."""
    connection, instrument = await connected()
    instrument.faults.extend([damaged] * 3)
    with pytest.raises(InstrumentError, match="only damaged replies"):
        await connection.call(Rpc.TMC_GET_FULL_MEAS, 1)
    await check_echo(connection, 2)


async def test_abort_ends_search() -> None:
    """The instrument responds again at once."""
    connection, instrument = await connected()
    instrument.faults.append(late(20.0))
    task = asyncio.create_task(connection.call(Rpc.AUT_PS_SEARCH_WINDOW, timeout_s=60.0))
    await asyncio.sleep(1.0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    abort = asyncio.create_task(connection.abort())
    await asyncio.sleep(0)
    assert instrument.received[-1] == b"c"
    port: MemoryPort = connection.port  # type: ignore[assignment]
    transaction = instrument.requests[0].split(b",")[2].rstrip(b":").decode()
    port.come(0.5, f"%R1P,0,{transaction}:8\r\n".encode())
    await abort
    assert now_s() == pytest.approx(1.5)
    await check_echo(connection, 2)
    assert now_s() == pytest.approx(1.5 + REPLY_S)


async def test_abort_without_reply_resynchronises() -> None:
    """The reply of the aborted procedure may be lost as well."""
    connection, instrument = await connected()
    instrument.faults.append(silent)
    task = asyncio.create_task(connection.call(Rpc.AUT_PS_SEARCH_WINDOW, timeout_s=60.0))
    await asyncio.sleep(1.0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    await connection.abort()
    await check_echo(connection, 2)
    assert now_s() == pytest.approx(4.0 + 2 * REPLY_S)


async def test_abort_without_procedure_is_harmless() -> None:
    """The instrument's question mark is no reply."""
    connection, _ = await connected()
    await connection.abort()
    await check_echo(connection, 2)


async def test_lost_reply_of_search_is_detected() -> None:
    """A probe gets its reply first, and replies come in order."""
    connection, instrument = await connected()
    instrument.faults.append(silent)
    with pytest.raises(InstrumentError, match="AUT_PS_SEARCH_WINDOW was lost"):
        await connection.call(Rpc.AUT_PS_SEARCH_WINDOW, timeout_s=90.0)
    assert now_s() == pytest.approx(4.0 + REPLY_S)
    await check_echo(connection, 2)


async def test_long_search_is_awaited() -> None:
    """The instrument does not respond during a search; replies to probes follow."""
    connection, instrument = await connected()
    port: MemoryPort = connection.port  # type: ignore[assignment]
    instrument.busy = True
    task = asyncio.create_task(connection.call(Rpc.AUT_PS_SEARCH_WINDOW, timeout_s=90.0))
    await asyncio.sleep(20.5)
    instrument.busy = False
    asked = [line.split(b",")[2].rstrip(b":").decode() for line in instrument.received]
    assert len(asked) == 6
    for number, transaction in enumerate(asked):
        port.come(number * REPLY_S, f"%R1P,0,{transaction}:0\r\n".encode())
    assert (await task).code == 0
    await check_echo(connection, 2)


async def test_lost_line_raises_at_once() -> None:
    """The pending call, and every later one."""
    connection, _ = await connected()
    port: MemoryPort = connection.port  # type: ignore[assignment]
    asyncio.get_running_loop().call_later(0.01, port.unplug)
    for _ in range(2):
        with pytest.raises(InstrumentError, match="the line is gone"):
            await connection.call(Rpc.TMC_GET_FULL_MEAS, 1)
    assert now_s() == pytest.approx(0.01)


async def test_wrong_checksum_repeats_request() -> None:
    """Requests carry checksums too."""
    connection, instrument = await connected(checksum=True)

    def other_value(line: str) -> list[tuple[float, bytes]]:
        return [(REPLY_S, line.replace("7654321", "7654421").encode() + b"\r\n")]

    instrument.faults.append(other_value)
    await check_echo(connection, 7654321)
    assert len(instrument.requests) == 2
    assert instrument.requests[0].count(b",") == 3


async def test_decimals_are_as_set() -> None:
    """Real numbers are sent with this many."""
    connection, instrument = await connected()
    connection.decimals = 4
    await connection.call(Rpc.AUT_FINE_ADJUST, 1 / 3, 0.5, False)
    assert instrument.requests[0].endswith(b":0.3333,0.5,0")


async def test_connect_at_configured_baud_rate() -> None:
    """An instrument that responds at once."""
    cable = Cable(FakeInstrument())
    with capture_logs() as logs:
        connection = await connect(cable.open, 115_200, VirtualClock(0), checksum=False)
    assert connection.port is cable.ports[0]
    assert now_s() == pytest.approx(REPLY_S)
    assert not logs


@pytest.mark.parametrize("garbles", [True, False])
async def test_connect_finds_other_baud_rate(garbles: bool) -> None:  # noqa: FBT001 (a parameter of pytest)
    """Whether it is silent or sends garbage; the rate is logged."""
    cable = Cable(FakeInstrument(baud=9600, garbles=garbles), impossible=frozenset({19_200}))
    with capture_logs() as logs:
        connection = await connect(cable.open, 115_200, VirtualClock(0), checksum=False)
    assert connection.port.baud == 9600
    assert [port.closed for port in cable.ports] == [True] * (len(cable.ports) - 1) + [False]
    assert logs == [
        {
            "event": "instrument_baud_found",
            "log_level": "warning",
            "port": "line",
            "baud": 9600,
            "configured": 115_200,
        }
    ]
    await check_echo(connection, 2)


async def test_configured_baud_rate_is_tried_every_second() -> None:
    """An instrument that is switched on meanwhile is found soon."""
    instrument = FakeInstrument(baud=57_600)
    cable = Cable(instrument)
    instrument.faults.extend([silent] * 4)
    connection = await connect(cable.open, 57_600, VirtualClock(0), checksum=False)
    assert [port.baud for port in cable.ports[:5]] == [57_600, 57_600, 115_200, 57_600, 19_200]
    assert connection.port.baud == 57_600


async def test_connect_fails_after_all_baud_rates() -> None:
    """The message names what to check, and no port stays open."""
    cable = Cable(FakeInstrument(faults=deque([silent] * 100)))
    with pytest.raises(InstrumentError, match="line: no instrument responds at 115200 baud"):
        await connect(cable.open, 115_200, VirtualClock(0), checksum=False)
    assert {port.baud for port in cable.ports} >= {2400, 4800, 9600, 921_600}
    assert all(port.closed for port in cable.ports)
    assert now_s() < 11


async def test_connect_aborts_search_of_earlier_client() -> None:
    """An instrument does not respond during a search."""
    cable = Cable(FakeInstrument(busy=True))
    await connect(cable.open, 115_200, VirtualClock(0), checksum=False)
    assert now_s() == pytest.approx(0.5 + REPLY_S)


async def test_missing_checksum_support_is_reported() -> None:
    """The message names which setting to change."""
    instrument = FakeInstrument()
    instrument.faults.append(not_taken(3110))
    cable = Cable(instrument)
    with pytest.raises(InstrumentError, match="set checksum = false"):
        await connect(cable.open, 115_200, VirtualClock(0), checksum=True)
    assert cable.ports[0].closed


async def test_unopenable_port_ends_connect() -> None:
    """No other baud rate is tried."""
    cable = Cable(FakeInstrument(), impossible=frozenset({115_200}))
    with pytest.raises(InstrumentError, match="cannot be opened at 115200"):
        await connect(cable.open, 115_200, VirtualClock(0), checksum=False)
    assert not cable.ports


async def test_close_closes_port() -> None:
    """Later calls fail."""
    connection, _ = await connected()
    await connection.close()
    with pytest.raises(InstrumentError):
        await check_echo(connection, 1)
