"""Instruments behind a bridge: a user's program that has the manufacturer's library and prints JSON lines.

In: its command, stdout and stderr. Out: readings with checked timestamps, condition and settings, commands on its stdin.
``messages`` are the lines, ``process`` runs it, ``session`` processes its output, ``timing`` finds measurement times.
"""

from tsgt.station.bridge.instrument import BridgeInstrument

__all__ = [
    "BridgeInstrument",
]
