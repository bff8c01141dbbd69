"""The one owner of a line to a GeoCOM instrument: a request, then its reply, and whatever goes wrong in between.

Every request has a transaction number, which its reply repeats: a reply that comes late or twice is known by it and
dropped. An instrument takes one request at a time. When a caller has given up waiting, the next request therefore waits
until the reply has come or cannot come any more.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import TYPE_CHECKING, Final

import structlog

from tsgt.errors import InstrumentError, MessageError
from tsgt.station.geocom.codec import MAX_TRANSACTION, Rpc, decode_reply, encode_request
from tsgt.station.geocom.codes import ReturnCode, name_of
from tsgt.station.geocom.framing import ReplyLines, StampedLine

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from tsgt.clock import Clock
    from tsgt.station.geocom.codec import Parameter
    from tsgt.station.serial import OpenPort, Port

log = structlog.get_logger()

_CLEAR: Final = b"\n"  # empties the instrument's buffer
_ABORT: Final = b"c\r\n"

_TRIES: Final = 3
_ATTENTION_S: Final = 1.0  # above the longest pause of an instrument that does well, 0.7 s
_PROBE_S: Final = 0.5  # two in turn, so that the wanted speed is tried every second
_ABORT_S: Final = 5.0  # a telescope that turns has to stop
_BEHIND_S: Final = 4.0  # hardly anything but a search takes longer
_PAUSE_S: Final = 0.05
_WAKING_S: Final = 0.5

_BAUDS: Final = (115_200, 19_200, 9600, 57_600, 38_400, 230_400, 460_800, 921_600, 4800, 2400)
"""Speeds of Leica instruments, the usual ones first."""

_NOT_TAKEN: Final = frozenset(
    {
        ReturnCode.COM_CANT_DECODE,
        ReturnCode.COM_CANT_RECV,
        ReturnCode.COM_WRONG_FORMAT,
        ReturnCode.COM_CANT_DECODE_REQ,
        ReturnCode.COM_INTR,
        ReturnCode.COM_TR_ID_MISMATCH,
        ReturnCode.COM_OVERRUN,
        ReturnCode.COM_SRVR_RX_CHECKSUM_ERROR,
        ReturnCode.COM_CONS_REQ,
        ReturnCode.COM_SRVR_IS_SLEEPING,
        ReturnCode.COM_SRVR_IS_OFF,
    }
)
"""The line has damaged the request, or it came at a bad time: nothing was carried out, and it may go well next time."""

_ASLEEP: Final = frozenset({ReturnCode.COM_SRVR_IS_SLEEPING, ReturnCode.COM_SRVR_IS_OFF})

_NOT_REPEATED: Final = frozenset(
    {
        Rpc.COM_SWITCH_ON_TPS,
        Rpc.COM_SWITCH_OFF_TPS,
        Rpc.AUT_LOCK_IN,
        Rpc.AUT_MAKE_POSITIONING,
        Rpc.AUT_CHANGE_FACE,
        Rpc.AUT_SEARCH,
        Rpc.AUT_FINE_ADJUST,
        Rpc.AUT_PS_SEARCH_NEXT,
        Rpc.AUT_PS_SEARCH_WINDOW,
        Rpc.BAP_MEAS_DISTANCE_ANGLE,
        Rpc.BAP_SEARCH_TARGET,
    }
)
"""What moves the telescope or takes long is asked for by the caller alone: a second face change would undo the first."""


@dataclass(frozen=True, slots=True)
class Reply:
    """What an instrument answered.

    Attributes
    ----------
    code
        What came of the procedure; where the request was not taken, why not (3072 to 3110: 3081 is a procedure that the
        instrument does not know).
    values
        Its results. There may be some with an error and none with a good code, and a real number may come as an int.
    sent_ns
        When the request was handed to the line, on CLOCK_MONOTONIC, in ns.
    first_byte_ns
        When the first byte of the reply had come, on the same clock.
    """

    code: int
    values: tuple[int | float | str, ...]
    sent_ns: int
    first_byte_ns: int


class _Failure(Enum):
    SILENCE = auto()
    DAMAGE = auto()
    LOST = auto()


@dataclass(slots=True)
class _Pending:
    """A request whose reply has not come, and the numbers of those that were sent behind it to see whether it still can."""

    transaction: int
    sent_ns: int
    until_s: float  # on the event loop's clock
    ask_s: float  # likewise
    behind: list[int] = field(default_factory=list)


class GeoComConnection:
    """Requests and their replies on a line that may lose, delay, double and damage them.

    Parameters
    ----------
    port
        The line, which belongs to this connection from now on.
    clock
        Stamps the requests.
    checksum
        Whether every line carries a checksum.

    Attributes
    ----------
    port
        The line.
    decimals
        Digits right of the point of what is sent; to be kept at what the instrument was told.
    """

    def __init__(self, port: Port, clock: Clock, *, checksum: bool = False) -> None:
        self.port = port
        self.decimals = 10
        self._clock = clock
        self._checksum = checksum
        self._lines = ReplyLines(port.baud)
        self._pending: _Pending | None = None
        self._turn = asyncio.Lock()
        # Not from 1: a reply to the connection before this one must not look like one of ours.
        self._transaction = clock.monotonic_ns() // 1_000_000 % MAX_TRANSACTION

    async def call(self, rpc: Rpc, *parameters: Parameter, timeout_s: float = 3.0) -> Reply:
        """Have a procedure carried out; return its reply.

        A request that did not get through is sent again, at most twice, and so is one whose reply is damaged or did not
        come in time; but not where the procedure moves the telescope. It may be cancelled at any time.

        Parameters
        ----------
        rpc
            The procedure.
        *parameters
            Its parameters.
        timeout_s
            How long the reply may take.

        Raises
        ------
        InstrumentError
            The line is gone, no whole reply came, or the instrument does not answer at all any more.
        MessageError
            The parameters cannot be sent.
        """
        silent = False
        async with self._turn:
            await self._settle()
            for _ in range(_TRIES):
                got = await self._exchange(rpc, parameters, timeout_s)
                if isinstance(got, Reply):
                    # A late error of an earlier request has no number to know it by: what moves may move already.
                    if got.code not in _NOT_TAKEN or (rpc in _NOT_REPEATED and got.code not in _ASLEEP):
                        return got
                    await asyncio.sleep(_WAKING_S if got.code in _ASLEEP else _PAUSE_S)
                elif rpc in _NOT_REPEATED:
                    break
                elif got is _Failure.SILENCE:
                    if silent:
                        break
                    silent = True
                    log.info("instrument_silent", port=self.port.name, rpc=rpc.name, for_s=timeout_s)
                    await self._attend()
                self.port.write(_CLEAR)
        if isinstance(got, Reply):
            return got
        if got is _Failure.LOST:
            raise InstrumentError(
                f"{self.port.name}: the instrument's answer to {rpc.name} was lost, or it was switched off and on meanwhile;"
                " check cable and plugs"
            )
        what = "no answer" if got is _Failure.SILENCE else "only damaged answers"
        raise InstrumentError(
            f"{self.port.name}: {what} from the instrument to {rpc.name} within {timeout_s:g} s; check cable and plugs"
        )

    async def abort(self) -> None:
        """End a search or another long procedure, whose caller was cancelled or still waits, and let it answer.

        Raises
        ------
        InstrumentError
            The line is gone, or the instrument does not answer any more.
        """
        self.port.write(_ABORT)
        async with self._turn:
            if self._pending is not None:
                self._pending.until_s = min(self._pending.until_s, _now_s() + _ABORT_S)
                await self._settle()

    async def answers(self, *, abort: bool, timeout_s: float = _ATTENTION_S) -> bool:
        """Return whether the instrument answers, whatever was on the line before.

        Parameters
        ----------
        abort
            Whether to end what it is at; it answers nothing while it searches.
        timeout_s
            How long it may take.

        Raises
        ------
        InstrumentError
            The line is gone, or the instrument cannot do checksums.
        """
        self.port.drain()
        self._lines.clear()
        self.port.write(_ABORT + _CLEAR if abort else _CLEAR)
        got = await self._exchange(Rpc.COM_NULL_PROC, (), timeout_s)
        if not isinstance(got, Reply):
            return False
        if got.code == ReturnCode.COM_NO_CHECKSUM:
            raise InstrumentError(
                f"{self.port.name}: this instrument knows no checksums ({name_of(got.code)});"
                " set checksum = false in the configuration"
            )
        return True

    async def close(self) -> None:
        """Close the line; the instrument goes on with what it does."""
        await self.port.close()

    async def _attend(self) -> None:
        for abort in (False, False, True):
            if await self.answers(abort=abort):
                return
        raise InstrumentError(
            f"{self.port.name}: the instrument does not answer any more; is it on, is the cable plugged in?"
        )

    async def _settle(self) -> None:
        """Wait for the reply to a request that nobody waits for any more."""
        if self._pending is not None and await self._answer(self._pending) is _Failure.SILENCE:
            await self._attend()

    async def _exchange(
        self, rpc: Rpc, parameters: Sequence[Parameter], timeout_s: float
    ) -> Reply | _Failure:
        request, now_s = self._request(rpc, parameters), _now_s()
        sent_ns = self._clock.monotonic_ns()
        self._pending = _Pending(self._transaction, sent_ns, now_s + timeout_s, now_s + _BEHIND_S)
        self.port.write(request)
        return await self._answer(self._pending)

    def _request(self, rpc: Rpc, parameters: Sequence[Parameter]) -> bytes:
        self._transaction = self._transaction % MAX_TRANSACTION + 1
        return encode_request(
            rpc,
            parameters,
            transaction=self._transaction,
            checksum=self._checksum,
            decimals=self.decimals,
        )

    def _ask_behind(self, pending: _Pending) -> None:
        """Send a request behind one that takes long. Answers come in turn: once this has its own, the other's is lost."""
        pending.ask_s = _now_s() + _BEHIND_S
        self.port.write(_CLEAR + self._request(Rpc.COM_NULL_PROC, ()))
        pending.behind.append(self._transaction)

    async def _answer(self, pending: _Pending) -> Reply | _Failure:
        """Return the reply to a request; it is pending no more then. Nothing is lost when this is cancelled."""
        while True:
            try:
                async with asyncio.timeout_at(min(pending.until_s, pending.ask_s)):
                    while True:
                        for line in self._lines.push(await self.port.read()):
                            got = self._reply(line, pending)
                            if got is not None:
                                self._pending = None
                                return got
            except TimeoutError:
                if pending.until_s <= pending.ask_s:  # not by the clock: a timeout may come a little early
                    self._pending = None
                    return _Failure.SILENCE
                self._ask_behind(pending)

    def _reply(self, line: StampedLine, pending: _Pending) -> Reply | _Failure | None:
        try:
            reply = decode_reply(line.data, checksum=self._checksum)
        except MessageError:
            return _Failure.DAMAGE
        if reply.transaction in pending.behind:
            return _Failure.LOST if not reply.com_code else None
        if reply.transaction != pending.transaction and not (reply.com_code and reply.transaction == 0):
            return None  # it is late, or a second one
        # A line over USB alone has no pace: what comes faster than the stated speed allows still came after the request.
        first_byte_ns = max(line.first_byte_ns, pending.sent_ns)
        return Reply(reply.com_code or reply.code, reply.values, pending.sent_ns, first_byte_ns)


