"""TODO face."""

from tsgt.simulation.instrument.pty import PtyLine
from tsgt.simulation.instrument.serial_line import LineFault, SimulatedLine
from tsgt.simulation.instrument.telescope import Lock
from tsgt.simulation.instrument.total_station import SimulatedTotalStation

__all__ = [
    "LineFault",
    "Lock",
    "PtyLine",
    "SimulatedLine",
    "SimulatedTotalStation",
]
