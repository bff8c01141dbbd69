"""A connection to a GeoCOM instrument over a line that may lose, delay, duplicate and damage requests and replies.

Late and duplicate replies are recognised by their transaction number. An instrument takes one request at a time: after a
cancelled call the next one waits until the pending reply has come or cannot come any more.
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

_CLEAR: Final = b"\n"  # clears the instrument's input buffer
_ABORT: Final = b"c\r\n"

_TRIES: Final = 3
_RESPONSE_TIMEOUT_S: Final = 1.0  # above the longest pause of a healthy instrument, 0.7 s
_BAUD_TIMEOUT_S: Final = 0.5  # two in turn: the configured baud rate is tried every second
_ABORT_TIMEOUT_S: Final = 5.0  # a turning telescope has to stop
_PROBE_INTERVAL_S: Final = 4.0  # only searches take longer
_NETWORK_DELAY_S: Final = 2.0  # added to every timeout over a network: bursts and repeated packets of a Wi-Fi
_PAUSE_S: Final = 0.05
_WAKE_UP_S: Final = 0.5

_BAUDS: Final = (115_200, 19_200, 9600, 57_600, 38_400, 230_400, 460_800, 921_600, 4800, 2400)
"""Baud rates of Leica instruments, common ones first."""

_NOT_EXECUTED: Final = frozenset(
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
"""The request was damaged, or came at a bad time: it was not executed, and a retry may succeed."""

_ASLEEP: Final = frozenset({ReturnCode.COM_SRVR_IS_SLEEPING, ReturnCode.COM_SRVR_IS_OFF})

_NOT_IDEMPOTENT: Final = frozenset(
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
"""Procedures that move the telescope or take long are never repeated here: a second face change would undo the first."""


@dataclass(frozen=True, slots=True)
class Reply:
    """An instrument's reply.

    Attributes
    ----------
    code
        Return code of the procedure, or the com code (3072 to 3110) of a request that was not executed.
    values
        Results. An error may come with values and success without any, and a real number may be an int.
    sent_ns, first_byte_ns
        When the request was written, and when the first byte of the reply arrived, on CLOCK_MONOTONIC.
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
    """A request without a reply yet, and the transactions of the probes sent after it to detect that its reply is lost."""

    transaction: int
    sent_ns: int
    until_s: float  # on the event loop's clock
    probe_s: float  # likewise
    probes: list[int] = field(default_factory=list)


