"""A tripod that is moved while the instrument measures."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tsgt.config import ScenarioConfig
from tsgt.geometry import cartesian_to_polar
from tsgt.simulation.instrument import SimulatedTotalStation
from tsgt.simulation.kernel import VirtualTimeline
from tsgt.simulation.world import scenario_world


def test_moved_instrument_sees_targets_from_its_new_place() -> None:
    """Aimed at a foil, before and after: the directions differ by the movement."""
    scenario = ScenarioConfig(targets_m=((20.0, 5.0, 1.0),))
    rng = np.random.default_rng(0)
    world = scenario_world(scenario, 10.0, rng)
    station = scenario.stations[0]
    instrument = SimulatedTotalStation(station, scenario, world, VirtualTimeline(), rng)
    moved = station.model_copy(update={"position_m": (0.0, 0.5, 0.0)})
    instrument.set_up_at(moved)
    instrument.aim_at_target(1)
    horizontal, zenith = instrument.telescope.direction()
    expected = cartesian_to_polar(np.array([20.0, 4.5, 1.0]))
    off_rad = math.remainder(horizontal - float(expected[0]), math.tau)
    assert (off_rad, zenith - float(expected[1])) == pytest.approx((0.0, 0.0), abs=1e-3)
