"""An instrument that a program of the user's reads, who has the maker's library and its licence.

docs/reference/bridge.md specifies what the two say to each other. There is no task in the background: what the program
prints is taken at once, in the callback that brings it, and who waits is woken.
"""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import TYPE_CHECKING

from tsgt.errors import InstrumentError, InstrumentRefusedError
from tsgt.recording import encode_line
from tsgt.recording.journal import InstrumentRecord
from tsgt.station.bridge.messages import (
    AtmosphereCommand,
    Command,
    DirectCommand,
    DoneLine,
    Hello,
    MeasureCommand,
    ShotLine,
    TrackCommand,
    for_people,
)
from tsgt.station.bridge.process import start_process
from tsgt.station.bridge.run import BridgeRun, Refusals, reading_of
from tsgt.station.bridge.timing import Stamper
from tsgt.station.instrument import Condition

if TYPE_CHECKING:
    from tsgt.clock import Clock
    from tsgt.config import BridgeInstrumentConfig
    from tsgt.radio import Direction
    from tsgt.station.bridge.process import Program, StartProgram
    from tsgt.station.instrument import Atmosphere, Reading

HELLO_TIMEOUT_S = 30.0
"""How long a program that says nothing has to find its instrument; each line that can be used gives it so long again."""

ANSWER_TIMEOUT_S = 30.0
"""How long any command may take; a measurement of a target in two faces takes 15 s."""


