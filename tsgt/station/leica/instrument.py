"""A Leica total station with motors, over GeoCOM: TPS1200+, TS15, TS16, TS30, TS60, MS50, MS60 and their kin."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import structlog

from tsgt.errors import InstrumentError, InstrumentRefusedError
from tsgt.recording.journal import InstrumentRecord
from tsgt.station.geocom import connect
from tsgt.station.instrument import Condition, Reading
from tsgt.station.leica.identity import Identity, check_power, identify, model_of
from tsgt.station.leica.reacquisition import LossSequence
from tsgt.station.leica.search import Finder, LicenceMissing
from tsgt.station.leica.setup import (
    DECIMALS,
    TRACKING_MODES,
    air,
    clear,
    ensure,
    read_settings,
    set_distance_mode,
    set_reflector,
    set_up,
)
from tsgt.station.leica.target import shoot, shoot_in_two_faces
from tsgt.station.leica.timing import InstrumentTimes
from tsgt.station.leica.tracking import Tracking

if TYPE_CHECKING:
    from tsgt.clock import Clock
    from tsgt.config import LeicaInstrumentConfig
    from tsgt.radio import Direction
    from tsgt.station.geocom import GeoComConnection
    from tsgt.station.instrument import Atmosphere
    from tsgt.station.serial import OpenPort

log = structlog.get_logger()

_POWER_NS: Final = 60_000_000_000
_SAME_PPM: Final = 0.05
_TAPE_MODES, _PRECISE_TAPE_MODES, _PRISM_MODES = (1,), (14, 1), (2,)

_NO_LICENCE: Final = (
    "the licence GeoCOM Robotic is missing: a person has to point the telescope and to lock in"
)


class LeicaInstrument:
    """An :class:`~tsgt.station.instrument.Instrument`.

    Its prisms look all the same to it: :meth:`track` with another number than before, and no direction, asks for a person
    who points the telescope.

    Parameters
    ----------
    config
        How it is set.
    open_port
        Opens the line to it.
    clock
        Of the host.
    """

    def __init__(self, config: LeicaInstrumentConfig, open_port: OpenPort, clock: Clock) -> None:
        self._config = config
        self._open_port = open_port
        self._clock = clock
        self._sequence = LossSequence(
            width_rad=math.radians(config.search_window_deg),
            height_rad=math.radians(config.search_height_deg),
        )
        self._times = InstrumentTimes(0)
        self._identity = Identity()
        self._line: GeoComConnection | None = None
        self._tracking: Tracking | None = None
        self._direct = False
        self._prism: int | None = None
        self._person_owed = False  # the prism was changed, and nobody has pointed at the new one yet
        self._problems: dict[str, str] = {}
        self._power_asked_ns = 0
        self._record: InstrumentRecord | None = None

    # --- Connection -------------------------------------------------------------------------------------------

    async def connect(self) -> str:
        """Find and identify the instrument and set it up. What it is locked in on, it keeps."""
        await self.close()
        line = await connect(self._open_port, self._config.baud, self._clock, checksum=self._config.checksum)
        self._line = line
        try:
            await self._meet(line)
        except BaseException:
            await self.close()
            raise
        return f"Leica {self._identity.model} {self._identity.serial_number}"

    async def _meet(self, line: GeoComConnection) -> None:
        line.decimals = DECIMALS
        before = self._identity
        self._identity = identity = await identify(line, before)
        if identity.serial_number != before.serial_number:
            self._times.other_instrument()
            if identity.robotic is False:
                log.warning("licence_missing")
        latency_ms = self._config.latency_ms
        self._times.latency_ns = (
            model_of(identity.model).latency_ns if latency_ms is None else round(latency_ms * 1e6)
        )
        self._problems = {}
        self._power_asked_ns = self._clock.monotonic_ns()
        if identity.power_problem:
            log.warning("instrument_battery_low", percent=identity.battery_percent)
        for problem in await set_up(line, self._config, identity):
            self._add_problem(problem)
        await self._times.meet(line)

    async def close(self) -> None:
        """Let go of the instrument; it stays on, and keeps its lock."""
        line, self._line = self._line, None
        self._direct = False
        try:
            with suppress(InstrumentError):
                await self._stop_tracking()
        finally:
            if line is not None:
                await line.close()

    async def _stop_tracking(self) -> None:
        tracking, self._tracking = self._tracking, None
        if tracking is not None:
            self._person_owed = tracking.waits_for_person
            if tracking.finder is None:
                self._identity = replace(self._identity, robotic=False)
            await tracking.stop_search(go_on=False)

    def _connected(self) -> GeoComConnection:
        if self._line is None:
            raise InstrumentError(f"{self._config.port}: the instrument is not connected")
        return self._line

    # --- Tracking ---------------------------------------------------------------------------------------------

    async def track(self, prism: int, towards: Direction | None = None) -> None:
        """Track a prism; a lock on it is kept. Another one than before is locked in on where a person points."""
        line = self._connected()
        tracking = self._tracking
        if tracking is None:
            config = self._config
            constant_m = None if config.prism_constant_mm is None else config.prism_constant_mm / 1e3
            self._add_problem(await set_reflector(line, config.prism_type, constant_m))
            self._add_problem(await set_distance_mode(line, TRACKING_MODES[config.distance_mode]))
            tracking = Tracking(line, self._clock, self._times, self._sequence, self._finder(line))
            if self._direct:
                self._sequence.turned_away()
            await tracking.start(prism if self._prism is None else self._prism)
            await self._read_back(line)
            self._tracking, self._direct = tracking, False
        another = self._person_owed or (self._prism is not None and prism != self._prism)
        self._person_owed = False
        if another:
            self._prism = prism
            await tracking.change(prism, towards)
        else:
            self._prism = prism
            await tracking.look_for(towards)

    async def read(self) -> Reading:
        """Return the next measurement while tracking."""
        line = self._connected()
        if self._tracking is None:
            raise InstrumentRefusedError("no prism is tracked; call track first")
        if self._clock.monotonic_ns() - self._power_asked_ns > _POWER_NS:
            await self._check_power(line)
        return await self._tracking.read()

    def _finder(self, line: GeoComConnection) -> Finder | None:
        identity = self._identity
        if identity.robotic is False or not identity.atr:
            return None
        return Finder(line, power_search=identity.power_search)

    # --- Single measurements ----------------------------------------------------------------------------------

    async def direct(self) -> None:
        """Let the prism go and get ready for single measurements of targets that a person aims at."""
        line = self._connected()
        await self._stop_tracking()
        self._direct = True
        await clear(line)
        finder = self._finder(line)
        if finder is not None:
            try:
                await finder.release()
                if self._config.target == "foil":
                    await finder.stop_recognising()
            except LicenceMissing:
                self._identity = replace(self._identity, robotic=False)
        await self._set_target(line)
        await self._read_back(line)

    async def check(self) -> None:
        """See whether it is still there, how it is fed, and what its clock shows, so that the rate is known later."""
        line = self._connected()
        await self._check_power(line)
        await self._times.exchange(line)

    async def _set_target(self, line: GeoComConnection) -> None:
        if self._config.target == "foil":
            modes = _PRECISE_TAPE_MODES if model_of(self._identity.model).precise_tape else _TAPE_MODES
            self._add_problem(await set_reflector(line, "tape", None))
            self._add_problem(await set_distance_mode(line, modes))
        else:
            await set_distance_mode(line, _PRISM_MODES)

    async def measure(self) -> Reading:
        """Measure the target that the telescope points at, once, in one face or in two; it takes some seconds."""
        line = self._connected()
        if not self._direct:
            raise InstrumentRefusedError("the instrument tracks; call direct first")
        # It may have been switched off and on, or set by hand, since the last shot.
        await self._set_target(line)
        prism = self._config.target == "prism"
        finder = self._finder(line) if prism else None
        if finder is not None:
            try:
                await finder.adjust()
            except LicenceMissing:
                self._identity = replace(self._identity, robotic=False)
        if self._config.target_faces == 1:
            shot = await shoot(line, self._clock)
        else:
            shot = await shoot_in_two_faces(line, self._clock, at_prism=finder is not None)
        stamp = self._times.stamp(shot)
        return Reading(
            at_ns=shot.first_byte_ns if stamp is None else stamp.at_ns,
            prism=None,
            horizontal_angle_rad=shot.horizontal_angle_rad,
            zenith_angle_rad=shot.zenith_angle_rad,
            slope_distance_m=shot.distance_m,
            status=shot.status,
            raw_status=shot.code,
            instrument_time_ns=None if shot.time_ms is None else shot.time_ms * 1_000_000,
            received_ns=shot.first_byte_ns,
        )

    # --- Air, condition, record -------------------------------------------------------------------------------

    async def set_atmosphere(self, atmosphere: Atmosphere) -> None:
        """Let the instrument correct distances for this air from now on."""
        line = self._connected()
        if self._tracking is not None:
            await self._tracking.stop_search()
        problem = await ensure(line, air(atmosphere))
        if self._tracking is not None:
            await self._tracking.measure()  # a distance that was in the way has been cleared
        if problem:
            raise InstrumentRefusedError(problem)
        await self._read_back(line)

    @property
    def condition(self) -> Condition:
        """How it does at the moment."""
        problems = list(self._problems.values())
        tracking = self._tracking
        activity = "ready for single measurements" if self._direct else ""
        may_search = self._identity.robotic is not False
        if tracking is not None:
            activity = tracking.activity
            may_search = tracking.finder is not None
            if tracking.call_for:
                problems.insert(0, tracking.call_for)
            if tracking.tilted:
                problems.insert(0, "it is not level")
        if self._identity.power_problem:
            problems.append(self._identity.power_problem)
        if self._line is not None and not may_search:
            problems.append(_NO_LICENCE)
        return Condition(
            activity=activity, problem="; ".join(problems), battery_percent=self._identity.battery_percent
        )

    @property
    def record(self) -> InstrumentRecord | None:
        """What is known of it and of its settings."""
        return self._record

    def _add_problem(self, problem: str) -> None:
        if problem:
            log.warning("instrument_setting_failed", problem=problem)
            self._problems[problem.partition(":")[0]] = problem

    async def _check_power(self, line: GeoComConnection) -> None:
        self._power_asked_ns = self._clock.monotonic_ns()
        power = await check_power(line)
        if power.problem and not self._identity.power_problem:
            log.warning("instrument_battery_low", percent=power.percent)
        self._identity = self._identity.fed(power)

    async def _read_back(self, line: GeoComConnection) -> None:
        """Read how it measures now, for the record."""
        settings = await read_settings(line)
        angle_delay_ms = self._config.angle_delay_ms
        model = model_of(self._identity.model)
        air_now = settings.atmosphere
        self._problems.pop("geometry", None)
        if settings.ppm is not None and settings.atmospheric_ppm is not None:
            geometric_ppm = settings.ppm - settings.atmospheric_ppm
            if abs(geometric_ppm) > _SAME_PPM:
                self._problems["geometry"] = (
                    f"it scales distances by {geometric_ppm:.1f} ppm besides the air; set its geometric ppm to 0"
                )
        record = InstrumentRecord(
            make="Leica",
            model=self._identity.model,
            serial_number=self._identity.serial_number,
            firmware=self._identity.firmware,
            prism_type=settings.prism_type,
            prism_constant_m=settings.prism_constant_m,
            atmospheric_ppm=settings.ppm if settings.ppm is not None else settings.atmospheric_ppm,
            temperature_c=air_now.temperature_c if air_now is not None else None,
            pressure_hpa=air_now.pressure_hpa if air_now is not None else None,
            distance_mode=settings.distance_mode,
            latency_ns=self._times.latency_ns,
            angle_delay_ns=model.angle_delay_ns if angle_delay_ms is None else round(angle_delay_ms * 1e6),
        )
        if self._record is None or record != replace(self._record, stamp_ns=0):
            self._record = replace(record, stamp_ns=self._clock.monotonic_ns())
