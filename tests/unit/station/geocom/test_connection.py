"""The owner of a GeoCOM line: every reply is that to its own request, whatever the line does."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING

import pytest
from harness.geocom_line import (
    ANSWER_S,
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
    from harness.geocom_line import Fault, MemoryPort

MS = 1_000_000


async def connected(
    *, checksum: bool = False, baud: int = 115_200
) -> tuple[GeoComConnection, FakeInstrument]:
    """Make a connection with an instrument that answers."""
    instrument = FakeInstrument(checksums=checksum, baud=baud)
    port = await Cable(instrument).open(baud)
    return GeoComConnection(port, VirtualClock(0), checksum=checksum), instrument


async def echoed(connection: GeoComConnection, number: int) -> None:
    """Ask for something and check that the answer is the one to it."""
    reply = await connection.call(Rpc.TMC_GET_FULL_MEAS, number, timeout_s=1.0)
    assert (reply.code, reply.values) == (0, (number,))


def now_s() -> float:
    """Time of the event loop."""
    return asyncio.get_running_loop().time()


async def test_a_reply_has_code_and_values() -> None:
    """What the instrument says comes back, numbers as numbers and texts as texts."""
    connection, instrument = await connected()
    reply = await connection.call(Rpc.BAP_SET_PRISM_TYPE2, 9, 'a, "b"')
    assert reply.code == 0
    assert reply.values == (9, 'a, "b"')
    assert instrument.requests[0].startswith(b"%R1Q,17030,")


async def test_a_reply_is_stamped_with_its_first_byte() -> None:
    """The time of the last byte less the time that all of them take on the line, ten bits each."""
    connection, _ = await connected(baud=9600)
    reply = await connection.call(Rpc.TMC_GET_FULL_MEAS, 150)
    length = len("%R1P,0,1:0,150\r\n")
    assert reply.sent_ns == 0
    assert reply.first_byte_ns == 20 * MS - round(length * 10 / 9600 * 1e9)


async def test_a_reply_in_pieces_is_stamped_with_its_first() -> None:
    """What matters is when the first byte came, not when the line was whole."""
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
async def test_one_fault_costs_no_reply(fault: Fault) -> None:
    """One fault of the line is survived, and all replies after it are the right ones."""
    connection, instrument = await connected()
    await echoed(connection, 1)
    instrument.faults.append(fault)
    for number in range(2, 6):
        await echoed(connection, number)


async def test_a_late_reply_is_not_taken_for_the_next() -> None:
    """A reply that comes after its caller has been told of the silence is dropped; the line is in step again."""
    connection, instrument = await connected()
    instrument.faults.extend([late(4.5), silent, silent, silent])
    with pytest.raises(InstrumentError, match="does not respond"):
        await connection.call(Rpc.TMC_GET_FULL_MEAS, 1, timeout_s=1.0)
    assert now_s() == pytest.approx(4.0)
    await asyncio.sleep(0.495)
    await echoed(connection, 2)


async def test_the_next_call_waits_for_the_reply_to_a_cancelled_one() -> None:
    """An instrument takes one request at a time; cancelling a caller does not change that."""
    connection, instrument = await connected()
    instrument.faults.append(late(0.8))
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.1):
            await connection.call(Rpc.TMC_GET_FULL_MEAS, 1)
    await echoed(connection, 2)
    assert now_s() == pytest.approx(0.8 + ANSWER_S)
    assert len(instrument.requests) == 2


async def test_a_cancelled_call_whose_reply_never_comes_holds_nobody_up_for_ever() -> None:
    """The next call waits as long as the cancelled one would have, then brings the line into step again."""
    connection, instrument = await connected()
    instrument.faults.append(silent)
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.1):
            await connection.call(Rpc.TMC_GET_FULL_MEAS, 1, timeout_s=2.0)
    await echoed(connection, 2)
    assert now_s() == pytest.approx(2.0 + 2 * ANSWER_S)


async def test_two_callers_take_turns() -> None:
    """The second request goes out when the first reply is there."""
    connection, instrument = await connected()
    await asyncio.gather(echoed(connection, 1), echoed(connection, 2))
    assert now_s() == pytest.approx(2 * ANSWER_S)
    assert len(instrument.requests) == 2


async def test_silence_ends_in_an_error_that_says_what_to_do() -> None:
    """Without an answer the call fails after its time and three attempts to get the instrument's attention."""
    connection, instrument = await connected()
    instrument.faults.extend([silent] * 100)
    with pytest.raises(
        InstrumentError, match="line: the instrument does not respond any more; check that it is on"
    ):
        await connection.call(Rpc.TMC_GET_FULL_MEAS, 1, timeout_s=1.0)
    assert now_s() == pytest.approx(4.0)


