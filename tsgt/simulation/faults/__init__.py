"""TODO face."""

from tsgt.simulation.faults.catalogue import (
    CALM_S,
    QUICK_CYCLES,
    SETTLE_S,
    FaultKind,
    draw_faults,
    parse_faults,
)
from tsgt.simulation.faults.injection import act, see_to_instruments

__all__ = [
    "CALM_S",
    "QUICK_CYCLES",
    "SETTLE_S",
    "FaultKind",
    "act",
    "draw_faults",
    "parse_faults",
    "see_to_instruments",
]
