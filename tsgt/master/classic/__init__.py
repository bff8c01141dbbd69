"""TODO face."""

from tsgt.master.classic.ingest import KNOWN_MEASUREMENTS, UNTIMED_SIGMA_NS
from tsgt.master.classic.link import ClassicLink
from tsgt.master.classic.transport import Collector, next_packet

__all__ = [
    "KNOWN_MEASUREMENTS",
    "UNTIMED_SIGMA_NS",
    "ClassicLink",
    "Collector",
    "next_packet",
]
