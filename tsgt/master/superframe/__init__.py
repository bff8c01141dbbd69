"""The master's side of the TDMA protocol.

In: the radio's packets. Out: link events, and beacons that acknowledge what was written. `frame_loop` runs one frame
after the other, `link` reports the replies and commands the stations.
"""

from tsgt.master.superframe.frame_loop import FrameLoop
from tsgt.master.superframe.link import SuperframeLink, superframe_timing

__all__ = ["FrameLoop", "SuperframeLink", "superframe_timing"]
