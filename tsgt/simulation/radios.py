"""The real driver on simulated chips that share one simulated air, on virtual time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.radio.sx127x import SX127x
from tsgt.simulation.chip import SX1276Chip
from tsgt.simulation.hal import SimulatedHal

if TYPE_CHECKING:
    import numpy as np

    from tsgt.clock import Clock
    from tsgt.simulation.air import Air
    from tsgt.simulation.timeline import Timeline


def simulated_radio(
    air: Air, name: str, timeline: Timeline, clock: Clock, rng: np.random.Generator
) -> SX127x:
    """Make a radio on the air, which is still to be started.

    Parameters
    ----------
    air
        What it shares with others.
    name
        Its own, by which the air's link model knows it.
    timeline, clock
        One time under two faces: what the chip waits on, and what the driver is told.
    rng
        Of the chip's jitter.
    """
    chip = SX1276Chip(timeline, lambda antenna: air.join(antenna, name), rng)
    return SX127x(SimulatedHal(chip), clock)