class GeoComConnection:
    """The owner of a port to a GeoCOM instrument; ``decimals`` sent must equal the instrument's setting."""

    def __init__(self, port: Port, clock: Clock, *, checksum: bool = False) -> None:
        self.port = port
        self.decimals = 10
        self.over_network = port.baud is None
        self._delay_s = _NETWORK_DELAY_S if self.over_network else 0.0
        self._check = (
            "check the network between them"
            if self.over_network
            else "check that it is on and the cable plugged in"
        )
        self._speaks_geocom = self._received = False
        self._clock = clock
        self._checksum = checksum
        self._lines = ReplyLines(port.baud)
        self._pending: _Pending | None = None
        self._exclusive = asyncio.Lock()
        # Not from 1: a late reply to the previous connection must not match a transaction of this one.
        self._transaction = clock.monotonic_ns() // 1_000_000 % MAX_TRANSACTION

    async def call(self, rpc: Rpc, *parameters: Parameter, timeout_s: float = 3.0) -> Reply:
        """Call a procedure and return its reply; may be cancelled at any time.

        Repeats a request up to twice if it was not delivered, or its reply is damaged or late, unless the procedure
        moves the telescope. Raises InstrumentError if the line is lost, there was no valid reply, or the instrument
        does not respond any more. Raises MessageError if a parameter cannot be encoded.
        """
        silent = False
        async with self._exclusive:
            await self._await_pending()
            for _ in range(_TRIES):
                got = await self._exchange(rpc, parameters, timeout_s)
                if isinstance(got, Reply):
                    # An error without a transaction may belong to an earlier request: the telescope may be moving already.
                    if got.code not in _NOT_EXECUTED or (rpc in _NOT_IDEMPOTENT and got.code not in _ASLEEP):
                        return got
                    await asyncio.sleep(_WAKE_UP_S if got.code in _ASLEEP else _PAUSE_S)
                elif rpc in _NOT_IDEMPOTENT:
                    break
                elif got is _Failure.SILENCE:
                    if silent:
                        break
                    silent = True
                    log.info("instrument_silent", port=self.port.name, rpc=rpc.name, for_s=timeout_s)
                    await self._resynchronise()
                self.port.write(_CLEAR)
        if isinstance(got, Reply):
            return got
        if got is _Failure.LOST:
            raise InstrumentError(
                f"{self.port.name}: the reply to {rpc.name} was lost, or the instrument was switched off and on;"
                f" {self._check}"
            )
        what = "no reply" if got is _Failure.SILENCE else "only damaged replies"
        raise InstrumentError(
            f"{self.port.name}: {what} from the instrument to {rpc.name} within {timeout_s + self._delay_s:g} s;"
            f" {self._check}"
        )

    async def abort(self) -> None:
        """Abort a search or another long procedure, whether its caller still waits or was cancelled, and await its reply.

        Raises InstrumentError if the line is lost, or the instrument does not respond any more.
        """
        self.port.write(_ABORT)
        async with self._exclusive:
            if self._pending is not None:
                self._pending.until_s = min(self._pending.until_s, _now_s() + _ABORT_TIMEOUT_S)
                await self._await_pending()

    async def is_responding(self, *, abort: bool, timeout_s: float = _RESPONSE_TIMEOUT_S) -> bool:
        """Clear the line and return whether the instrument responds.

        ``abort``: whether to abort its current procedure; it does not respond during a search. Raises InstrumentError
        if the line is lost, or the instrument does not support checksums.
        """
        self.port.drain()
        self._lines.clear()
        self.port.write(_ABORT + _CLEAR if abort else _CLEAR)
        got = await self._exchange(Rpc.COM_NULL_PROC, (), timeout_s)
        if not isinstance(got, Reply):
            return False
        if got.code == ReturnCode.COM_NO_CHECKSUM:
            raise InstrumentError(
                f"{self.port.name}: this instrument does not support checksums ({name_of(got.code)});"
                " set checksum = false in the configuration"
            )
        return True

    async def close(self) -> None:
        """Close the port; the instrument continues its procedure."""
        await self.port.close()

    async def greet(self) -> None:
        """Wait until the instrument at the other end of a network connection responds.

        Aborts a search that an earlier client has started, which keeps it from responding. Raises InstrumentError if it
        does not respond, or something else does.
        """
        lost = ""
        try:
            for abort in (False, False, True):
                if await self.is_responding(abort=abort):
                    return
        except InstrumentError as error:
            if self._speaks_geocom or not self._received:
                raise
            lost = " and closed the connection"
            cause: InstrumentError | None = error
        else:
            cause = None
        if self._received and not self._speaks_geocom:
            raise InstrumentError(
                f"{self.port.name}: something else than an instrument answers there{lost}: check address and port, and that"
                " its interface is set to GeoCOM"
            ) from cause
        raise InstrumentError(
            f"{self.port.name}: connected, but no instrument responds; check that it is on, that its interface is set to"
            " GeoCOM, and that no other program is connected to it"
        )

    async def _resynchronise(self) -> None:
        for abort in (False, False, True):
            if await self.is_responding(abort=abort):
                return
        raise InstrumentError(f"{self.port.name}: the instrument does not respond any more; {self._check}")

    async def _await_pending(self) -> None:
        """Await the reply to the request of a cancelled call."""
        if self._pending is not None and await self._receive(self._pending) is _Failure.SILENCE:
            await self._resynchronise()

    async def _exchange(
        self, rpc: Rpc, parameters: Sequence[Parameter], timeout_s: float
    ) -> Reply | _Failure:
        request, now_s = self._request(rpc, parameters), _now_s() + self._delay_s
        sent_ns = self._clock.monotonic_ns()
        self._pending = _Pending(self._transaction, sent_ns, now_s + timeout_s, now_s + _PROBE_INTERVAL_S)
        self.port.write(request)
        return await self._receive(self._pending)

    def _request(self, rpc: Rpc, parameters: Sequence[Parameter]) -> bytes:
        self._transaction = self._transaction % MAX_TRANSACTION + 1
        return encode_request(
            rpc,
            parameters,
            transaction=self._transaction,
            checksum=self._checksum,
            decimals=self.decimals,
        )

    def _send_probe(self, pending: _Pending) -> None:
        """Send a request after one that takes long. Replies come in order: when this reply comes first, the other is lost."""
        pending.probe_s = _now_s() + self._delay_s + _PROBE_INTERVAL_S
        self.port.write(_CLEAR + self._request(Rpc.COM_NULL_PROC, ()))
        pending.probes.append(self._transaction)

    async def _receive(self, pending: _Pending) -> Reply | _Failure:
        """Return the reply to the pending request. Nothing is lost when this is cancelled."""
        while True:
            try:
                async with asyncio.timeout_at(min(pending.until_s, pending.probe_s)):
                    while True:
                        chunk = await self.port.read()
                        self._received = True
                        for line in self._lines.push(chunk):
                            got = self._reply(line, pending)
                            if got is not None:
                                self._pending = None
                                return got
            except TimeoutError:
                if pending.until_s <= pending.probe_s:  # not by the clock: a timeout may fire slightly early
                    self._pending = None
                    return _Failure.SILENCE
                self._send_probe(pending)

    def _reply(self, line: StampedLine, pending: _Pending) -> Reply | _Failure | None:
        try:
            reply = decode_reply(line.data, checksum=self._checksum)
        except MessageError:
            return _Failure.DAMAGE
        self._speaks_geocom = True
        if reply.transaction in pending.probes:
            return _Failure.LOST if not reply.com_code else None
        if reply.transaction != pending.transaction and not (reply.com_code and reply.transaction == 0):
            return None  # late, or a duplicate
        # USB ignores the baud rate: data that arrives faster than it allows still arrived after the request.
        first_byte_ns = max(line.first_byte_ns, pending.sent_ns)
        return Reply(reply.com_code or reply.code, reply.values, pending.sent_ns, first_byte_ns)


