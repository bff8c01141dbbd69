"""An instrument behind a bridge program: a user's program with the manufacturer's library and its licence.

docs/reference/bridge.md specifies the lines between the two. There is no background task: output is processed in the callback
that delivers it, which wakes the waiting call.
"""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import TYPE_CHECKING

import structlog

from tsgt.errors import InstrumentError, InstrumentRefusedError
from tsgt.recording import encode_line
from tsgt.recording.journal import InstrumentRecord
from tsgt.service import RejectedLines, printable, start_process
from tsgt.station.bridge.messages import (
    AtmosphereLine,
    CommandLine,
    DirectLine,
    DoneLine,
    HelloLine,
    MeasureLine,
    SingleMeasurementLine,
    TrackLine,
)
from tsgt.station.bridge.session import BridgeSession, reading_of
from tsgt.station.bridge.timing import LineTimestamper
from tsgt.station.instrument import Condition

if TYPE_CHECKING:
    from tsgt.clock import Clock
    from tsgt.config import BridgeInstrumentConfig
    from tsgt.radio import Direction
    from tsgt.service import Program, StartProgram
    from tsgt.station.instrument import Atmosphere, Reading

HELLO_TIMEOUT_S = 30.0  # time for a silent program to find its instrument; each usable line restarts it

RESPONSE_TIMEOUT_S = 30.0  # time for any command; a two-face measurement of a target takes 15 s

log = structlog.get_logger()


