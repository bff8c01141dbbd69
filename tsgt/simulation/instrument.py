"""A simulated total station that tracks a prism, or measures targets one by one.

Modelled: rate and phase, noise of range, angles and pointing, the prism constant that the raw distance lacks, prisms
that are hidden, verdicts at given times, distances below 1 m, a cable that is pulled. Not modelled: how lock is lost
and found again, latency and its jitter, the errors of a 360 degree prism.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.config.parameters import level_frame, noise
from tsgt.errors import InstrumentError
from tsgt.geometry import invert, raw_distance, transform_points
from tsgt.model import TARGET_NOISE, Status
from tsgt.simulation.clocks import DriftingClock
from tsgt.simulation.noise import with_noise
from tsgt.station.instrument import Condition, Reading

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.clock import Clock
    from tsgt.config import ScenarioConfig
    from tsgt.config.scenario import SimulatedStation
    from tsgt.model import InstrumentNoise
    from tsgt.radio.orders import Direction
    from tsgt.simulation.world import World
    from tsgt.station.instrument import Atmosphere

LEAST_DISTANCE_M = 1.0
"""Closer than this there are angles, but no distance."""

SHOT_S = (1.0, 2.0)
"""A single measurement takes a time between these."""

RAW_STATUS = {
    Status.OK: 0,
    Status.TILT: 1,
    Status.WRONG_DISTANCE: 2,
    Status.NO_TARGET: 3,
    Status.ANGLE_ONLY: 4,
}
"""The simulated make numbers its verdicts as the authors' nodes do; anything else is 3."""


