"""TODO face."""

from tsgt.simulation.checks.invariants import Violation, violations
from tsgt.simulation.checks.memory_bounds import overgrown

__all__ = [
    "Violation",
    "overgrown",
    "violations",
]