class BridgeInstrument:
    """The :class:`~tsgt.station.instrument.Instrument` behind a program.

    Parameters
    ----------
    config
        The program, and how long it may be silent.
    clock
        CLOCK_MONOTONIC, which the program stamps with too.
    start
        Starts the program; None: as a child process.
    """

    def __init__(
        self, config: BridgeInstrumentConfig, clock: Clock, start: StartProgram | None = None
    ) -> None:
        self._config = config
        self._clock = clock
        self._start = start or partial(start_process, clock=clock)
        self._latency_ns = round(config.latency_ms * 1e6)
        self._stamper = Stamper(self._latency_ns)
        self._readings: deque[Reading] = deque()
        self._run: BridgeRun | None = None
        self._program: Program | None = None
        self._commands = 0
        self._refusals = Refusals(clock)

    async def connect(self) -> str:
        """Start the program, which ends an earlier one, and wait until it has its instrument."""
        await self.close()
        run = self._run = BridgeRun(
            self._config.command[0], self._clock, self._stamper, self._readings, self._refusals
        )
        try:
            self._program = await self._start(self._config.command, run)
            run.kill = self._program.kill
            await run.until(
                lambda: run.hello is not None, HELLO_TIMEOUT_S, "has not said hello", patient=True
            )
        except BaseException:
            await self.close()
            raise
        hello = self._hello(run)
        name = " ".join(filter(None, (hello.make, hello.model, hello.serial_number)))
        stamps = f"stamped by its clock {hello.clock}" if hello.clock else "stamped by its own clock"
        how = {"host": "stamped by the bridge", "instrument": stamps, "arrival": "stamped on arrival"}[
            hello.stamps
        ]
        return f"{for_people(name)}, {for_people(how)}"

    async def track(self, prism: int, towards: Direction | None = None) -> None:
        """Have a prism tracked; a program that cannot be told tracks what a person has set up."""
        run = self._running()
        if "track" in self._hello(run).commands:
            await self._tell(TrackCommand(id=self._number(), prism=prism, towards=towards), tracking=prism)
        else:
            run.switch(tracking=prism)

    async def read(self) -> Reading:
        """Return the oldest reading that waits, or the next one."""
        run = self._running()
        if run.tracking is None:
            raise InstrumentRefusedError(f"{self._config.command[0]}: no prism is tracked; call track first")
        if not self._readings:
            limit_s = self._config.stall_timeout_s
            await run.until(
                lambda: len(self._readings) > 0, limit_s, f"has said nothing for {limit_s:g} s", patient=True
            )
        return self._readings.popleft()

    async def direct(self) -> None:
        """Have the tracking stopped."""
        self._check_can("direct", "make single measurements")
        await self._tell(DirectCommand(id=self._number()), tracking=None)

    async def measure(self) -> Reading:
        """Have the target measured; it stands still, so that its time need not be exact."""
        run = self._running()
        if run.tracking is not None:
            raise InstrumentRefusedError(f"{self._config.command[0]}: it is tracking; call direct first")
        self._check_can("measure", "make single measurements")
        answer = await self._tell(MeasureCommand(id=self._number()), tracking=None)
        if not isinstance(answer, ShotLine):
            raise InstrumentRefusedError(f"{self._config.command[0]}: says done, and gives no measurement")
        host_ns = answer.host_time_ns
        given = host_ns is not None and run.asked_ns <= host_ns <= run.answered_ns
        at_ns = host_ns if host_ns is not None and given else run.answered_ns
        return reading_of(answer, None, at_ns, run.answered_ns)

    async def check(self) -> None:
        """See whether the program still runs."""
        if (lost := self._running().lost) is not None:
            raise lost

    async def set_atmosphere(self, atmosphere: Atmosphere) -> None:
        """Have the distances corrected for this air."""
        self._check_can("atmosphere", "set the air; set it at the instrument")
        command = AtmosphereCommand(
            id=self._number(),
            temperature_c=atmosphere.temperature_c,
            pressure_hpa=atmosphere.pressure_hpa,
        )
        await self._tell(command, tracking=self._running().tracking)

    @property
    def condition(self) -> Condition:
        """What the program says of it, or what is wrong with the program."""
        run = self._run
        if run is None:
            return Condition()
        said = run.status
        own = "waiting for the program" if run.hello is None else "" if run.tracking is None else "tracking"
        return Condition(
            activity=for_people(said.activity) or own,
            problem=for_people(said.problem)
            or ("" if run.lost is None else str(run.lost))
            or self._refusals.last,
            battery_percent=said.battery_percent,
        )

    @property
    def record(self) -> InstrumentRecord | None:
        """What the program says of it and of its settings."""
        run = self._run
        if run is None or (hello := run.hello) is None:
            return None
        settings = run.settings
        return InstrumentRecord(
            make=for_people(hello.make),
            model=for_people(hello.model),
            serial_number=for_people(hello.serial_number),
            firmware=for_people(hello.firmware),
            prism_type=for_people(settings.prism_type),
            prism_constant_m=settings.prism_constant_m,
            atmospheric_ppm=settings.atmospheric_ppm,
            temperature_c=settings.temperature_c,
            pressure_hpa=settings.pressure_hpa,
            distance_mode=for_people(settings.distance_mode),
            latency_ns=self._latency_ns,
            angle_delay_ns=settings.angle_delay_ns,
        )

    async def close(self) -> None:
        """End the program. What it has measured and nobody has read stays to be read."""
        self._run = None
        program, self._program = self._program, None
        if program is not None:
            await program.end()

    # --- Commands ---------------------------------------------------------------------------------------------

    def _number(self) -> int:
        self._commands += 1
        return self._commands

    async def _tell(self, command: Command, *, tracking: int | None) -> DoneLine | ShotLine:
        """Give a command and wait for its answer; with it the program tracks this prism, or none."""
        run = self._running()
        assert self._program is not None  # noqa: S101 (it was started)
        run.expect(command.id, tracking)
        self._program.write(encode_line(command) + b"\n")
        await run.until(
            lambda: run.answer is not None, ANSWER_TIMEOUT_S, f"does not answer to {command.type}"
        )
        answer = run.answer
        assert answer is not None  # noqa: S101 (it was waited for)
        if isinstance(answer, DoneLine) and answer.error:
            raise InstrumentRefusedError(
                f"{self._config.command[0]}: {command.type}: {for_people(answer.error)}"
            )
        return answer

    def _check_can(self, command: str, what: str) -> None:
        if command not in self._hello(self._running()).commands:
            raise InstrumentRefusedError(f"{self._config.command[0]}: this program cannot {what}")

    def _running(self) -> BridgeRun:
        if self._run is None:
            raise InstrumentError(f"{self._config.command[0]}: not connected; call connect first")
        return self._run

    def _hello(self, run: BridgeRun) -> Hello:
        if run.hello is None:
            raise InstrumentError(f"{self._config.command[0]}: not connected; call connect first")
        return run.hello