async def connect(open_port: OpenPort, baud: int, clock: Clock, *, checksum: bool) -> GeoComConnection:
    """Open a port and find the baud rate at which an instrument responds; a network has none.

    ``baud``: tried first, and again between all others. ``checksum``: whether every line carries a checksum. Raises
    InstrumentError if the port cannot be opened, or no instrument responds at any baud rate; that takes ten seconds.
    """
    opened = ""
    for number, candidate in enumerate(_candidates(baud)):
        try:
            port = await open_port(candidate)
        except InstrumentError:
            if candidate == baud:
                raise
            continue  # not every adapter supports every baud rate
        opened = port.name
        connection = GeoComConnection(port, clock, checksum=checksum)
        try:
            if connection.over_network:
                await connection.greet()
                return connection
            # A search started by an earlier client keeps the instrument from responding.
            abort = number > 0 and candidate == baud
            responds = await connection.is_responding(abort=abort, timeout_s=_BAUD_TIMEOUT_S)
        except BaseException:
            await connection.close()
            raise
        if responds:
            if candidate != baud:
                log.warning("instrument_baud_found", port=opened, baud=candidate, configured=baud)
            return connection
        await connection.close()
    raise InstrumentError(
        f"{opened}: no instrument responds at {baud} baud or at other rates; check that it is on, that its interface is set to"
        " this port and to GeoCOM, and the cable"
    )


def _candidates(baud: int) -> Iterator[int]:
    yield baud
    for other in _BAUDS:
        if other != baud:
            yield baud
            yield other


def _now_s() -> float:
    return asyncio.get_running_loop().time()
