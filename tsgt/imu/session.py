"""The session with one run of the program: decodes its output, and finds that it is of no use any more.

No output stops the master, fills the memory, or becomes a sample with an impossible time or value.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from tsgt.errors import InstrumentError
from tsgt.imu.lines import (
    MAX_LINE_BYTES,
    FormatVersionError,
    HelloLine,
    SamplesLine,
    StatusLine,
    decode_program_line,
)
from tsgt.imu.odometry_lines import OdometryHelloLine, OdometryLine
from tsgt.service import LineSplitter, printable

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.clock import Clock
    from tsgt.imu.sampler import DeviceSampler
    from tsgt.service import RejectedLines

HELLO_TIMEOUT_S = 30.0  # time for a silent program to find its device; each status restarts it

MAX_LINES_PER_S = 5_000
_BYTES_PER_LINE = 1_000  # this many bytes count as a line, so that a line without end counts too
"""A program that prints this much has a bug, and is killed: the fastest device needs 1 MB a second."""

AnyHello = HelloLine | OdometryHelloLine
AnySamples = SamplesLine | OdometryLine


class ImuSession:
    """The session with one run of the program of an IMU or, with another ``decode``, of wheel odometry: a :class:`~tsgt.service.Listener`.

    Attributes
    ----------
    kill
        Kills the program.
    hello, status
        The last line of each type.
    """

    def __init__(
        self,
        name: str,
        clock: Clock,
        sampler: DeviceSampler[Any, Any],
        rejected: RejectedLines,
        *,
        stall_timeout_s: float,
        on_hello: Callable[[Any], None],
        on_samples: Callable[[Any], None],
        decode: Callable[[bytes], AnyHello | AnySamples | StatusLine | None] = decode_program_line,
    ) -> None:
        self._decode_line = decode
        self._name = name
        self._clock = clock
        self._sampler = sampler
        self._rejected = rejected
        self._stall_timeout_s = stall_timeout_s
        self._on_hello = on_hello
        self._on_samples = on_samples
        self._splitter = LineSplitter(MAX_LINE_BYTES)
        self._error: InstrumentError | None = None
        self._failed = asyncio.Event()
        self._second = -1
        self._lines = 0
        self._last_use_ns = clock.monotonic_ns()
        self.kill: Callable[[], None] = lambda: None
        self.hello: AnyHello | None = None
        self.status = StatusLine()

    async def run(self) -> None:
        """Return never; raises InstrumentError when the program is of no use any more."""
        while self._error is None:
            timeout_s = HELLO_TIMEOUT_S if self.hello is None else self._stall_timeout_s
            left_ns = self._last_use_ns + round(timeout_s * 1e9) - self._clock.monotonic_ns()
            if left_ns <= 0:
                what = "has not sent hello" if self.hello is None else "has printed no usable sample"
                reason = f" ({self._rejected.last})" if self._rejected.last else ""
                self._fail(f"the program {what} for {timeout_s:g} s{reason}; it is restarted")
                break
            try:
                async with asyncio.timeout(left_ns / 1e9):
                    await self._failed.wait()
            except TimeoutError:
                pass  # output of the meantime counts
        assert self._error is not None  # noqa: S101 (the loop's condition)
        raise self._error

    def _fail(self, reason: str) -> None:
        if self._error is None:
            self._error = InstrumentError(f"{self._name}: {reason}")
            self._failed.set()
            self.kill()

    # --- Listener ---------------------------------------------------------------------------------------------

    def output_received(self, data: bytes, at_ns: int) -> None:
        """Process output of the program."""
        if at_ns // 1_000_000_000 != self._second:
            self._second, self._lines = at_ns // 1_000_000_000, 0
        self._lines += data.count(b"\n") + len(data) // _BYTES_PER_LINE
        if self._lines > MAX_LINES_PER_S:
            self._fail("the program prints more than any device; it is restarted")
        if self._error is not None:
            return
        for line in self._splitter.push(data):
            record = self._decode(line)
            if record is not None and self._error is None:
                self._process(record, line, at_ns)

    def exited(self, reason: str) -> None:
        """End the session: the program has ended."""
        self._fail(f"the program has ended ({reason}); it is restarted")

    def _decode(self, line: bytes) -> AnyHello | AnySamples | StatusLine | None:
        try:
            return self._decode_line(line)
        except FormatVersionError as error:
            self._fail(f"the program {error}")
        except ValueError as error:
            self._rejected.add(str(error), line)
        return None

    def _process(self, record: AnyHello | AnySamples | StatusLine, line: bytes, at_ns: int) -> None:
        if isinstance(record, StatusLine):
            self.status = StatusLine(activity=printable(record.activity), problem=printable(record.problem))
            if self.hello is None:
                self._last_use_ns = at_ns
        elif isinstance(record, AnyHello):
            if self.hello is not None:
                self._fail("the program has sent a second hello; it is restarted")
                return
            self.hello, self._last_use_ns = record, at_ns
            self._sampler.program_started(record)
            self._on_hello(record)
        elif self.hello is None:
            self._rejected.add("it precedes hello", line)
        else:
            self._take(record, line, at_ns)

    def _take(self, record: AnySamples, line: bytes, at_ns: int) -> None:
        dropped = self._sampler.dropped
        try:
            records = self._sampler.push(record, at_ns)
        except ValueError as error:
            self._rejected.add(str(error), line)
            return
        if self._sampler.dropped > dropped:
            self._rejected.add(f"a sample: {self._sampler.problem}", line)
        # The first fit of the device's clock takes as long as the program may be silent.
        waiting = self._sampler.clock_skew_ppm is None and self._sampler.dropped == dropped
        if records or waiting:
            self._last_use_ns = at_ns
            self._rejected.last = ""
        for each in records:
            self._on_samples(each)
