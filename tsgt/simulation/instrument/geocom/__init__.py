"""TODO face."""

from tsgt.simulation.instrument.geocom.answers import Offered
from tsgt.simulation.instrument.geocom.server import GeoComServer

__all__ = [
    "GeoComServer",
    "Offered",
]
