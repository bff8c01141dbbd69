"""Virtual time: timeline, asyncio event loop and clocks.

In: callbacks at times, a coroutine to run. Out: the same execution order on every run, an hour of sleep in no real time.
`LoopTimeline` offers the same interface in real time. `DriftingClock` is the clock of a computer with its own crystal.
"""

from tsgt.simulation.kernel.clocks import DriftingClock, SimulatedClock, VirtualClock, drift_ramp
from tsgt.simulation.kernel.event_loop import VirtualEventLoop, run_virtual
from tsgt.simulation.kernel.timeline import Handle, LoopTimeline, Timeline, VirtualTimeline

__all__ = [
    "DriftingClock",
    "Handle",
    "LoopTimeline",
    "SimulatedClock",
    "Timeline",
    "VirtualClock",
    "VirtualEventLoop",
    "VirtualTimeline",
    "drift_ramp",
    "run_virtual",
]
