"""The instrument's side of GeoCOM in ASCII: lines to procedures, answers to lines, one after the other.

Written from the manual apart from the client's side, so that each checks the other.
"""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from tsgt.simulation.instrument.geocom.answers import Answer
from tsgt.simulation.instrument.geocom.measuring import MEASURING
from tsgt.simulation.instrument.geocom.pointing import LICENSED, SEARCHING
from tsgt.simulation.instrument.geocom.setting import SETTING
from tsgt.station.geocom import ReturnCode

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from tsgt.config import InstrumentModelConfig
    from tsgt.simulation.instrument.geocom.answers import Job, Procedures, Value
    from tsgt.simulation.instrument.total_station import SimulatedTotalStation
    from tsgt.simulation.kernel import Handle, Timeline

PROCEDURES: Procedures = {**SETTING, **MEASURING, **SEARCHING}

STALL_S: Final = (0.3, 0.7)

_REQUEST: Final = re.compile(rb"%R1Q,(\d+)(?:,(\d+))?(?:,(\d+))?:(.*)", re.DOTALL)
_PARAMETER: Final = re.compile(r'"(?:[^"\\]|\\.)*"|[^,]+')
_QUEUE: Final = 4
_MAX_LINE: Final = 1024


@dataclass(slots=True)
class Forced:
    """A code that is answered instead of doing anything.

    Attributes
    ----------
    code
        Of the procedure.
    com_code
        Of the transport.
    rpc
        To this procedure; None: to whatever comes.
    times
        How often.
    """

    code: int = 0
    com_code: int = 0
    rpc: int | None = None
    times: int = 1


@dataclass(slots=True)
class _Request:
    rpc: int
    transaction: int
    checksum: bool


