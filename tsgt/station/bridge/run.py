"""One run of a bridge program: what it says becomes readings, answers, and what is known of the instrument.

Whatever it prints, no line stops the client, fills the memory, or becomes a measurement with a time or a value that
cannot be.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import structlog

from tsgt.errors import InstrumentError
from tsgt.station.bridge.messages import (
    BridgeVersionError,
    DoneLine,
    Hello,
    LineCutter,
    MeasurementLine,
    ProgramLine,
    SettingsLine,
    ShotLine,
    StatusLine,
    command_answered,
    decode_program_line,
    for_people,
)
from tsgt.station.instrument import Reading

if TYPE_CHECKING:
    from collections import deque
    from collections.abc import Callable

    from tsgt.clock import Clock
    from tsgt.station.bridge.timing import Stamper

MOST_LINES_PER_S = 1000
"""An instrument measures twenty times a second. A program that prints so much runs wild, and is ended."""

_LINE_ROOM = 1000
"""So many bytes count as a line, so that one that never ends counts too."""

QUEUE_READINGS = 1000
"""How many readings wait for :meth:`BridgeInstrument.read`."""

SHOWN_BYTES = 120
"""So much of a line that cannot be used stands in the log."""

REFUSED_LOGGED_EVERY_NS = 60_000_000_000

log = structlog.get_logger()


class BridgeRun:
    """One run of the program: what it has said, and what it is to do.

    Attributes
    ----------
    kill
        Ends the program at once.
    hello, status, settings
        The last ones that it said.
    tracking
        The prism that its measurements are of; None while it is not to track.
    answer
        To the command that was given last; None as long as there is none.
    asked_ns, answered_ns
        When that command was given, and when it was answered.
    heard_ns
        When it last said something that can be used, or was told something.
    lost
        Why it can say no more.
    """

    def __init__(
        self,
        name: str,
        clock: Clock,
        stamper: Stamper,
        readings: deque[Reading],
        refusals: Refusals,
    ) -> None:
        self._name = name
        self._clock = clock
        self._stamper = stamper
        self._readings = readings
        self._refusals = refusals
        self._cutter = LineCutter()
        self._changed = asyncio.Event()
        self._expected: tuple[int, int | None] | None = None
        self._second, self._lines = -1, 0
        self.kill: Callable[[], None] = lambda: None
        self.hello: Hello | None = None
        self.status = StatusLine()
        self.settings = SettingsLine()
        self.tracking: int | None = None
        self.answer: DoneLine | ShotLine | None = None
        self.asked_ns = self.answered_ns = 0
        self.heard_ns = clock.monotonic_ns()
        self.lost: InstrumentError | None = None

    async def until(
        self, done: Callable[[], bool], limit_s: float, otherwise: str, *, patient: bool = False
    ) -> None:
        """Wait until something is so.

        Parameters
        ----------
        done
            Says whether it is.
        limit_s, otherwise
            How long is waited, and what is wrong after that.
        patient
            Whether everything that the program says gives it so long again.

        Raises
        ------
        InstrumentError
            It took too long, or the program has ended.
        """
        limit_ns = round(limit_s * 1e9)
        began_ns = self._clock.monotonic_ns()
        while not done():
            if self.lost is not None:
                raise self.lost
            left_ns = (self.heard_ns if patient else began_ns) + limit_ns - self._clock.monotonic_ns()
            if left_ns <= 0:
                why = f" ({self._refusals.last})" if self._refusals.last else ""
                self.lose(f"the program {otherwise}{why}; it is started again")
                continue
            self._changed.clear()
            try:
                async with asyncio.timeout(left_ns / 1e9):
                    await self._changed.wait()
            except TimeoutError:
                pass  # what came in the same moment still counts

    def expect(self, number: int, tracking: int | None) -> None:
        """Wait for the answer to a command, after which the program tracks this prism or none."""
        self.answer, self._expected = None, (number, tracking)
        self.asked_ns = self._clock.monotonic_ns()

    def switch(self, *, tracking: int | None) -> None:
        """Take it that what is measured from now on is of this prism; nothing of another one is still to be read."""
        if tracking is not None:
            kept = [reading for reading in self._readings if reading.prism == tracking]
            self._readings.clear()
            self._readings.extend(kept)
            self._stamper.forget_others(tracking)
        self.tracking = tracking
        self.heard_ns = self._clock.monotonic_ns()

    def lose(self, why: str) -> None:
        """Have done with this run."""
        if self.lost is None:
            self.lost = InstrumentError(f"{self._name}: {why}")
            self._changed.set()
            self.kill()

    # --- Listener ---------------------------------------------------------------------------------------------

    def said(self, data: bytes, at_ns: int) -> None:
        """Take what the program prints."""
        if at_ns // 1_000_000_000 != self._second:
            self._second, self._lines = at_ns // 1_000_000_000, 0
        self._lines += data.count(b"\n") + len(data) // _LINE_ROOM
        if self._lines > MOST_LINES_PER_S:
            self.lose(
                f"the program prints more than {MOST_LINES_PER_S} lines in a second; it is started again"
            )
        if self.lost is not None:
            return
        parsed = [(line, self._decoded(line)) for line in self._cutter.push(data)]
        measured = sum(isinstance(record, MeasurementLine) for _, record in parsed)
        for line, record in parsed:
            if record is not None and self.lost is None:
                self._take(record, line, at_ns, together=measured > 1)
        self._changed.set()

    def ended(self, how: str) -> None:
        """Take it that the program has ended."""
        self.lose(f"the program has ended ({how}); it is started again")

    def _decoded(self, line: bytes) -> ProgramLine | None:
        try:
            return decode_program_line(line)
        except BridgeVersionError as error:
            self.lose(f"the program {error}; use one for this version")
        except ValueError as error:
            self._refusals.add(str(error), line)
            if self._expected is not None and command_answered(line) == self._expected[0]:
                return DoneLine(id=self._expected[0], error=f"the answer cannot be used: {error}")
        return None

    def _take(self, record: ProgramLine, line: bytes, at_ns: int, *, together: bool) -> None:
        if isinstance(record, Hello):
            if self.hello is not None:
                self.lose("the program has begun anew; it is started again")
                return
            self.hello = record
            self._stamper.begin(record)
        elif self.hello is None and not isinstance(record, StatusLine):
            self._refusals.add("it comes before hello", line)
            return
        self.heard_ns = at_ns
        match record:
            case StatusLine():
                self.status = record
            case SettingsLine():
                self.settings = record
            case DoneLine() | ShotLine():
                self._answered(record, at_ns)
            case MeasurementLine():
                self._measured(record, line, at_ns, together=together)

    def _answered(self, record: DoneLine | ShotLine, at_ns: int) -> None:
        if self._expected is None or record.id != self._expected[0]:
            return  # to a command that nobody waits for any more
        (_, tracking), self._expected = self._expected, None
        self.answer, self.answered_ns = record, at_ns
        if isinstance(record, ShotLine) or not record.error:
            self.switch(tracking=tracking)

    def _measured(self, record: MeasurementLine, line: bytes, at_ns: int, *, together: bool) -> None:
        if self.tracking is None:
            return
        if record.prism is not None and record.prism != self.tracking:
            self._refusals.add(
                f"it is of prism {record.prism}, and prism {self.tracking} is to be tracked", line
            )
            return
        for each in self._stamper.push(record, self.tracking, at_ns, together=together):
            if isinstance(each, str):
                self._refusals.add(each, line)
            elif len(self._readings) >= QUEUE_READINGS:
                self._refusals.add("nobody has read so many before it", line)
            else:
                self._readings.append(reading_of(each.line, each.prism, each.at_ns, each.arrived_ns))
                self._refusals.last = ""


class Refusals:
    """Counts lines that cannot be used, and says so in the log once a minute at most.

    Attributes
    ----------
    last
        What was wrong with the last one; empty since the last measurement.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._count = 0
        self._logged_ns: int | None = None
        self.last = ""

    def add(self, reason: str, line: bytes) -> None:
        """Count one."""
        self._count += 1
        self.last = f"a line of the program cannot be used: {for_people(reason)}"
        now_ns = self._clock.monotonic_ns()
        if self._logged_ns is None or now_ns - self._logged_ns >= REFUSED_LOGGED_EVERY_NS:
            self._logged_ns = now_ns
            shown = for_people(line[:SHOWN_BYTES].decode(errors="replace"))
            log.warning("bridge_line_refused", error=for_people(reason), line=shown, refused=self._count)


def reading_of(line: MeasurementLine | ShotLine, prism: int | None, at_ns: int, received_ns: int) -> Reading:
    """Make the reading of a line whose time is known; the parameters are fields of the reading."""
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
    )