async def test_a_procedure_that_stays_silent_is_asked_for_twice() -> None:
    """The instrument answers other requests, but not this one: once more, then an error."""
    connection, instrument = await connected()
    instrument.faults.extend([silent, garbage_before(b"x"), silent])
    with capture_logs() as logs, pytest.raises(InstrumentError, match=r"no reply .* to TMC_GET_FULL_MEAS"):
        await connection.call(Rpc.TMC_GET_FULL_MEAS, 1, timeout_s=1.0)
    assert len(instrument.requests) == 2
    assert [entry["event"] for entry in logs] == ["instrument_silent"]


@pytest.mark.parametrize("fault", [silent, damaged])
async def test_what_moves_the_telescope_is_not_asked_for_twice(fault: Fault) -> None:
    """Whether it has been carried out is not known; a second change of face would undo the first."""
    connection, instrument = await connected()
    instrument.faults.append(fault)
    with pytest.raises(InstrumentError, match="to AUT_CHANGE_FACE"):
        await connection.call(Rpc.AUT_CHANGE_FACE, 0, 0, 0)
    assert len(instrument.requests) == 1
    await echoed(connection, 2)


async def test_what_moves_the_telescope_is_not_asked_for_again_after_an_error_without_a_number() -> None:
    """The error may be that of an earlier request, and come late: the telescope may be moving already."""
    connection, instrument = await connected()
    instrument.faults.append(not_taken(3101))
    reply = await connection.call(Rpc.AUT_CHANGE_FACE, 0, 0, 0)
    assert reply.code == 3101
    assert len(instrument.requests) == 1


@pytest.mark.parametrize(("code", "times"), [(3081, 1), (3080, 3), (3109, 3)])
async def test_why_a_request_was_not_taken_comes_back_as_its_code(code: int, times: int) -> None:
    """An unknown procedure is told at once; what may go well next time is tried three times."""
    connection, instrument = await connected()
    instrument.faults.extend([not_taken(code)] * times)
    assert (await connection.call(Rpc.TMC_SET_PRISM_CORR, 0.0)).code == code
    assert not instrument.faults


async def test_damaged_answers_only_end_in_an_error() -> None:
    """Three damaged replies in a row are a fault of the cable."""
    connection, instrument = await connected()
    instrument.faults.extend([damaged] * 3)
    with pytest.raises(InstrumentError, match="only damaged replies"):
        await connection.call(Rpc.TMC_GET_FULL_MEAS, 1)
    await echoed(connection, 2)


