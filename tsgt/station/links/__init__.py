"""TODO face."""

from tsgt.station.links.base import Link
from tsgt.station.links.classic import ClassicLink
from tsgt.station.links.superframe import SuperframeLink

__all__ = [
    "ClassicLink",
    "Link",
    "SuperframeLink",
]
