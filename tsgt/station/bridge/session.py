"""The session with one bridge program: decodes its output into readings, responses, and the instrument's state.

No output stops the client, fills the memory, or becomes a measurement with an impossible time or value.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from tsgt.errors import InstrumentError
from tsgt.service import LineSplitter
from tsgt.station.bridge.messages import (
    MAX_LINE_BYTES,
    BridgeVersionError,
    DoneLine,
    HelloLine,
    MeasurementLine,
    ProgramLine,
    SettingsLine,
    SingleMeasurementLine,
    StatusLine,
    decode_program_line,
    response_id,
)
from tsgt.station.instrument import Reading

if TYPE_CHECKING:
    from collections import deque
    from collections.abc import Callable

    from tsgt.clock import Clock
    from tsgt.service import RejectedLines
    from tsgt.station.bridge.timing import LineTimestamper

MAX_LINES_PER_S = 1000
"""An instrument measures up to 20 times a second; a program that prints this much has a bug, and is killed."""

_BYTES_PER_LINE = 1000  # this many bytes count as a line, so that a line without end counts too

READING_QUEUE_CAPACITY = 1000


class BridgeSession:
    """The session with one run of the program; a :class:`~tsgt.service.Listener`.

    Attributes
    ----------
    kill
        Kills the program.
    hello, status, settings
        The last line of each type.
    tracking
        Prism that its measurements belong to; None while it does not track.
    response
        Response to the last command; None while it is pending.
    sent_ns, responded_ns
        When that command was sent, and its response received.
    last_output_ns
        When the program last printed a usable line, or the tracked prism was set.
    error
        Why the session has failed; None while it runs.
    """

    def __init__(
        self,
        name: str,
        clock: Clock,
        timestamper: LineTimestamper,
        readings: deque[Reading],
        rejected: RejectedLines,
    ) -> None:
        self._name = name
        self._clock = clock
        self._timestamper = timestamper
        self._readings = readings
        self._rejected = rejected
        self._splitter = LineSplitter(MAX_LINE_BYTES)
        self._changed = asyncio.Event()
        self._pending: tuple[int, int | None] | None = (
            None  # id of the command, and the prism tracked after it
        )
        self._second, self._lines = -1, 0
        self.kill: Callable[[], None] = lambda: None
        self.hello: HelloLine | None = None
        self.status = StatusLine()
        self.settings = SettingsLine()
        self.tracking: int | None = None
        self.response: DoneLine | SingleMeasurementLine | None = None
        self.sent_ns = self.responded_ns = 0
        self.last_output_ns = clock.monotonic_ns()
        self.error: InstrumentError | None = None

    async def wait_until(
        self,
        condition: Callable[[], bool],
        timeout_s: float,
        problem: str,
        *,
        restart_on_output: bool = False,
    ) -> None:
        """Wait until a condition is met.

        ``problem``: what is wrong after the timeout. ``restart_on_output``: whether each usable line restarts the
        timeout. Raises InstrumentError if the timeout has expired, or the program has ended.
        """
        timeout_ns = round(timeout_s * 1e9)
        start_ns = self._clock.monotonic_ns()
        while not condition():
            if self.error is not None:
                raise self.error
            since_ns = self.last_output_ns if restart_on_output else start_ns
            left_ns = since_ns + timeout_ns - self._clock.monotonic_ns()
            if left_ns <= 0:
                reason = f" ({self._rejected.last})" if self._rejected.last else ""
                self.fail(f"the program {problem}{reason}; it is restarted")
                continue
            self._changed.clear()
            try:
                async with asyncio.timeout(left_ns / 1e9):
                    await self._changed.wait()
            except TimeoutError:
                pass  # output of the same moment still counts

    def command_sent(self, number: int, tracking: int | None) -> None:
        """Expect the response to a command, after which the program tracks this prism, or none."""
        self.response, self._pending = None, (number, tracking)
        self.sent_ns = self._clock.monotonic_ns()

    def set_tracking(self, prism: int | None) -> None:
        """Assign later measurements to this prism, and drop pending readings of any other."""
        if prism is not None:
            kept = [reading for reading in self._readings if reading.prism == prism]
            self._readings.clear()
            self._readings.extend(kept)
            self._timestamper.drop_other_prisms(prism)
        self.tracking = prism
        self.last_output_ns = self._clock.monotonic_ns()

    def fail(self, reason: str) -> None:
        """End the session and kill the program."""
        if self.error is None:
            self.error = InstrumentError(f"{self._name}: {reason}")
            self._changed.set()
            self.kill()

    # --- Listener ---------------------------------------------------------------------------------------------

    def output_received(self, data: bytes, at_ns: int) -> None:
        """Process output of the program."""
        if at_ns // 1_000_000_000 != self._second:
            self._second, self._lines = at_ns // 1_000_000_000, 0
        self._lines += data.count(b"\n") + len(data) // _BYTES_PER_LINE
        if self._lines > MAX_LINES_PER_S:
            self.fail(f"the program prints more than {MAX_LINES_PER_S} lines in a second; it is restarted")
        if self.error is not None:
            return
        decoded = [(line, self._decode(line)) for line in self._splitter.push(data)]
        measurements = sum(isinstance(record, MeasurementLine) for _, record in decoded)
        for line, record in decoded:
            if record is not None and self.error is None:
                self._process(record, line, at_ns, together=measurements > 1)
        self._changed.set()

    def exited(self, reason: str) -> None:
        """End the session: the program has ended."""
        self.fail(f"the program has ended ({reason}); it is restarted")

    def _decode(self, line: bytes) -> ProgramLine | None:
        try:
            return decode_program_line(line)
        except BridgeVersionError as error:
            self.fail(f"the program {error}")
        except ValueError as error:
            self._rejected.add(str(error), line)
            if self._pending is not None and response_id(line) == self._pending[0]:
                return DoneLine(id=self._pending[0], error=f"invalid response: {error}")
        return None

    def _process(self, record: ProgramLine, line: bytes, at_ns: int, *, together: bool) -> None:
        if isinstance(record, HelloLine):
            if self.hello is not None:
                self.fail("the program has sent a second hello; it is restarted")
                return
            self.hello = record
            self._timestamper.program_started(record)
        elif self.hello is None and not isinstance(record, StatusLine):
            self._rejected.add("it precedes hello", line)
            return
        self.last_output_ns = at_ns
        match record:
            case StatusLine():
                self.status = record
            case SettingsLine():
                self.settings = record
            case DoneLine() | SingleMeasurementLine():
                self._process_response(record, at_ns)
            case MeasurementLine():
                self._process_measurement(record, line, at_ns, together=together)

    def _process_response(self, record: DoneLine | SingleMeasurementLine, at_ns: int) -> None:
        if self._pending is None or record.id != self._pending[0]:
            return  # to a command that was given up
        (_, tracking), self._pending = self._pending, None
        self.response, self.responded_ns = record, at_ns
        if isinstance(record, SingleMeasurementLine) or not record.error:
            self.set_tracking(tracking)

    def _process_measurement(
        self, record: MeasurementLine, line: bytes, at_ns: int, *, together: bool
    ) -> None:
        if self.tracking is None:
            return
        if record.prism is not None and record.prism != self.tracking:
            self._rejected.add(f"it is of prism {record.prism}, but prism {self.tracking} is tracked", line)
            return
        for each in self._timestamper.push(record, self.tracking, at_ns, together=together):
            if isinstance(each, str):
                self._rejected.add(each, line)
            elif len(self._readings) >= READING_QUEUE_CAPACITY:
                self._rejected.add("the queue of readings is full", line)
            else:
                self._readings.append(reading_of(*each))
                self._rejected.last = ""


def reading_of(
    line: MeasurementLine | SingleMeasurementLine,
    prism: int | None,
    at_ns: int,
    received_ns: int,
    sigma_ns: int = 0,
) -> Reading:
    """Return the reading of a line; parameters as in :class:`~tsgt.station.instrument.Reading`."""
    return Reading(
        at_ns=at_ns,
        prism=prism,
        horizontal_angle_rad=line.horizontal_angle_rad or 0.0,
        zenith_angle_rad=line.zenith_angle_rad or 0.0,
        slope_distance_m=line.slope_distance_m,
        status=line.status,
        raw_status=line.raw_status,
        instrument_time_ns=line.instrument_time_ns,
        received_ns=received_ns,
        sigma_ns=sigma_ns,
    )
