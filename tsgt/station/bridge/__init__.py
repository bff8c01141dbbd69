"""TODO face."""

from tsgt.station.bridge.instrument import BridgeInstrument

__all__ = [
    "BridgeInstrument",
]
