"""TODO face."""

from tsgt.station.leica.identity import Identity, identify, numbers
from tsgt.station.leica.instrument import LeicaInstrument

__all__ = [
    "Identity",
    "LeicaInstrument",
    "identify",
    "numbers",
]
