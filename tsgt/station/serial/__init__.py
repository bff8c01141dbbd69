"""TODO face."""

from tsgt.station.serial.base import Chunk, OpenPort, Port

__all__ = [
    "Chunk",
    "OpenPort",
    "Port",
]
