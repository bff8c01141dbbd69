"""Invariants of simulated missions: what must hold whatever faults occur.

In: a :class:`MissionResult`. Out: violations, each with subject, measured value and limit. `invariants` checks data and
files, `pose_consistency` poses against the truth, `liveness` recovery after faults, `memory_bounds` collection sizes.
"""

from tsgt.simulation.checks.invariants import Violation, check_invariants
from tsgt.simulation.checks.memory_bounds import oversized_collections

__all__ = [
    "Violation",
    "check_invariants",
    "oversized_collections",
]
