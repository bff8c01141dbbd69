"""Instruments behind a bridge: a user's program that has the manufacturer's library and prints JSON lines.

In: the program's command, its stdout and stderr. Out: readings with checked timestamps, the instrument's condition and
settings, and commands on the program's stdin. ``messages`` are the lines, ``process`` runs the program, ``session`` processes
its output, ``timing`` finds the time of each measurement.
"""

from tsgt.station.bridge.instrument import BridgeInstrument

__all__ = [
    "BridgeInstrument",
]
