"""A simulated total station as a user finds it: GeoCOM interface, power switch, and manual operation."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from tsgt.errors import InstrumentError
from tsgt.model import TARGET_NOISE
from tsgt.simulation.instrument.geocom import GeoComServer
from tsgt.simulation.instrument.model import TotalStationModel
from tsgt.simulation.instrument.settings import OFF
from tsgt.simulation.instrument.targets_in_view import direction_to

if TYPE_CHECKING:
    import numpy as np

    from tsgt.config import ScenarioConfig, SimulatedStation
    from tsgt.simulation.instrument.visibility import PrismTrack
    from tsgt.simulation.kernel import Timeline
    from tsgt.simulation.world import World

BOOT_NS: Final = 5_000_000_000
"""From power-on to the first response."""


class SimulatedTotalStation(TotalStationModel):
    """A total station that speaks GeoCOM over a :class:`SimulatedLine` or a :class:`PtyLine`.

    Parameters as of :class:`TotalStationModel`.

    Attributes
    ----------
    server
        GeoCOM server; tests force return codes through it.
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
        super().__init__(station, scenario, world, timeline, generator, start_ns=start_ns)
        self._ready_ns = self._last_received_ns = timeline.now_ns()
        self.baud = station.instrument.baud  # bit rate of its serial port in bits per second
        self.server = GeoComServer(self, timeline, station.instrument, generator)

    def receive(self, data: bytes) -> None:
        """Process bytes that have arrived completely."""
        now_ns = self._timeline.now_ns()
        idle_ns, self._last_received_ns = now_ns - self._last_received_ns, now_ns
        if (
            self.on
            and self.settings.power_mode == OFF
            and idle_ns > self.settings.power_timeout_ms * 1_000_000
        ):
            # It has switched itself off; any character wakes it up.
            self.switch_off()
            self.switch_on()
        if self.on and now_ns >= self._ready_ns:
            self.server.receive(data)

    # --- Manual operation -------------------------------------------------------------------------------------

    @property
    def on(self) -> bool:
        """Whether it is switched on."""
        return self._on_since_ns is not None

    def switch_off(self) -> None:
        """Switch off; releases the lock."""
        self.advance()
        self.telescope.release()
        self.edm.clear()
        self.server.reset()
        self.settings.power_cycle()
        self._on_since_ns = None

    def switch_on(self) -> None:
        """Switch on, not locked; the clock starts at zero and responses after :data:`BOOT_NS`."""
        if self._on_since_ns is None:
            self._on_since_ns = self._timeline.now_ns()
            self._ready_ns = self._on_since_ns + BOOT_NS
            self._last_received_ns = self._ready_ns

    def aim_at_target(self, target: int | None) -> None:
        """Point at a foil target of the scenario, counted from 1; None: away from all targets."""
        targets = self._targets.foils
        if target is not None and not 1 <= target <= len(targets):
            raise InstrumentError(f"there is no target {target}; the scenario has {len(targets)}")
        self.advance()
        if target is None:
            self.telescope.turn_to((0.0, 0.1))
            return
        aimed = targets[target - 1] + self._rng.normal(0.0, TARGET_NOISE.pointing_sigma_m, 3)
        self.telescope.turn_to(direction_to(aimed))

    def aim_at_prism(self, prism: int) -> None:
        """Point at the current position of a prism without locking on it."""
        self.advance()
        self._select_target(prism)
        self.point_at_prism(prism)

    def lock_manually(self, prism: int) -> None:
        """Lock on a prism with the instrument's own keys: needs no licence, aborts a search."""
        self.server.interrupt_movement()
        self.advance()
        self.settings.atr = self.settings.lock = True
        self._select_target(prism)
        self.telescope.follow(prism)

    def add_prism(self, track: PrismTrack, from_s: float, to_s: float, target_id: int) -> int:
        """Add a prism that is not the robot's, in sight from one time to another, in s from the start; return its number here."""
        return self._targets.add(track, from_s, to_s, target_id)

    def take_over(self, prism: int) -> bool:
        """Let a prism take the lock if it is in the field of view of a locked telescope; return whether it has taken it."""
        self.advance()
        return self.telescope.take_over(prism)

    def slow_down(self, factor: float) -> None:
        """Measure and respond this many times slower than usual."""
        self.edm.slow_down(factor, self.advance())
        self.server.processing_factor = factor

    def set_up_at(self, station: SimulatedStation) -> None:
        """Stand where this station says from now on, as if somebody had moved the tripod; the lock remains."""
        self.advance()
        self._targets.move(station)

    @property
    def blocked(self) -> bool:
        """Whether the line of sight is blocked at the telescope."""
        return self.telescope.blocked

    @blocked.setter
    def blocked(self, blocked: bool) -> None:
        self.advance()
        self.telescope.blocked = blocked
