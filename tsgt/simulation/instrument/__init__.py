"""A simulated robotic total station and the serial line to it.

In: a scenario's station, the ground truth, a timeline. Out: an instrument that answers GeoCOM requests byte by byte over a
simulated line (virtual time) or a pseudo-terminal (real time), and the list of the distances that it has reported.
Sub-room: geocom (its command interpreter).
"""

from tsgt.simulation.instrument.model import ReportedDistance
from tsgt.simulation.instrument.pty import PtyLine
from tsgt.simulation.instrument.serial_line import LineFault, SimulatedLine
from tsgt.simulation.instrument.telescope import Lock
from tsgt.simulation.instrument.total_station import SimulatedTotalStation

__all__ = [
    "LineFault",
    "Lock",
    "PtyLine",
    "ReportedDistance",
    "SimulatedLine",
    "SimulatedTotalStation",
]
