"""The master on the robot: measurements to poses, and the stream of both."""

from tsgt.master.daemon import run_master
from tsgt.master.replay import replay, replayed
from tsgt.master.stream_server import QUEUE_LINES, StreamServer

__all__ = [
    "QUEUE_LINES",
    "StreamServer",
    "replay",
    "replayed",
    "run_master",
]