class GeoComServer:
    """Answers requests one after the other; those that come meanwhile wait, and too many are lost.

    Parameters
    ----------
    station
        What it speaks for.
    timeline
        The true time.
    model
        How long it thinks.
    generator
        Source of all randomness.

    Attributes
    ----------
    on_send
        Called with each answer.
    forced
        Codes to answer with.
    """

    def __init__(
        self,
        station: SimulatedTotalStation,
        timeline: Timeline,
        model: InstrumentModelConfig,
        generator: np.random.Generator,
    ) -> None:
        self._station = station
        self._timeline = timeline
        self._rng = generator
        self._thinks_ms = model.processing_min_ms, model.processing_max_ms
        self._stalls_per_min = model.stalls_per_min
        self._next_stall_ns = self._draw_stall()
        self._buffer = b""
        self._waiting: deque[bytes] = deque(maxlen=_QUEUE)
        self._request: _Request | None = None
        self._job: Job | None = None
        self._event: Handle | None = None
        self.on_send: Callable[[bytes], None] = lambda _: None
        self.forced: deque[Forced] = deque()

    def receive(self, data: bytes) -> None:
        """Take bytes. A line ends with CR or LF; an empty one means nothing."""
        *lines, rest = (self._buffer + data).replace(b"\n", b"\r").split(b"\r")
        self._buffer = rest[-_MAX_LINE:]
        for line in lines:
            if line == b"c":
                self._abort()
            elif line and self._request is None:
                self._begin(line)
            elif line:
                self._waiting.append(line)

    def forget(self) -> None:
        """Forget what has come, and what is under way: it is switched off."""
        if self._event is not None:
            self._event.cancel()
        if self._job is not None:
            self._job.close()
        self._buffer, self._request, self._job, self._event = b"", None, None, None
        self._waiting.clear()

    def interrupt_movement(self) -> None:
        """End what moves the telescope, because a person has taken it over; its answer says that it was ended."""
        if self._request is not None and self._request.rpc in LICENSED:
            self._end_job()

    def _abort(self) -> None:
        self.on_send(b"?\r\n")
        self._end_job()

    def _end_job(self) -> None:
        if self._job is not None and self._event is not None:
            self._event.cancel()
            self._job.close()
            self._finish(Answer(ReturnCode.ABORT))

    def _begin(self, line: bytes) -> None:
        parts = _REQUEST.fullmatch(line)
        if parts is None:
            if line.startswith(b"%R1Q"):
                self._refuse(_Request(0, 0, checksum=False), ReturnCode.COM_WRONG_FORMAT)
            return
        rpc, transaction, checksum, text = parts.groups()
        request = _Request(int(rpc), int(transaction or 0), checksum is not None)
        if checksum is not None:
            bare = b"%%R1Q,%b,%b:%b" % (rpc, transaction, text)
            if crc_16(bare) != int(checksum):
                self._refuse(request, ReturnCode.COM_SRVR_RX_CHECKSUM_ERROR)
                return
        forced = self._take_forced(request.rpc)
        if forced is not None:
            self._request = request
            self._finish(Answer(forced.code, com_code=forced.com_code))
            return
        procedure = PROCEDURES.get(request.rpc)
        if procedure is None:
            self._refuse(request, ReturnCode.COM_PROC_UNAVAIL)
            return
        signature, run = procedure
        try:
            values = _decode(signature, text.decode("ascii"))
        except ValueError:
            self._refuse(request, ReturnCode.COM_CANT_DECODE_REQ)
            return
        self._request = request
        if request.rpc in LICENSED and not self._station.robotic_licence:
            self._finish(Answer(ReturnCode.NA))
            return
        answer = run(self._station, *values)
        if isinstance(answer, Answer):
            self._finish(answer)
        else:
            self._job = answer
            self._go_on()

    def _go_on(self) -> None:
        assert self._job is not None  # noqa: S101 (it has been scheduled)
        try:
            at_ns = next(self._job)
        except StopIteration as done:
            self._finish(done.value)
        else:
            self._event = self._timeline.call_at(at_ns, self._go_on)

    def _refuse(self, request: _Request, com_code: int) -> None:
        self._request = request
        self._finish(Answer(com_code=com_code))

    def _finish(self, answer: Answer) -> None:
        """Answer after having thought."""
        self._job = None
        now_ns = self._timeline.now_ns()
        thinks_ms = self._rng.uniform(*self._thinks_ms)
        if now_ns >= self._next_stall_ns:
            thinks_ms = self._rng.uniform(*STALL_S) * 1e3
            self._next_stall_ns = self._draw_stall()
        self._event = self._timeline.call_at(now_ns + round(thinks_ms * 1e6), lambda: self._send(answer))

    def _send(self, answer: Answer) -> None:
        request = self._request
        assert request is not None  # noqa: S101 (the answer is to it)
        self._request = self._event = None
        if answer.offered is not None:
            self._station.offer(answer.offered)
        body = ":" + ",".join([str(answer.code), *(self._text(value) for value in answer.values)])
        head = f"%R1P,{answer.com_code},{request.transaction}"
        if request.checksum:
            head += f",{crc_16((head + body).encode('ascii'))}"
        self.on_send(f"{head}{body}\r\n".encode("ascii"))
        while self._waiting and self._request is None:
            self._begin(self._waiting.popleft())

    def _text(self, value: Value) -> str:
        """Write a value as the manual has it: zeros at the end of a number are not sent."""
        if isinstance(value, float):
            text = f"{value:.{self._station.settings.decimals}f}"
            if "." in text:
                text = text.rstrip("0")
            return text + "0" if text.endswith(".") else text
        if isinstance(value, bytes):
            return f"'{value.hex()}'"
        if isinstance(value, str):
            return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
        return str(int(value))

    def _take_forced(self, rpc: int) -> Forced | None:
        for forced in self.forced:
            if forced.rpc in (None, rpc):
                forced.times -= 1
                if not forced.times:
                    self.forced.remove(forced)
                return forced
        return None

    def _draw_stall(self) -> float:
        if not self._stalls_per_min:
            return float("inf")
        return self._timeline.now_ns() + self._rng.exponential(60e9 / self._stalls_per_min)


def _decode(signature: str, text: str) -> list[float | int | str]:
    """Read parameters.

    Parameters
    ----------
    signature
        A letter for each: d a real number, i a whole one, s a string, b a byte in quotes.
    text
        What stands after the colon.

    Raises
    ------
    ValueError
        Too many, too few, or something else.
    """
    parts = _PARAMETER.findall(text)
    if len(parts) != len(signature):
        raise ValueError(f"{len(parts)} parameters instead of {len(signature)}")
    values: list[float | int | str] = []
    for kind, part in zip(signature, parts, strict=True):
        bare = part.strip()
        if kind == "s":
            if not (bare.startswith('"') and bare.endswith('"')):
                raise ValueError("no string")
            values.append(re.sub(r"\\(.)", r"\1", bare[1:-1]))
        elif kind == "d":
            values.append(float(bare))
        elif kind == "b":
            values.append(int(bare.strip("'"), 16))
        else:
            values.append(int(bare, 0) if bare.lower().startswith("0x") else int(bare))
    return values


def crc_16(data: bytes) -> int:
    """Return the checksum of a line: CRC-16/ARC, bit by bit."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc
