"""The instrument's side of GeoCOM in ASCII: parses requests, executes commands one at a time, formats responses."""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from tsgt.simulation.instrument.geocom.commands import Response
from tsgt.simulation.instrument.geocom.measuring_commands import MEASURING_COMMANDS
from tsgt.simulation.instrument.geocom.pointing_commands import LICENSED_RPCS, POINTING_COMMANDS
from tsgt.simulation.instrument.geocom.setting_commands import SETTING_COMMANDS
from tsgt.station.geocom import ReturnCode

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from tsgt.config import InstrumentModelConfig
    from tsgt.simulation.instrument.geocom.commands import Commands, Job, Value
    from tsgt.simulation.instrument.model import TotalStationModel
    from tsgt.simulation.kernel import Handle, Timeline

COMMANDS: Commands = {**SETTING_COMMANDS, **MEASURING_COMMANDS, **POINTING_COMMANDS}

STALL_S: Final = (0.3, 0.7)

_REQUEST: Final = re.compile(rb"%R1Q,(\d+)(?:,(\d+))?(?:,(\d+))?:(.*)", re.DOTALL)
_PARAMETER: Final = re.compile(r'"(?:[^"\\]|\\.)*"|[^,]+')
_QUEUE: Final = 4
_MAX_LINE: Final = 1024


@dataclass(slots=True)
class ForcedResponse:
    """Return code to send instead of executing a command."""

    code: int = 0
    com_code: int = 0  # return code of the transport
    rpc: int | None = None  # the command it applies to; None: any
    times: int = 1  # number of uses


@dataclass(slots=True)
class _Request:
    rpc: int
    transaction: int
    checksum: bool


class GeoComServer:
    """Executes requests one at a time; further requests wait in a short queue that drops the oldest.

    Attributes
    ----------
    on_send
        Called with each response when its first byte leaves.
    """

    def __init__(
        self,
        station: TotalStationModel,
        timeline: Timeline,
        model: InstrumentModelConfig,
        generator: np.random.Generator,
    ) -> None:
        self._station = station
        self._timeline = timeline
        self._rng = generator
        self._processing_ms = model.processing_min_ms
        self._processing_range_ms = model.processing_max_ms - model.processing_min_ms
        self.processing_factor = 1.0  # by which processing takes longer than usual
        self._stalls_per_min = model.stalls_per_min
        self._next_stall_ns = self._draw_stall()
        self._buffer = b""
        self._waiting: deque[bytes] = deque(maxlen=_QUEUE)
        self._request: _Request | None = None
        self._job: Job | None = None
        self._event: Handle | None = None
        self.on_send: Callable[[bytes], None] = lambda _: None
        self.forced: deque[ForcedResponse] = deque()  # responses to force
        # Code of a procedure that it does not have: 5 or 27 on some firmware. None: the request is not understood.
        self.unknown_code: ReturnCode | None = None

    def receive(self, data: bytes) -> None:
        """Process bytes. CR or LF ends a line; empty lines are ignored."""
        *lines, rest = (self._buffer + data).replace(b"\n", b"\r").split(b"\r")
        self._buffer = rest[-_MAX_LINE:]
        for line in lines:
            if line == b"c":
                self._abort()
            elif line and self._request is None:
                self._handle_line(line)
            elif line:
                self._waiting.append(line)

    def reset(self) -> None:
        """Drop all input and the running command: power-off."""
        if self._event is not None:
            self._event.cancel()
        if self._job is not None:
            self._job.close()
        self._buffer, self._request, self._job, self._event = b"", None, None, None
        self._waiting.clear()

    def interrupt_movement(self) -> None:
        """Abort a movement or search because the operator takes over."""
        if self._request is not None and self._request.rpc in LICENSED_RPCS:
            self._abort_job()

    def _abort(self) -> None:
        self.on_send(b"?\r\n")
        self._abort_job()

    def _abort_job(self) -> None:
        if self._job is not None and self._event is not None:
            self._event.cancel()
            self._job.close()
            self._finish(Response(ReturnCode.ABORT))

    def _handle_line(self, line: bytes) -> None:
        parts = _REQUEST.fullmatch(line)
        if parts is None:
            if line.startswith(b"%R1Q"):
                self._reject(_Request(0, 0, checksum=False), ReturnCode.COM_WRONG_FORMAT)
            return
        rpc, transaction, checksum, text = parts.groups()
        request = _Request(int(rpc), int(transaction or 0), checksum is not None)
        if checksum is not None:
            bare = b"%%R1Q,%b,%b:%b" % (rpc, transaction, text)
            if crc_16(bare) != int(checksum):
                self._reject(request, ReturnCode.COM_SRVR_RX_CHECKSUM_ERROR)
                return
        forced = self._take_forced(request.rpc)
        if forced is not None:
            self._request = request
            self._finish(Response(forced.code, com_code=forced.com_code))
            return
        command = COMMANDS.get(request.rpc)
        if command is None or request.rpc in self._station.generation.unknown:
            self._reject_unknown(request)
            return
        signature, execute = command
        try:
            values = _decode(signature, text.decode("ascii"))
        except ValueError:
            self._reject(request, ReturnCode.COM_CANT_DECODE_REQ)
            return
        self._request = request
        if request.rpc in LICENSED_RPCS and not self._station.robotic_licence:
            self._finish(Response(ReturnCode.NA))
            return
        response = execute(self._station, *values)
        if isinstance(response, Response):
            self._finish(response)
        else:
            self._job = response
            self._resume_job()

    def _resume_job(self) -> None:
        assert self._job is not None  # noqa: S101 (only called with a job)
        try:
            at_ns = next(self._job)
        except StopIteration as done:
            self._finish(done.value)
        else:
            self._event = self._timeline.call_at(at_ns, self._resume_job)

    def _reject(self, request: _Request, com_code: int) -> None:
        self._request = request
        self._finish(Response(com_code=com_code))

    def _reject_unknown(self, request: _Request) -> None:
        if self.unknown_code is None:
            self._reject(request, ReturnCode.COM_PROC_UNAVAIL)
        else:
            self._request = request
            self._finish(Response(self.unknown_code))

    def _finish(self, response: Response) -> None:
        """Send a response after the processing time."""
        self._job = None
        now_ns = self._timeline.now_ns()
        processing_ms = self._processing_ms + self._processing_range_ms * self._rng.random()
        processing_ms *= self.processing_factor
        if now_ns >= self._next_stall_ns:
            processing_ms = self._rng.uniform(*STALL_S) * 1e3
            self._next_stall_ns = self._draw_stall()
        self._event = self._timeline.call_at(
            now_ns + round(processing_ms * 1e6), lambda: self._send(response)
        )

    def _send(self, response: Response) -> None:
        request = self._request
        assert request is not None  # noqa: S101 (set before the job)
        self._request = self._event = None
        if response.distance is not None:
            self._station.report(response.distance)
        body = ":" + ",".join([str(response.code), *(self._text(value) for value in response.values)])
        head = f"%R1P,{response.com_code},{request.transaction}"
        if request.checksum:
            head += f",{crc_16((head + body).encode('ascii'))}"
        self.on_send(f"{head}{body}\r\n".encode("ascii"))
        while self._waiting and self._request is None:
            self._handle_line(self._waiting.popleft())

    def _text(self, value: Value) -> str:
        """Format a value as in the manual: doubles without trailing zeros."""
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

    def _take_forced(self, rpc: int) -> ForcedResponse | None:
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
    """Decode parameters by a signature, see :class:`Command`.

    Raises
    ------
    ValueError
        Wrong number or type of parameters.
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
    """Return the checksum of a line, CRC-16/ARC (polynomial 0x8005, reflected), bit by bit."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc
