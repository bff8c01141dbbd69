"""Model of a robotic total station: optics, EDM, compensator and internal clock, without interface and operator.

What is modelled and what is not: docs/explanation/simulated-instrument.md.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

from tsgt.config import noise
from tsgt.model import ARCSECOND_RAD, TARGET_NOISE
from tsgt.simulation.instrument.edm import (
    NON_PRISM_MODES,
    RANGE_M,
    SINGLE_MEASUREMENT_S,
    EdmSchedule,
    atmospheric_ppm,
    measure_polar,
)
from tsgt.simulation.instrument.generations import GENERATIONS
from tsgt.simulation.instrument.lock_drift import LockDrift
from tsgt.simulation.instrument.optical_disturbances import PolarPoint
from tsgt.simulation.instrument.settings import COMPENSATOR_SIGMA_RAD, PRISM_CONSTANTS_M, TAPE, Settings
from tsgt.simulation.instrument.targets_in_view import TargetsInView, direction_to
from tsgt.simulation.instrument.telescope import Telescope
from tsgt.station.geocom import ReturnCode

if TYPE_CHECKING:
    import numpy as np

    from tsgt.config import ScenarioConfig, SimulatedStation
    from tsgt.simulation.instrument.optical_disturbances import OpticalDisturbance
    from tsgt.simulation.instrument.targets_in_view import TargetObservation
    from tsgt.simulation.instrument.visibility import PolarDirection
    from tsgt.simulation.kernel import Timeline
    from tsgt.simulation.world import World

TILT_LIMIT_RAD: Final = math.radians(4 / 60)
"""Range of the compensator on either side."""

FAST_TURN_RADPS: Final = math.radians(0.5)
"""Above this rate the compensator reading is stale and accuracy is not guaranteed; an assumption."""

FAULT_TILT_RAD: Final = 0.002

POWER_SEARCH_RANGE_M: Final = (0.0, 400.0)

_MAX_COUNT_JUMP_NS: Final = (
    1_000_000_000  # an instrument that was switched off and on takes 5 s until it responds
)

REFLECTORLESS: Final = 5
"""The reflectorless EDM mode."""


class ReportedDistance(NamedTuple):
    """A distance measurement that a response has reported."""

    instrument_ms: int  # timestamp in ms since the instrument was switched on
    true_ns: int  # when it was measured, on the timeline
    horizontal_angle_rad: float
    zenith_angle_rad: float
    distance_m: float
    prism: int | None  # None: a foil target
    code: int  # GeoCOM return code
    slowed_by: float = 1.0  # how many times slower than usual the instrument was

    def switched_on_since(self, before: ReportedDistance) -> bool:
        """Whether the count of the instrument has restarted since an earlier distance."""
        passed_ns = (self.instrument_ms - before.instrument_ms) * 1_000_000
        return abs(self.true_ns - before.true_ns - passed_ns) > _MAX_COUNT_JUMP_NS


class TotalStationModel:
    """Measuring part of a total station. It starts switched on, levelled, and locked on its prism.

    State is computed on request: most methods need :meth:`advance` first.

    Parameters
    ----------
    world
        Ground truth; held constant before its start and after its end.
    timeline
        True time.
    start_ns
        True time of the world's start in ns.

    Attributes
    ----------
    tilt_rad
        Tilt across and along the line of sight, as the compensator shows it.
    air
        Actual temperature in degrees Celsius and pressure in hPa along the line of sight.
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
        self._targets = TargetsInView(station, scenario, world)
        self.disturbances: list[OpticalDisturbance] = []  # of the line of sight to any prism
        now_ns = timeline.now_ns()
        period_ns = round(1e9 / station.rate_hz)
        phase_ns = now_ns + int(generator.integers(period_ns))
        self.edm = EdmSchedule(period_ns, model.tick_jitter_ms * 1e6, phase_ns, generator)
        self.telescope = Telescope(
            self._targets.prisms, prediction_s=model.prediction_s, now_s=self._world_s(now_ns)
        )
        self._lock_drift = LockDrift(model, generator)
        self._select_target(station.prism)
        self.telescope.follow(station.prism)
        self._observation: TargetObservation | None = None
        self._observed_ns: int | None = None
        self._result: ReportedDistance | ReturnCode | None = None
        self._on_since_ns: int | None = now_ns - int(generator.uniform(60e9, 3600e9))
        self.face = 0  # 0: first face; 1: second face
        self.settings = Settings()
        self.robotic_licence = True  # whether the option GeoCOM Robotic is installed
        self.battery_percent = 85.0
        self.external_power = False
        self.tilt_rad = (3.0 * ARCSECOND_RAD, -2.0 * ARCSECOND_RAD)
        self.air = (12.0, 1013.25)
        self.generation = GENERATIONS[model.generation]
        self.name = self.generation.name
        self.serial_number = 230_000 + station.station
        self.reported_distances: list[ReportedDistance] = []  # each reported distance once
        self.beeps: list[int] = []  # True times of beeps in ns

    @property
    def timeline(self) -> Timeline:
        """Time of whatever is connected to it, too."""
        return self._timeline

    def now_ns(self) -> int:
        """Return the true time in ns."""
        return self._timeline.now_ns()

    def draw(self, span: tuple[float, float]) -> float:
        """Draw a number uniformly from an interval."""
        return float(self._rng.uniform(*span))

    def _draw_normal(self, sigma: float) -> float:
        """Draw a number from a normal distribution; an array of two would take five times as long."""
        return sigma * self._rng.standard_normal()

    def advance(self) -> int:
        """Bring telescope and EDM up to date; return the true time in ns."""
        now_ns = self._timeline.now_ns()
        newest_ns = self.edm.newest(now_ns)
        if newest_ns is None:
            self._observed_ns = None
        elif newest_ns != self._observed_ns:
            newest_s = self._world_s(newest_ns)
            self.telescope.advance(newest_s)
            self._observed_ns, self._observation, self._result = newest_ns, self._observe(newest_s), None
        self.telescope.advance(self._world_s(now_ns))
        return now_ns

    def instrument_ms(self, true_ns: int) -> int:
        """Return the instrument's time: ms since it was switched on, as a signed 32-bit integer."""
        on_ns = true_ns - (self._on_since_ns if self._on_since_ns is not None else true_ns)
        shown_ms = int((on_ns + on_ns * self._model.clock_drift_ppm * 1e-6) // 1_000_000)
        return (shown_ms + 2**31) % 2**32 - 2**31

    # --- Angles -----------------------------------------------------------------------------------------------

    def inclination_rad(self) -> tuple[float, float]:
        """Measure the tilt across and along the line of sight."""
        across, along = self._draw_normal(COMPENSATOR_SIGMA_RAD), self._draw_normal(COMPENSATOR_SIGMA_RAD)
        if self._scenario_fault() == "tilt":
            across += FAULT_TILT_RAD
        return self.tilt_rad[0] + across, self.tilt_rad[1] + along

    def exceeds_tilt_range(self) -> bool:
        """Whether the tilt exceeds the compensator's range."""
        return self._scenario_fault() == "tilt" or (
            self.settings.incline and math.hypot(*self.tilt_rad) > TILT_LIMIT_RAD
        )

    def angles_rad(self) -> PolarDirection:
        """Measure the direction of the telescope: the readings of both circles."""
        horizontal, zenith = self.telescope.direction()
        sigma_rad = self._noise.angle_sigma_rad
        across, up = self._draw_normal(sigma_rad), self._draw_normal(sigma_rad)
        return self.circle_reading((horizontal + across / max(math.sin(zenith), 1e-3), zenith + up))

    def circle_reading(self, direction: PolarDirection) -> PolarDirection:
        """Return what the circles show for a true direction in the current face."""
        horizontal, zenith = direction
        horizontal += self.settings.orientation_rad + (math.pi if self.face else 0.0)
        return horizontal % math.tau, math.tau - zenith if self.face else zenith

    def true_direction(self, reading: PolarDirection) -> PolarDirection:
        """Return the true direction of a circle reading; a zenith angle above pi is in the second face."""
        horizontal, zenith = reading
        horizontal -= self.settings.orientation_rad
        if zenith > math.pi:
            return (horizontal - math.pi) % math.tau, math.tau - zenith
        return horizontal % math.tau, zenith

    def with_positioning_error(self, direction: PolarDirection) -> PolarDirection:
        """Return the direction at which the telescope comes to rest when it is sent to ``direction``."""
        across, up = self._rng.normal(0.0, 1.0, 2).tolist()
        tolerances = self.settings.tolerance_rad
        return direction[0] + across * tolerances[0] / 2, direction[1] + up * tolerances[1] / 2

    def turns_fast(self) -> bool:
        """Whether the telescope turns too fast for a valid compensator reading."""
        return self.telescope.speed_radps() > FAST_TURN_RADPS

    # --- Distances --------------------------------------------------------------------------------------------

    def start_measuring(self, now_ns: int, *, continuous: bool) -> None:
        """Start a continuous or a single distance measurement."""
        if continuous:
            self.edm.start(now_ns)
        else:
            self.edm.start_single(now_ns + round(self._rng.uniform(*SINGLE_MEASUREMENT_S) * 1e9))

    def has_distance(self) -> bool:
        """Whether a distance is stored or being measured."""
        self.advance()
        return self.edm.has_measurement

    def result(self) -> ReportedDistance | ReturnCode:
        """Return the newest distance, or the return code that says why there is none."""
        if self._observation is None or self._observed_ns is None:
            return ReturnCode.TMC_ANGLE_OK  # not started, or not finished yet
        if self._result is None:
            self._result = self._measure(self._observation, self._observed_ns)
        return self._result

    def report(self, result: ReportedDistance) -> None:
        """Note that a response reports this distance."""
        if not self.reported_distances or self.reported_distances[-1].true_ns != result.true_ns:
            self.reported_distances.append(result)

    def power_search(
        self, start_rad: float, turn_rad: float, height_rad: tuple[float, float]
    ) -> tuple[int, float] | None:
        """Return the first prism of a PowerSearch, see :meth:`TargetsInView.power_search`."""
        world_s = self._world_s(self.advance())
        range_m = self.settings.search_range_m if self.settings.search_range_on else POWER_SEARCH_RANGE_M
        if self.telescope.blocked:
            return None
        return self._targets.power_search(
            world_s, (start_rad, turn_rad), height_rad, range_m, self.telescope.target_id
        )

    def point_at_prism(self, prism: int) -> float:
        """Point at the current position of a prism; return its angular speed across the line of sight in rad/s."""
        visibility, now_s = self._targets.prisms[prism], self._world_s(self._timeline.now_ns())
        self.telescope.turn_to(visibility.direction_at(now_s))
        return visibility.speed_at(now_s)

    # --- Inside -----------------------------------------------------------------------------------------------

    def _select_target(self, prism: int) -> None:
        """Select an active prism by its target ID, if the prisms have one."""
        self.telescope.target_id = prism if self._model.distinguishes_prisms else None

    def _scenario_fault(self) -> str | None:
        return self._targets.fault_at(self._world_s(self._timeline.now_ns()))

    def _world_s(self, true_ns: int) -> float:
        return (true_ns - self._start_ns) / 1e9

    def _observe(self, world_s: float) -> TargetObservation:
        """Find the reflecting target; the telescope has advanced to this instant. The code is that of the angles."""
        settings = self.settings
        seen = self._targets.observe(
            world_s, self.telescope, foil=settings.edm_mode in NON_PRISM_MODES or settings.target_type == 1
        )
        if seen.point is None:
            return seen
        if not settings.incline:
            return seen._replace(code=ReturnCode.TMC_NO_FULL_CORRECTION)
        return seen._replace(code=ReturnCode.TMC_ACCURACY_GUARANTEE) if self.turns_fast() else seen

    def _measure(self, seen: TargetObservation, at_ns: int) -> ReportedDistance | ReturnCode:
        if seen.point is None:
            return seen.code
        target_noise = self._noise if seen.prism is not None else TARGET_NOISE
        if not seen.followed:
            target_noise = replace(
                target_noise, pointing_sigma_m=0.0
            )  # the pointing error is in the direction
        across, up, distances = measure_polar(seen.point[None], target_noise, self._rng)
        horizontal, zenith, distance_m = float(across[0]), float(up[0]), float(distances[0])
        if not RANGE_M[0] <= distance_m <= RANGE_M[1]:
            return ReturnCode.TMC_ANGLE_OK
        pointed = self._pointing_direction(seen, at_ns)
        if pointed is not None:
            true = direction_to(seen.point)
            horizontal, zenith = horizontal + pointed[0] - true[0], zenith + pointed[1] - true[1]
        if seen.followed and seen.prism is not None:
            right_m, down_m = self._lock_drift.offset_m(
                self._targets.prisms[seen.prism], self._world_s(at_ns), self.telescope.locked_s
            )
            horizontal += right_m / (distance_m * max(math.sin(zenith), 1e-3))
            zenith += down_m / distance_m
        if seen.prism is not None:
            for disturbance in self.disturbances:
                disturbed = disturbance.apply(
                    PolarPoint(horizontal, zenith, distance_m), self._world_s(at_ns)
                )
                if disturbed is None:
                    return ReturnCode.TMC_ANGLE_OK
                horizontal, zenith, distance_m = disturbed
        horizontal, zenith = self.circle_reading((horizontal, zenith))
        settings = self.settings
        reflectorless = settings.edm_mode == REFLECTORLESS or settings.target_type == 1
        constant_m = PRISM_CONSTANTS_M[TAPE] if reflectorless else settings.prism_constant_m
        true_constant_m = PRISM_CONSTANTS_M[TAPE] if seen.prism is None else self._reflector_m
        scale = 1.0 + (self.settings.ppm() - atmospheric_ppm(*self.air)) * 1e-6
        return ReportedDistance(
            instrument_ms=self.instrument_ms(at_ns),
            true_ns=at_ns,
            horizontal_angle_rad=horizontal,
            zenith_angle_rad=zenith,
            distance_m=(distance_m - true_constant_m) * scale + constant_m,
            prism=seen.prism,
            code=seen.code,
            slowed_by=self.edm.slowed_by,
        )

    def _pointing_direction(self, seen: TargetObservation, at_ns: int) -> PolarDirection | None:
        """Return the direction of the angle measurement; None: that of the measured point."""
        if not seen.followed or seen.prism is None:
            return seen.direction
        if not self._model.angle_delay_ms:
            return None
        later_s = self._world_s(at_ns) + self._model.angle_delay_ms / 1e3
        return direction_to(self._targets.prisms[seen.prism].point_at(later_s))
