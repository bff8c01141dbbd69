"""A simulated total station with motors: what it sees, measures and follows, and what a person does to it.

It speaks GeoCOM (:mod:`tsgt.simulation.instrument.geocom.server`); a cable is put between it and a program by
:mod:`tsgt.simulation.instrument.serial_line` in memory, or by :mod:`tsgt.simulation.instrument.pty` in real time. What is modelled, and
what is not: docs/explanation/simulated-instrument.md.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from tsgt.config import noise
from tsgt.errors import InstrumentError
from tsgt.model import ARCSECOND_RAD, TARGET_NOISE
from tsgt.simulation.instrument.edm import (
    RANGE_M,
    SHOT_S,
    WITHOUT_PRISM,
    DistanceMeter,
    atmospheric_ppm,
    with_noise,
)
from tsgt.simulation.instrument.geocom import GeoComServer, Offered
from tsgt.simulation.instrument.settings import COMPENSATOR_SIGMA_RAD, OFF, PRISM_CONSTANTS_M, TAPE, Settings
from tsgt.simulation.instrument.targets_in_view import Scenery, Seen, direction_of
from tsgt.simulation.instrument.telescope import Telescope
from tsgt.station.geocom import ReturnCode

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from tsgt.config import ScenarioConfig, SimulatedStation
    from tsgt.simulation.instrument.visibility import Direction2
    from tsgt.simulation.kernel import Timeline
    from tsgt.simulation.world import World

TILT_LIMIT_RAD: Final = math.radians(4 / 60)
"""Range of the compensator, to every side."""

TURNING_RADPS: Final = math.radians(0.5)
"""Turning faster than this there is no fresh tilt plane, and it says that it cannot guarantee accuracy; an assumption."""

BOOT_NS: Final = 5_000_000_000
"""From being switched on to the first answer."""

FAULT_TILT_RAD: Final = 0.002

FARTHEST_SEARCH_M: Final = (0.0, 400.0)
"""PowerSearch sees no farther."""

REFLECTORLESS: Final = 5
"""The EDM mode that needs no reflector."""


class SimulatedTotalStation:
    """A robotic total station of a scenario. It is switched on, level, and follows its prism: a person has seen to it.

    Parameters
    ----------
    station
        Which of the scenario's stations it is.
    scenario
        Prisms, targets and faults.
    world
        The truth; before its start and after its end everything stands still.
    timeline
        The true time.
    generator
        Source of all randomness.
    start_ns
        True time at which the world starts, in ns.

    Attributes
    ----------
    settings
        What is set in it.
    robotic_licence
        Whether the option GeoCOM Robotic is there.
    battery_percent, external_power
        How it is fed.
    tilt_rad
        How it leans, across and along the line of sight: what the compensator shows.
    air
        Temperature in degrees and pressure in hPa of the air that its light goes through.
    name, serial_number
        As it says them.
    baud
        Bits per second of its line.
    offered
        Every distance that an answer has carried, once.
    beeps
        True times in ns at which it was told to beep.
    """

    def __init__(
        self,
        station: SimulatedStation,
        scenario: ScenarioConfig,
        world: World,
        timeline: Timeline,
        generator: np.random.Generator,
        *,
        start_ns: int = 0,
    ) -> None:
        self._model = model = station.instrument
        self._timeline = timeline
        self._rng = generator
        self._start_ns = start_ns
        self._noise = noise(station.noise)
        self._reflector_m = station.prism_constant_mm / 1e3
        self._scenery = Scenery(station, scenario, world)
        now_ns = timeline.now_ns()
        period_ns = round(1e9 / station.rate_hz)
        phase_ns = now_ns + int(generator.integers(period_ns))
        self.meter = DistanceMeter(period_ns, model.tick_jitter_ms * 1e6, phase_ns, generator)
        self.telescope = Telescope(
            self._scenery.sights, prediction_s=model.prediction_s, now_s=self._world_s(now_ns)
        )
        self._choose(station.prism)
        self.telescope.follow(station.prism)
        self._seen: Seen | None = None
        self._seen_ns: int | None = None
        self._result: Offered | ReturnCode | None = None
        self._on_since_ns: int | None = now_ns - int(generator.uniform(60e9, 3600e9))
        self._ready_ns = self._heard_ns = now_ns
        self.face = 0
        self.settings = Settings()
        self.robotic_licence = True
        self.battery_percent = 85.0
        self.external_power = False
        self.tilt_rad = (3.0 * ARCSECOND_RAD, -2.0 * ARCSECOND_RAD)
        self.air = (12.0, 1013.25)
        self.name = "TCRP1201+"
        self.serial_number = 230_000 + station.station
        self.baud = model.baud
        self.offered: list[Offered] = []
        self.beeps: list[int] = []
        self._server = GeoComServer(self, timeline, model, generator)

    # --- The line ---------------------------------------------------------------------------------------------

    @property
    def on_send(self) -> Callable[[bytes], None]:
        """Called with what it sends, when the first byte leaves."""
        return self._server.on_send

    @on_send.setter
    def on_send(self, send: Callable[[bytes], None]) -> None:
        self._server.on_send = send

    @property
    def server(self) -> GeoComServer:
        """What answers, so that tests can force codes on it."""
        return self._server

    def receive(self, data: bytes) -> None:
        """Take bytes, all of which have arrived."""
        now_ns = self._timeline.now_ns()
        since_ns, self._heard_ns = now_ns - self._heard_ns, now_ns
        if (
            self.on
            and self.settings.power_mode == OFF
            and since_ns > self.settings.power_timeout_ms * 1_000_000
        ):
            # It has gone off by itself, and any character wakes it up.
            self.switch_off()
            self.switch_on()
        if self.on and now_ns >= self._ready_ns:
            self._server.receive(data)

    # --- What a person does -----------------------------------------------------------------------------------

    @property
    def on(self) -> bool:
        """Whether it is switched on."""
        return self._on_since_ns is not None

    def switch_off(self) -> None:
        """Switch it off: it lets its prism go, and answers no longer."""
        self.advance()
        self.telescope.release()
        self.meter.clear()
        self._server.forget()
        self.settings.power_cycle()
        self._on_since_ns = None

    def switch_on(self) -> None:
        """Switch it on: its time begins at zero, and it answers after a while. It follows nothing."""
        if self._on_since_ns is None:
            self._on_since_ns = self._timeline.now_ns()
            self._ready_ns = self._on_since_ns + BOOT_NS
            self._heard_ns = self._ready_ns

    def aim(self, target: int | None) -> None:
        """Point at one of the scenario's foil targets, from 1, by hand, or away from all of them."""
        if target is not None and not 1 <= target <= len(self._scenery.targets):
            raise InstrumentError(
                f"there is no target {target}; the scenario has {len(self._scenery.targets)}"
            )
        self.advance()
        if target is None:
            self.telescope.turn_to((0.0, 0.1))
            return
        aimed = self._scenery.targets[target - 1] + self._rng.normal(0.0, TARGET_NOISE.pointing_sigma_m, 3)
        self.telescope.turn_to(direction_of(aimed))

    def aim_at_prism(self, prism: int) -> None:
        """Point at a prism, by hand, where it is now; it is not followed."""
        self.advance()
        self._choose(prism)
        self.point_at_prism(prism)

    def lock_by_hand(self, prism: int) -> None:
        """Let it follow a prism, as a person does with the instrument's own keys: no licence, and it ends a search."""
        self._server.interrupt_movement()
        self.advance()
        self.settings.atr = self.settings.lock = True
        self._choose(prism)
        self.telescope.follow(prism)

    @property
    def blocked(self) -> bool:
        """Whether somebody stands in front of the telescope."""
        return self.telescope.blocked

    @blocked.setter
    def blocked(self, blocked: bool) -> None:
        self.advance()
        self.telescope.blocked = blocked

    # --- State ------------------------------------------------------------------------------------------------

    def now_ns(self) -> int:
        """Return the true time in ns."""
        return self._timeline.now_ns()

    def draw(self, span: tuple[float, float]) -> float:
        """Draw a number, all between these two equally likely."""
        return float(self._rng.uniform(*span))

    def advance(self) -> int:
        """Let everything happen that has happened until now; return the true time in ns."""
        now_ns = self._timeline.now_ns()
        newest_ns = self.meter.newest(now_ns)
        if newest_ns is None:
            self._seen_ns = None
        elif newest_ns != self._seen_ns:
            self.telescope.advance(self._world_s(newest_ns))
            self._seen_ns, self._seen, self._result = newest_ns, self._look(self._world_s(newest_ns)), None
        self.telescope.advance(self._world_s(now_ns))
        return now_ns

    def instrument_ms(self, true_ns: int) -> int:
        """Return the instrument's own time at a true time: ms since it was switched on, in 32 bits with a sign."""
        on_ns = true_ns - (self._on_since_ns if self._on_since_ns is not None else true_ns)
        shown_ms = int((on_ns + on_ns * self._model.clock_drift_ppm * 1e-6) // 1_000_000)
        return (shown_ms + 2**31) % 2**32 - 2**31

    def fault(self) -> str | None:
        """Return which fault the scenario has for it now, if any."""
        return self._scenery.fault_at(self._world_s(self._timeline.now_ns()))

    def inclination_rad(self) -> tuple[float, float]:
        """Measure how it leans, across and along the line of sight."""
        across, along = self._rng.normal(0.0, COMPENSATOR_SIGMA_RAD, 2).tolist()
        if self.fault() == "tilt":
            across += FAULT_TILT_RAD
        return self.tilt_rad[0] + across, self.tilt_rad[1] + along

    def too_tilted(self) -> bool:
        """Tell whether it leans further than its compensator reaches."""
        return self.fault() == "tilt" or (
            self.settings.incline and math.hypot(*self.tilt_rad) > TILT_LIMIT_RAD
        )

    def angles_rad(self) -> Direction2:
        """Measure where the telescope points now: the circles' readings. Advance first."""
        horizontal, zenith = self.telescope.direction()
        across, up = self._rng.normal(0.0, self._noise.angle_sigma_rad, 2).tolist()
        return self.reading((horizontal + across / max(math.sin(zenith), 1e-3), zenith + up))

    def reading(self, direction: Direction2) -> Direction2:
        """Return what the circles show for a true direction in the present face."""
        horizontal, zenith = direction
        horizontal += self.settings.orientation_rad + (math.pi if self.face else 0.0)
        return horizontal % math.tau, math.tau - zenith if self.face else zenith

    def true_direction(self, reading: Direction2) -> Direction2:
        """Return the true direction for what the circles show; a zenith angle above pi is of the second face."""
        horizontal, zenith = reading
        horizontal -= self.settings.orientation_rad
        if zenith > math.pi:
            return (horizontal - math.pi) % math.tau, math.tau - zenith
        return horizontal % math.tau, zenith

    def nearly(self, direction: Direction2) -> Direction2:
        """Return where the telescope comes to rest when it is sent to a direction."""
        across, up = self._rng.normal(0.0, 1.0, 2).tolist()
        tolerances = self.settings.tolerance_rad
        return direction[0] + across * tolerances[0] / 2, direction[1] + up * tolerances[1] / 2

    def turning(self) -> bool:
        """Tell whether the telescope turns so fast that there is no fresh tilt plane. Advance first."""
        return self.telescope.speed_radps() > TURNING_RADPS

    # --- Distances --------------------------------------------------------------------------------------------

    def start_measuring(self, now_ns: int, *, continuous: bool) -> None:
        """Begin to take distances, or take one."""
        if continuous:
            self.meter.start(now_ns)
        else:
            self.meter.shoot(now_ns + round(self._rng.uniform(*SHOT_S) * 1e9))

    def result(self) -> Offered | ReturnCode:
        """Return the newest distance, or the code of why there is none. Advance first."""
        if self._seen is None or self._seen_ns is None:
            return ReturnCode.TMC_ANGLE_OK  # nothing was ordered, or nothing has come yet
        if self._result is None:
            self._result = self._measure(self._seen, self._seen_ns)
        return self._result

    def offer(self, result: Offered) -> None:
        """Note that an answer carries this distance."""
        if not self.offered or self.offered[-1].true_ns != result.true_ns:
            self.offered.append(result)

    def met_on_the_way(
        self, start_rad: float, turn_rad: float, height_rad: tuple[float, float]
    ) -> tuple[int, float] | None:
        """Return the first prism that PowerSearch comes across, as :meth:`Scenery.met_on_the_way`."""
        world_s = self._world_s(self.advance())
        range_m = self.settings.search_range_m if self.settings.search_range_on else FARTHEST_SEARCH_M
        if self.blocked:
            return None
        way_rad = start_rad, turn_rad
        return self._scenery.met_on_the_way(world_s, way_rad, height_rad, range_m, self.telescope.only)

    def point_at_prism(self, prism: int) -> float:
        """Turn the telescope to where a prism is now; return how fast that moves across the line of sight, in rad/s."""
        sight, now_s = self._scenery.sights[prism], self._world_s(self._timeline.now_ns())
        self.telescope.turn_to(sight.direction_at(now_s))
        return sight.speed_at(now_s)

    # --- Inside -----------------------------------------------------------------------------------------------

    def _choose(self, prism: int) -> None:
        """Set the number of an active prism, where the prisms have any."""
        self.telescope.only = prism if self._model.tells_prisms_apart else None

    def _world_s(self, true_ns: int) -> float:
        return (true_ns - self._start_ns) / 1e9

    def _look(self, world_s: float) -> Seen:
        """See what reflects; the telescope has advanced to this instant. Whatever is seen has the code of its angles."""
        settings = self.settings
        seen = self._scenery.look(
            world_s, self.telescope, foil=settings.edm_mode in WITHOUT_PRISM or settings.target_type == 1
        )
        if seen.point is None:
            return seen
        if not settings.incline:
            return seen._replace(code=ReturnCode.TMC_NO_FULL_CORRECTION)
        return seen._replace(code=ReturnCode.TMC_ACCURACY_GUARANTEE) if self.turning() else seen

    def _measure(self, seen: Seen, at_ns: int) -> Offered | ReturnCode:
        if seen.point is None:
            return seen.code
        shot = self._noise if seen.prism is not None else TARGET_NOISE
        if not seen.followed:
            shot = replace(shot, pointing_sigma_m=0.0)  # whoever aimed has made his error already
        across, up, distances = with_noise(seen.point[None], shot, self._rng)
        horizontal, zenith, distance_m = float(across[0]), float(up[0]), float(distances[0])
        if not RANGE_M[0] <= distance_m <= RANGE_M[1]:
            return ReturnCode.TMC_ANGLE_OK
        pointed = self._pointed(seen, at_ns)
        if pointed is not None:
            true = direction_of(seen.point)
            horizontal, zenith = horizontal + pointed[0] - true[0], zenith + pointed[1] - true[1]
        horizontal, zenith = self.reading((horizontal, zenith))
        settings = self.settings
        reflectorless = settings.edm_mode == REFLECTORLESS or settings.target_type == 1
        constant_m = PRISM_CONSTANTS_M[TAPE] if reflectorless else settings.prism_constant_m
        true_constant_m = PRISM_CONSTANTS_M[TAPE] if seen.prism is None else self._reflector_m
        scale = 1.0 + (self.settings.ppm() - atmospheric_ppm(*self.air)) * 1e-6
        return Offered(
            instrument_ms=self.instrument_ms(at_ns),
            true_ns=at_ns,
            horizontal_angle_rad=horizontal,
            zenith_angle_rad=zenith,
            distance_m=(distance_m - true_constant_m) * scale + constant_m,
            prism=seen.prism,
            code=seen.code,
        )

    def _pointed(self, seen: Seen, at_ns: int) -> Direction2 | None:
        """Return the direction of the angles where it is not that of the point whose distance was taken."""
        if not seen.followed or seen.prism is None:
            return seen.direction
        if not self._model.angle_delay_ms:
            return None
        later_s = self._world_s(at_ns) + self._model.angle_delay_ms / 1e3
        return direction_of(self._scenery.sights[seen.prism].point_at(later_s))