async def connect(open_port: OpenPort, baud: int, clock: Clock, *, checksum: bool) -> GeoComConnection:
    """Open a line at the speed at which an instrument answers on it.

    Parameters
    ----------
    open_port
        Opens the line.
    baud
        The speed that is tried first and, between all others, again and again.
    clock
        Stamps the requests.
    checksum
        Whether every line carries a checksum.

    Raises
    ------
    InstrumentError
        The line cannot be opened, or no instrument answers at any speed; that takes ten seconds.
    """
    opened = ""
    for number, candidate in enumerate(_candidates(baud)):
        try:
            port = await open_port(candidate)
        except InstrumentError:
            if candidate == baud:
                raise
            continue  # not every adapter has every speed
        opened = port.name
        connection = GeoComConnection(port, clock, checksum=checksum)
        try:
            # A search that a client before this one had started keeps the instrument from answering.
            answers = await connection.answers(abort=number > 0 and candidate == baud, timeout_s=_PROBE_S)
        except BaseException:
            await connection.close()
            raise
        if answers:
            if candidate != baud:
                log.warning("instrument_baud_found", port=opened, baud=candidate, configured=baud)
            return connection
        await connection.close()
    raise InstrumentError(
        f"{opened}: no instrument answers at {baud} baud, nor at other speeds; is it on, is its interface set to this port"
        " and to GeoCOM, is it this cable?"
    )


def _candidates(baud: int) -> Iterator[int]:
    yield baud
    for other in _BAUDS:
        if other != baud:
            yield baud
            yield other


def _now_s() -> float:
    return asyncio.get_running_loop().time()
