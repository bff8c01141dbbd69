"""Radio links of a station: the asyncio half of each protocol, around its sans-I/O half in :mod:`tsgt.radio`.

In: a radio, journalled measurements and command results. Out: replies to the master, the master's commands, and the
link's status. ``classic`` is the paper's polling protocol, ``superframe`` the TDMA protocol; ``traffic_monitor`` reports
a master that stays silent.
"""

from tsgt.station.links.base import Link
from tsgt.station.links.classic import ClassicLink
from tsgt.station.links.superframe import SuperframeLink

__all__ = [
    "ClassicLink",
    "Link",
    "SuperframeLink",
]