class SimulatedInstrument:
    """An :class:`~tsgt.station.instrument.Instrument` in a simulated world; measurements take no time on a line.

    It measures at even intervals of its host's clock, tracked or not; what happens then is read at the true time.

    Parameters
    ----------
    station
        Which of the scenario's stations it is.
    scenario
        Prisms, targets and faults.
    world
        The truth; before its start and after its end everything stands still.
    clock
        Of the computer that the instrument is read by. A :class:`~tsgt.simulation.clocks.DriftingClock` tells the
        true time too; any other one is taken for the truth.
    generator
        Source of all randomness.
    start_ns
        True monotonic time at which the world starts, in ns.

    Attributes
    ----------
    plugged
        Whether the cable is in; without it every call raises InstrumentError.
    """

    def __init__(
        self,
        station: SimulatedStation,
        scenario: ScenarioConfig,
        world: World,
        clock: Clock,
        generator: np.random.Generator,
        *,
        start_ns: int = 0,
    ) -> None:
        self._station = station
        self._prism_rows = {prism.prism: row for row, prism in enumerate(scenario.prisms)}
        self._targets_m = np.array(scenario.targets_m, dtype=np.float64).reshape(-1, 3)
        self._faults = [fault for fault in scenario.faults if fault.station == station.station]
        self._world = world
        self._clock = clock
        self._true_ns = clock.true_ns if isinstance(clock, DriftingClock) else int
        self._rng = generator
        self._start_ns = start_ns
        self._T_station_station1 = invert(np.array(level_frame(station)))
        self._noise = noise(station.noise)
        self._constant_m = station.prism_constant_mm / 1e3
        self._period_ns = round(1e9 / station.rate_hz)
        self._phase_ns = clock.monotonic_ns() + int(generator.integers(self._period_ns))
        self._next = 0
        self._prism: int | None = None
        self._direct = False
        self._target: int | None = None
        self.plugged = True

    # --- What a person does -----------------------------------------------------------------------------------

    def aim(self, target: int | None) -> None:
        """Point at one of the scenario's targets, from 1, or away from all of them; as a person does by hand."""
        if target is not None and not 1 <= target <= len(self._targets_m):
            raise InstrumentError(f"there is no target {target}; the scenario has {len(self._targets_m)}")
        self._target = target

    # --- Instrument -------------------------------------------------------------------------------------------

    async def connect(self) -> str:
        """Answer at once; nothing is tracked."""
        self._check_cable()
        self._prism, self._direct = None, False
        return f"simulated total station {self._station.station}"

    async def track(self, prism: int, towards: Direction | None = None) -> None:  # noqa: ARG002 (it finds it anyway)
        """Track a prism of the scenario from now on; it is found at once, where it is not hidden."""
        self._check_cable()
        if prism not in self._prism_rows:
            raise InstrumentError(
                f"the robot has no prism {prism}; the scenario knows {sorted(self._prism_rows)}"
            )
        self._prism, self._direct = prism, False
        self._next = max(self._next, self._passed() + 1)

    async def read(self) -> Reading:
        """Return the measurement of the next instant; those that nobody asked for in time are gone, but the newest."""
        self._check_cable()
        if self._prism is None:
            raise InstrumentError("no prism is tracked; call track first")
        number = max(self._next, self._passed())
        at_ns = self._phase_ns + number * self._period_ns
        await self._clock.sleep_until(at_ns)
        self._check_cable()
        self._next = number + 1
        return self._tracked(self._prism, at_ns)

    async def direct(self) -> None:
        """Stop tracking."""
        self._check_cable()
        self._prism, self._direct = None, True

    async def measure(self) -> Reading:
        """Measure the target that is aimed at; it takes a second or two."""
        self._check_cable()
        if not self._direct:
            raise InstrumentError("the instrument is tracking; call direct first")
        now_ns = self._clock.monotonic_ns()
        await self._clock.sleep_until(now_ns + round(self._rng.uniform(*SHOT_S) * 1e9))
        self._check_cable()
        at_ns = self._clock.monotonic_ns()
        status = self._status_at(self._world_s(at_ns), Status.OK if self._target else Status.NO_TARGET)
        point = self._targets_m[self._target - 1] if self._target else None
        return self._reading(at_ns, None, point, status, TARGET_NOISE, constant_m=0.0)

    async def set_atmosphere(self, atmosphere: Atmosphere) -> None:  # noqa: ARG002 (its air is the reference)
        """Do nothing; there is no air between it and its prisms."""
        self._check_cable()

    @property
    def condition(self) -> Condition:
        """Nothing ever is the matter with it."""
        return Condition()

    @property
    def record(self) -> None:
        """It has no settings."""

    async def close(self) -> None:
        """Do nothing; the instrument stays on."""

    # --- The measurement --------------------------------------------------------------------------------------

    def _check_cable(self) -> None:
        if not self.plugged:
            raise InstrumentError("the simulated total station does not answer; plug it in")

    def _passed(self) -> int:
        """Return the number of the last instant that has passed, -1 before the first one."""
        return (self._clock.monotonic_ns() - self._phase_ns) // self._period_ns

    def _world_s(self, at_ns: int) -> float:
        return (self._true_ns(at_ns) - self._start_ns) / 1e9

    def _status_at(self, world_s: float, otherwise: Status) -> Status:
        return next(
            (Status(fault.status) for fault in self._faults if fault.start_s <= world_s < fault.end_s),
            otherwise,
        )

    def _tracked(self, prism: int, at_ns: int) -> Reading:
        world_s = self._world_s(at_ns)
        inside_s = min(max(world_s, 0.0), self._world.duration_s)
        hidden = self._world.hidden(self._station.station, inside_s)
        status = self._status_at(world_s, Status.NO_TARGET if hidden else Status.OK)
        point = self._world.prism_at(np.array([inside_s]), self._prism_rows[prism])[0]
        return self._reading(at_ns, prism, point, status, self._noise, constant_m=self._constant_m)

    def _reading(
        self,
        at_ns: int,
        prism: int | None,
        point: NDArray[np.float64] | None,
        status: Status,
        noise: InstrumentNoise,
        *,
        constant_m: float,
    ) -> Reading:
        horizontal_rad, zenith_rad, distance_m = 0.0, 0.0, None
        if point is not None and status in (Status.OK, Status.LOW_ACCURACY, Status.ANGLE_ONLY):
            seen = transform_points(self._T_station_station1, point[None])
            horizontal, zenith, distance = with_noise(seen, noise, self._rng)
            horizontal_rad, zenith_rad = float(horizontal[0]), float(zenith[0])
            if distance[0] < LEAST_DISTANCE_M:
                status = Status.ANGLE_ONLY
            if status is not Status.ANGLE_ONLY:
                distance_m = float(raw_distance(distance[0], constant_m=constant_m, ppm=0.0))
        return Reading(
            at_ns=at_ns,
            prism=prism,
            horizontal_angle_rad=horizontal_rad,
            zenith_angle_rad=zenith_rad,
            slope_distance_m=distance_m,
            status=status,
            raw_status=RAW_STATUS.get(status, 3),
        )