class BridgeInstrument:
    """An :class:`~tsgt.station.instrument.Instrument`; ``clock`` is CLOCK_MONOTONIC, as in the program's timestamps."""

    def __init__(
        self, config: BridgeInstrumentConfig, clock: Clock, start: StartProgram | None = None
    ) -> None:
        self._config = config
        self._name = config.command[0]
        self._clock = clock
        self._start = start or partial(
            start_process, clock=clock, setting="instrument.command", log_stderr=_log_stderr
        )
        self._latency_ns = round(config.latency_ms * 1e6)
        self._timestamper = LineTimestamper(self._latency_ns)
        self._readings: deque[Reading] = deque()
        self._session: BridgeSession | None = None
        self._program: Program | None = None
        self._last_id = 0
        self._rejected = RejectedLines(clock, _log_rejected)

    async def connect(self) -> str:
        """Terminate an earlier program, start the program, and wait for its hello."""
        await self.close()
        session = self._session = BridgeSession(
            self._name, self._clock, self._timestamper, self._readings, self._rejected
        )
        try:
            self._program = await self._start(self._config.command, session)
            session.kill = self._program.kill
            await session.wait_until(
                lambda: session.hello is not None,
                HELLO_TIMEOUT_S,
                "has not sent hello",
                restart_on_output=True,
            )
        except BaseException:
            await self.close()
            raise
        hello = self._hello()
        name = " ".join(filter(None, (hello.make, hello.model, hello.serial_number)))
        source = {
            "host": "timestamped by the bridge",
            "instrument": f"timestamped by its clock {hello.clock}".rstrip(),
            "arrival": "timestamped on arrival",
        }[hello.stamps]
        return f"{printable(name)}, {printable(source)}"

    async def track(self, prism: int, towards: Direction | None = None) -> None:
        """Track a prism; a program without this command tracks what the operator has set up."""
        if "track" in self._hello().commands:
            await self._execute(TrackLine(id=self._next_id(), prism=prism, towards=towards), tracking=prism)
        else:
            self._connected().set_tracking(prism)

    async def read(self) -> Reading:
        """Return the oldest queued reading, or the next one."""
        session = self._connected()
        if session.tracking is None:
            raise InstrumentRefusedError(f"{self._name}: no prism is tracked; call track first")
        if not self._readings:
            timeout_s = self._config.stall_timeout_s
            await session.wait_until(
                lambda: len(self._readings) > 0,
                timeout_s,
                f"has printed nothing usable for {timeout_s:g} s",
                restart_on_output=True,
            )
        return self._readings.popleft()

    async def direct(self) -> None:
        """Stop tracking."""
        self._require("direct", "make single measurements")
        await self._execute(DirectLine(id=self._next_id()), tracking=None)

    async def measure(self) -> Reading:
        """Measure a target; it is stationary, so that its time need not be exact."""
        session = self._connected()
        if session.tracking is not None:
            raise InstrumentRefusedError(f"{self._name}: it is tracking; call direct first")
        self._require("measure", "make single measurements")
        response = await self._execute(MeasureLine(id=self._next_id()), tracking=None)
        if not isinstance(response, SingleMeasurementLine):
            raise InstrumentRefusedError(f"{self._name}: the response done contains no measurement")
        host_ns = response.host_time_ns
        plausible = host_ns is not None and session.sent_ns <= host_ns <= session.responded_ns
        at_ns = host_ns if host_ns is not None and plausible else session.responded_ns
        return reading_of(response, None, at_ns, session.responded_ns)

    async def check(self) -> None:
        """Check that the program still runs."""
        if (error := self._connected().error) is not None:
            raise error

    async def set_atmosphere(self, atmosphere: Atmosphere) -> None:
        """Set the atmospheric correction."""
        self._require("atmosphere", "set the atmospheric correction; set it at the instrument")
        command = AtmosphereLine(
            id=self._next_id(),
            temperature_c=atmosphere.temperature_c,
            pressure_hpa=atmosphere.pressure_hpa,
        )
        await self._execute(command, tracking=self._connected().tracking)

    @property
    def condition(self) -> Condition:
        """The condition that the program reports, or what is wrong with the program."""
        session = self._session
        if session is None:
            return Condition()
        reported = session.status
        default = "" if session.tracking is None else "tracking"
        if session.hello is None:
            default = "waiting for the program"
        return Condition(
            activity=printable(reported.activity) or default,
            problem=printable(reported.problem)
            or ("" if session.error is None else str(session.error))
            or self._rejected.last,
            battery_percent=reported.battery_percent,
        )

    @property
    def record(self) -> InstrumentRecord | None:
        """Identity and settings that the program reports."""
        session = self._session
        if session is None or (hello := session.hello) is None:
            return None
        settings = session.settings
        return InstrumentRecord(
            make=printable(hello.make),
            model=printable(hello.model),
            serial_number=printable(hello.serial_number),
            firmware=printable(hello.firmware),
            prism_type=printable(settings.prism_type),
            prism_constant_m=settings.prism_constant_m,
            atmospheric_ppm=settings.atmospheric_ppm,
            temperature_c=settings.temperature_c,
            pressure_hpa=settings.pressure_hpa,
            distance_mode=printable(settings.distance_mode),
            latency_ns=self._latency_ns,
            angle_delay_ns=settings.angle_delay_ns,
        )

    async def close(self) -> None:
        """Terminate the program. Queued readings remain to be read."""
        self._session = None
        program, self._program = self._program, None
        if program is not None:
            await program.terminate()

    def host_clock_restarted(self) -> None:
        """Drop queued readings and the fit of the instrument's clock."""
        if self._readings:
            log.warning("readings_dropped", readings=len(self._readings))
        self._readings.clear()
        self._timestamper.host_clock_restarted(self._clock.monotonic_ns())

    # --- Commands ---------------------------------------------------------------------------------------------

    def _next_id(self) -> int:
        self._last_id += 1
        return self._last_id

    async def _execute(
        self, command: CommandLine, *, tracking: int | None
    ) -> DoneLine | SingleMeasurementLine:
        """Send a command and wait for its response, after which the program tracks this prism, or none."""
        session = self._connected()
        assert self._program is not None  # noqa: S101 (connected)
        session.command_sent(command.id, tracking)
        self._program.write(encode_line(command) + b"\n")
        await session.wait_until(
            lambda: session.response is not None, RESPONSE_TIMEOUT_S, f"does not respond to {command.type}"
        )
        response = session.response
        assert response is not None  # noqa: S101 (awaited above)
        if isinstance(response, DoneLine) and response.error:
            raise InstrumentRefusedError(f"{self._name}: {command.type}: {printable(response.error)}")
        return response

    def _require(self, command: str, purpose: str) -> None:
        if command not in self._hello().commands:
            raise InstrumentRefusedError(f"{self._name}: this program cannot {purpose}")

    def _connected(self) -> BridgeSession:
        if self._session is None:
            raise InstrumentError(f"{self._name}: not connected; call connect first")
        return self._session

    def _hello(self) -> HelloLine:
        hello = self._connected().hello
        if hello is None:
            raise InstrumentError(f"{self._name}: not connected; call connect first")
        return hello


def _log_stderr(text: str, dropped: int) -> None:
    log.info("bridge_stderr", text=text, dropped=dropped)


def _log_rejected(error: str, line: str, rejected: int) -> None:
    log.warning("bridge_line_rejected", error=error, line=line, rejected=rejected)
