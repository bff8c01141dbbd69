"""The client of a station: reads the total station, journals every measurement, and replies to the master over the radio.

In: configuration, :class:`ClientDependencies` (instrument, radio, clock, key). Out: a journal on disk, measurements and
command responses on the radio, and a control socket with the client's status. Rooms: ``leica`` and ``bridge`` are
instruments, ``geocom`` and ``serial`` carry the Leica driver's requests, ``links`` are the radio protocols.
"""

from tsgt.station.control_socket import AtmosphereRequest, AtmosphereResponse
from tsgt.station.daemon import run_client
from tsgt.station.dependencies import ClientDependencies
from tsgt.station.instrument import Atmosphere, Condition, Instrument, Reading
from tsgt.station.status import ClientStatus

__all__ = [
    "Atmosphere",
    "AtmosphereRequest",
    "AtmosphereResponse",
    "ClientDependencies",
    "ClientStatus",
    "Condition",
    "Instrument",
    "Reading",
    "run_client",
]
