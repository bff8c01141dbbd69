"""TODO face."""

from tsgt.master.superframe.frame_loop import FrameLoop
from tsgt.master.superframe.link import SuperframeLink, superframe_timing

__all__ = [
    "FrameLoop",
    "SuperframeLink",
    "superframe_timing",
]
