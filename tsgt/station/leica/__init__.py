"""The driver of one Leica total station: identity, settings, tracking, target reacquisition, single measurements, timing.

In: a configuration, an opener of the serial port, and the commands of :class:`~tsgt.station.instrument.Instrument`. Out:
readings with timestamps on the host's clock, the instrument's condition, and its settings as read back.
"""

from tsgt.station.leica.identity import Identity, identify, numeric_values
from tsgt.station.leica.instrument import LeicaInstrument

__all__ = [
    "Identity",
    "LeicaInstrument",
    "identify",
    "numeric_values",
]
