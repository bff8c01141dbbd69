"""The driver of a robotic Leica total station over GeoCOM: TPS1200+, TS15, TS16, TS30, TS60, MS50, MS60 and relatives."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import structlog

from tsgt.errors import InstrumentError, InstrumentRefusedError
from tsgt.station.geocom import connect
from tsgt.station.instrument import Condition
from tsgt.station.leica.identity import Identity, identify, read_power, succeeded
from tsgt.station.leica.measurement import not_aimed, reading_of
from tsgt.station.leica.reacquisition import ReacquisitionSequence
from tsgt.station.leica.search import RoboticLicenceMissing, TargetSearch
from tsgt.station.leica.setup import (
    ATMOSPHERE,
    DECIMALS,
    apply_setting,
    atmospheric_correction,
    clear_distance,
    read_settings,
    set_distance_mode,
    set_reflector,
    set_tracking_mode,
    set_up,
)
from tsgt.station.leica.target import measure_in_two_faces, measure_target
from tsgt.station.leica.timing import DistanceTimestamper
from tsgt.station.leica.tracking import Tracking

if TYPE_CHECKING:
    from tsgt.clock import Clock
    from tsgt.config import LeicaInstrumentConfig
    from tsgt.radio import Direction
    from tsgt.recording.journal import InstrumentRecord
    from tsgt.station.geocom import GeoComConnection
    from tsgt.station.instrument import Atmosphere, Reading
    from tsgt.station.serial import OpenPort

log = structlog.get_logger()

_POWER_INTERVAL_NS: Final = 60_000_000_000
_PPM_TOLERANCE: Final = 0.05
_TAPE_MODES, _PRECISE_TAPE_MODES, _PRISM_MODES = (1,), (14, 1), (2,)

_REFLECTOR, _DISTANCE_MODE = "the reflector", "the distance mode"

_NO_LICENCE: Final = (
    "the licence GeoCOM Robotic is missing: the operator has to point the telescope and to lock on"
)


class LeicaInstrument:
    """An :class:`~tsgt.station.instrument.Instrument`; needs the operator for another prism without a direction."""

    def __init__(self, config: LeicaInstrumentConfig, open_port: OpenPort, clock: Clock) -> None:
        self._config = config
        self._open_port = open_port
        self._clock = clock
        self._sequence = ReacquisitionSequence(
            width_rad=math.radians(config.search_window_deg),
            height_rad=math.radians(config.search_height_deg),
        )
        self._timestamper = DistanceTimestamper(0)
        self._identity = Identity()
        self._line: GeoComConnection | None = None
        self._tracking: Tracking | None = None
        self._direct = False
        self._prism: int | None = None
        self._operator_pending = (
            False  # the prism was changed, and the operator has not pointed at the new one yet
        )
        self._problems: dict[str, str] = {}
        self._power_read_ns = 0
        self._record: InstrumentRecord | None = None

    # --- Connection -------------------------------------------------------------------------------------------

    async def connect(self) -> str:
        """Find, identify and set up the instrument; it keeps its lock."""
        await self.close()
        line = await connect(self._open_port, self._config.baud, self._clock, checksum=self._config.checksum)
        self._line = line
        try:
            await self._initialise(line)
        except BaseException:
            await self.close()
            raise
        return f"Leica {self._identity.model} {self._identity.serial_number}"

    async def _initialise(self, line: GeoComConnection) -> None:
        line.decimals = DECIMALS
        before = self._identity
        self._identity = identity = await identify(line, before)
        same_line = self._timestamper.over_network == line.over_network
        if identity.serial_number != before.serial_number or not same_line:
            self._timestamper.reset(over_network=line.over_network)
            if identity.robotic is False:
                log.warning("licence_missing")
        latency_ms = self._config.latency_ms
        self._timestamper.latency_ns = (
            identity.properties.latency_ns if latency_ms is None else round(latency_ms * 1e6)
        )
        self._problems = {}
        self._power_read_ns = self._clock.monotonic_ns()
        if identity.power_problem:
            log.warning("instrument_battery_low", percent=identity.battery_percent)
        for name, problem in (await set_up(line, self._config, identity)).items():
            self._report_setting(name, problem)
        await self._timestamper.synchronise(line)

    async def close(self) -> None:
        """Disconnect; the instrument stays on and keeps its lock."""
        line, self._line = self._line, None
        self._direct = False
        try:
            with suppress(InstrumentError):
                await self._stop_tracking()
        finally:
            if line is not None:
                await line.close()

    def host_clock_restarted(self) -> None:
        """Drop the fit of the instrument's clock."""
        self._timestamper.host_clock_restarted()

    async def _stop_tracking(self) -> None:
        tracking, self._tracking = self._tracking, None
        if tracking is not None:
            self._operator_pending |= tracking.awaits_operator
            if tracking.target_search is None:
                self._lose_licence()
            await tracking.stop_search(resume=False)

    def _lose_licence(self) -> None:
        self._identity = replace(self._identity, robotic=False)

    def _connected(self) -> GeoComConnection:
        if self._line is None:
            raise InstrumentError(f"{self._config.port}: the instrument is not connected")
        return self._line

    # --- Tracking ---------------------------------------------------------------------------------------------

    async def track(self, prism: int, towards: Direction | None = None) -> None:
        """Track a prism and keep a lock on it; for another prism the operator points the telescope."""
        line = self._connected()
        tracking = self._tracking
        if tracking is None:
            await self._set_prism(line)
            self._report_setting(_DISTANCE_MODE, await set_tracking_mode(line, self._config.distance_mode))
            tracking = Tracking(
                line, self._clock, self._timestamper, self._sequence, self._target_search(line)
            )
            if self._direct:
                self._sequence.telescope_moved()
            await tracking.start(prism if self._prism is None else self._prism)
            await self._read_back(line)
            self._tracking, self._direct = tracking, False
        if self._operator_pending or (self._prism is not None and prism != self._prism):
            await tracking.change_prism(prism, towards)
        else:
            await tracking.search_for(towards)
        self._operator_pending = False
        self._prism = prism

    async def read(self) -> Reading:
        """Return the next reading while tracking."""
        line = self._connected()
        if self._tracking is None:
            raise InstrumentRefusedError("no prism is tracked; call track first")
        due = self._clock.monotonic_ns() - self._power_read_ns > _POWER_INTERVAL_NS
        if due and not self._tracking.searching:
            await self._check_power(line)
        return await self._tracking.read()

    def _target_search(self, line: GeoComConnection) -> TargetSearch | None:
        identity = self._identity
        if identity.robotic is False or not identity.atr:
            return None
        return TargetSearch(line, power_search=identity.power_search)

    # --- Single measurements ----------------------------------------------------------------------------------

    async def direct(self) -> None:
        """Release the prism and prepare for single measurements of targets that the operator aims at."""
        line = self._connected()
        if self._tracking is not None:
            await self._tracking.stop_search()
        search = self._target_search(line)
        if search is not None:
            try:
                await search.release_lock()
                if self._config.target == "foil":
                    await search.disable_atr()
            except RoboticLicenceMissing:
                self._lose_licence()
        await self._stop_tracking()
        self._direct = True
        await clear_distance(line)
        await self._set_target(line)
        await self._read_back(line)

    async def check(self) -> None:
        """Check connection and power supply, and exchange times so that the clock's skew is known later."""
        line = self._connected()
        await self._check_power(line)
        await self._timestamper.exchange(line)

    async def _set_target(self, line: GeoComConnection) -> None:
        if self._config.target == "foil":
            modes = _PRECISE_TAPE_MODES if self._identity.properties.precise_tape else _TAPE_MODES
            self._report_setting(_REFLECTOR, await set_reflector(line, "tape", None))
        else:
            modes = _PRISM_MODES
            await self._set_prism(line)
        self._report_setting(_DISTANCE_MODE, await set_distance_mode(line, modes))

    async def _set_prism(self, line: GeoComConnection) -> None:
        config = self._config
        constant_m = None if config.prism_constant_mm is None else config.prism_constant_mm / 1e3
        self._report_setting(_REFLECTOR, await set_reflector(line, config.prism_type, constant_m))

    async def measure(self) -> Reading:
        """Measure the target in the line of sight once, in one face or two; takes some seconds."""
        line = self._connected()
        if not self._direct:
            raise InstrumentRefusedError("the instrument tracks; call direct first")
        # A power cycle or the operator may have changed the settings since the last measurement.
        await self._set_target(line)
        search = self._target_search(line) if self._config.target == "prism" else None
        if search is not None:
            try:
                aimed = await search.fine_adjust()
            except RoboticLicenceMissing:
                self._lose_licence()
                search = None  # the operator aims
            else:
                if not succeeded(aimed):
                    return reading_of(not_aimed(aimed), None, aimed.first_byte_ns)
        if self._config.target_faces == 1:
            measured = await measure_target(line, self._clock)
        else:
            measured = await measure_in_two_faces(line, self._clock, at_prism=search is not None)
        time = self._timestamper.timestamp(measured)
        return reading_of(measured, None, measured.first_byte_ns if time is None else time.at_ns)

    # --- Atmosphere, condition, record ------------------------------------------------------------------------

    async def set_atmosphere(self, atmosphere: Atmosphere) -> None:
        """Set the instrument's atmospheric correction."""
        line = self._connected()
        if self._tracking is not None:
            await self._tracking.stop_search()
        problem = await apply_setting(line, atmospheric_correction(atmosphere))
        if self._tracking is not None:
            await self._tracking.start_measuring()  # a stored distance that prevented the setting was cleared
        if problem:
            raise InstrumentRefusedError(problem)
        self._problems.pop(ATMOSPHERE, None)
        await self._read_back(line)

    @property
    def condition(self) -> Condition:
        """Current state, for the operator."""
        problems = [problem for problem in self._problems.values() if problem]
        tracking = self._tracking
        activity = "ready for single measurements" if self._direct else ""
        may_search = self._identity.robotic is not False
        if tracking is not None:
            activity = tracking.activity
            may_search = tracking.target_search is not None
            if tracking.operator_request:
                problems.insert(0, tracking.operator_request)
            if tracking.tilted:
                problems.insert(0, "it is not level")
        if self._timestamper.problem:
            problems.append(self._timestamper.problem)
        if self._identity.power_problem:
            problems.append(self._identity.power_problem)
        if self._line is not None and not may_search:
            problems.append(_NO_LICENCE)
        return Condition(
            activity=activity, problem="; ".join(problems), battery_percent=self._identity.battery_percent
        )

    @property
    def record(self) -> InstrumentRecord | None:
        """Identity and settings, for the journal."""
        return self._record

    def _report_setting(self, name: str, problem: str) -> None:
        """Record why a setting is not as required; empty: it is."""
        if problem and problem != self._problems.get(name):
            log.warning("instrument_setting_failed", problem=problem)
        self._problems[name] = problem

    async def _check_power(self, line: GeoComConnection) -> None:
        self._power_read_ns = self._clock.monotonic_ns()
        before, self._identity = self._identity, await read_power(line, self._identity)
        if self._identity.power_problem not in ("", before.power_problem):
            log.warning("instrument_battery_low", percent=self._identity.battery_percent)

    async def _read_back(self, line: GeoComConnection) -> None:
        """Update the record with the instrument's current settings."""
        record, geometric_ppm = await read_settings(line)
        identity, angle_delay_ms = self._identity, self._config.angle_delay_ms
        self._problems.pop("geometry", None)
        if geometric_ppm is not None and abs(geometric_ppm) > _PPM_TOLERANCE:
            self._problems["geometry"] = (
                f"it scales distances by {geometric_ppm:.1f} ppm in addition to the atmospheric correction;"
                " set its geometric ppm to 0"
            )
        record = replace(
            record,
            model=identity.model,
            serial_number=identity.serial_number,
            firmware=identity.firmware,
            latency_ns=self._timestamper.latency_ns,
            angle_delay_ns=identity.properties.angle_delay_ns
            if angle_delay_ms is None
            else round(angle_delay_ms * 1e6),
        )
        if self._record is None or record != replace(self._record, stamp_ns=0):
            self._record = replace(record, stamp_ns=self._clock.monotonic_ns())
