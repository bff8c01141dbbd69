"""Invariants of simulated missions: what must hold whatever faults occur.

In: a :class:`MissionResult`. Out: violations, each with subject, measured value and limit. `invariants` names them all and
checks measurements and journals; each other file is one check:

- `poses` against truth, measurements and documentation: a room of its own;
- stream and files: `recorded_lines`, `heard_lines`, `setup_lines`, `poll_replies`, `acknowledgements`;
- status and events: `status_numbers`, `station_reports`, `station_events`, `outstanding`;
- `devices`, the IMU and the wheels of the robot: likewise;
- `liveness` after faults, `memory_bounds`.
"""

from tsgt.simulation.checks.invariants import Violation, check_invariants
from tsgt.simulation.checks.memory_bounds import oversized_collections

__all__ = [
    "Violation",
    "check_invariants",
    "oversized_collections",
]
