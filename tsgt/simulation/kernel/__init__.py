"""TODO face."""

from tsgt.simulation.kernel.clocks import DriftingClock, SimulatedClock, VirtualClock, ramped
from tsgt.simulation.kernel.event_loop import run_virtual
from tsgt.simulation.kernel.timeline import Handle, LoopTimeline, Timeline, VirtualTimeline

__all__ = [
    "DriftingClock",
    "Handle",
    "LoopTimeline",
    "SimulatedClock",
    "Timeline",
    "VirtualClock",
    "VirtualTimeline",
    "ramped",
    "run_virtual",
]
