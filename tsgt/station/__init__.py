"""The client beside a total station: reads it, journals every measurement, answers the radio."""

from tsgt.station.control_socket import Answer, AtmosphereRequest
from tsgt.station.daemon import run_client
from tsgt.station.instrument import Atmosphere, Condition, Instrument, Reading
from tsgt.station.status import ClientStatus

__all__ = [
    "Answer",
    "Atmosphere",
    "AtmosphereRequest",
    "ClientStatus",
    "Condition",
    "Instrument",
    "Reading",
    "run_client",
]