async def test_an_abortion_ends_a_search() -> None:
    """A search whose caller was cancelled is ended, and the instrument answers again at once."""
    connection, instrument = await connected()
    instrument.faults.append(late(20.0))
    task = asyncio.create_task(connection.call(Rpc.AUT_PS_SEARCH_WINDOW, timeout_s=60.0))
    await asyncio.sleep(1.0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    abortion = asyncio.create_task(connection.abort())
    await asyncio.sleep(0)
    assert instrument.heard[-1] == b"c"
    port: MemoryPort = connection.port  # type: ignore[assignment]
    transaction = instrument.requests[0].split(b",")[2].rstrip(b":").decode()
    port.come(0.5, f"%R1P,0,{transaction}:8\r\n".encode())
    await abortion
    assert now_s() == pytest.approx(1.5)
    await echoed(connection, 2)
    assert now_s() == pytest.approx(1.5 + ANSWER_S)


async def test_an_abortion_that_is_not_answered_brings_the_line_into_step() -> None:
    """The reply of what was ended may be lost as well."""
    connection, instrument = await connected()
    instrument.faults.append(silent)
    task = asyncio.create_task(connection.call(Rpc.AUT_PS_SEARCH_WINDOW, timeout_s=60.0))
    await asyncio.sleep(1.0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    await connection.abort()
    await echoed(connection, 2)
    assert now_s() == pytest.approx(4.0 + 2 * ANSWER_S)


async def test_an_abortion_of_nothing_does_no_harm() -> None:
    """The instrument's question mark is nobody's reply."""
    connection, _ = await connected()
    await connection.abort()
    await echoed(connection, 2)


async def test_a_search_whose_answer_was_lost_is_not_waited_for() -> None:
    """The answer to what was asked behind it comes without the search's own: that will not come any more."""
    connection, instrument = await connected()
    instrument.faults.append(silent)
    with pytest.raises(InstrumentError, match="AUT_PS_SEARCH_WINDOW was lost"):
        await connection.call(Rpc.AUT_PS_SEARCH_WINDOW, timeout_s=90.0)
    assert now_s() == pytest.approx(4.0 + ANSWER_S)
    await echoed(connection, 2)


async def test_a_search_that_takes_long_is_waited_for() -> None:
    """While the instrument searches it answers nothing; what was asked behind it is answered afterwards."""
    connection, instrument = await connected()
    port: MemoryPort = connection.port  # type: ignore[assignment]
    instrument.busy = True
    task = asyncio.create_task(connection.call(Rpc.AUT_PS_SEARCH_WINDOW, timeout_s=90.0))
    await asyncio.sleep(20.5)
    instrument.busy = False
    asked = [line.split(b",")[2].rstrip(b":").decode() for line in instrument.heard]
    assert len(asked) == 6
    for number, transaction in enumerate(asked):
        port.come(number * ANSWER_S, f"%R1P,0,{transaction}:0\r\n".encode())
    assert (await task).code == 0
    await echoed(connection, 2)


async def test_a_line_that_is_gone_is_told_at_once() -> None:
    """Whoever waits for a reply is told, and everybody after."""
    connection, _ = await connected()
    port: MemoryPort = connection.port  # type: ignore[assignment]
    asyncio.get_running_loop().call_later(0.01, port.unplug)
    for _ in range(2):
        with pytest.raises(InstrumentError, match="the line is gone"):
            await connection.call(Rpc.TMC_GET_FULL_MEAS, 1)
    assert now_s() == pytest.approx(0.01)


async def test_checksums_go_both_ways() -> None:
    """A reply whose checksum is wrong is asked for again."""
    connection, instrument = await connected(checksum=True)

    def other_value(line: str) -> list[tuple[float, bytes]]:
        return [(ANSWER_S, line.replace("7654321", "7654421").encode() + b"\r\n")]

    instrument.faults.append(other_value)
    await echoed(connection, 7654321)
    assert len(instrument.requests) == 2
    assert instrument.requests[0].count(b",") == 3


async def test_the_number_of_decimals_is_what_the_instrument_was_told() -> None:
    """Real numbers are sent with so many."""
    connection, instrument = await connected()
    connection.decimals = 4
    await connection.call(Rpc.AUT_FINE_ADJUST, 1 / 3, 0.5, False)
    assert instrument.requests[0].endswith(b":0.3333,0.5,0")


async def test_connecting_takes_the_wanted_speed() -> None:
    """An instrument that answers at once is taken as it is."""
    cable = Cable(FakeInstrument())
    with capture_logs() as logs:
        connection = await connect(cable.open, 115_200, VirtualClock(0), checksum=False)
    assert connection.port is cable.ports[0]
    assert now_s() == pytest.approx(ANSWER_S)
    assert not logs


@pytest.mark.parametrize("garbles", [True, False])
async def test_connecting_finds_another_speed(garbles: bool) -> None:  # noqa: FBT001 (a parameter of pytest)
    """Whether it is silent or answers rubbish: the speed at which it answers is found, and said."""
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
    await echoed(connection, 2)


async def test_connecting_tries_the_wanted_speed_every_second() -> None:
    """An instrument that is switched on while others are tried is found soon."""
    instrument = FakeInstrument(baud=57_600)
    cable = Cable(instrument)
    instrument.faults.extend([silent] * 4)
    connection = await connect(cable.open, 57_600, VirtualClock(0), checksum=False)
    assert [port.baud for port in cable.ports[:5]] == [57_600, 57_600, 115_200, 57_600, 19_200]
    assert connection.port.baud == 57_600


async def test_connecting_gives_up_when_nothing_answers_at_any_speed() -> None:
    """Every speed has been tried; the message says what to look at, and no port stays open."""
    cable = Cable(FakeInstrument(faults=deque([silent] * 100)))
    with pytest.raises(InstrumentError, match="line: no instrument responds at 115200 baud"):
        await connect(cable.open, 115_200, VirtualClock(0), checksum=False)
    assert {port.baud for port in cable.ports} >= {2400, 4800, 9600, 921_600}
    assert all(port.closed for port in cable.ports)
    assert now_s() < 11


async def test_connecting_ends_the_search_of_a_client_before() -> None:
    """An instrument that searches answers nothing; it is made to stop."""
    cable = Cable(FakeInstrument(busy=True))
    await connect(cable.open, 115_200, VirtualClock(0), checksum=False)
    assert now_s() == pytest.approx(0.5 + ANSWER_S)


async def test_an_instrument_without_checksums_is_told_apart() -> None:
    """It answers, but not with checksums: the message says which setting to change."""
    instrument = FakeInstrument()
    instrument.faults.append(not_taken(3110))
    cable = Cable(instrument)
    with pytest.raises(InstrumentError, match="set checksum = false"):
        await connect(cable.open, 115_200, VirtualClock(0), checksum=True)
    assert cable.ports[0].closed


async def test_a_port_that_cannot_be_opened_ends_the_attempt() -> None:
    """Nothing is probed on a device that is not there."""
    cable = Cable(FakeInstrument(), impossible=frozenset({115_200}))
    with pytest.raises(InstrumentError, match="cannot be opened at 115200"):
        await connect(cable.open, 115_200, VirtualClock(0), checksum=False)
    assert not cable.ports


async def test_closing_closes_the_line() -> None:
    """Nobody can use it afterwards."""
    connection, _ = await connected()
    await connection.close()
    with pytest.raises(InstrumentError):
        await echoed(connection, 1)
