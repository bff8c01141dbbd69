"""TODO face."""

from tsgt.radio.superframe.command_exchange import Situation
from tsgt.radio.superframe.master import SESSION_EVERY, SuperframeMaster
from tsgt.radio.superframe.phase_lock import COMPOSED_NS, LEAST_MARGIN_NS, WORTH, FrameLock
from tsgt.radio.superframe.receive_window import KNOWN_LINEAGES
from tsgt.radio.superframe.reception import TimedSighting
from tsgt.radio.superframe.send_queue import MOST_QUEUED, Outbox, Queued
from tsgt.radio.superframe.session import Reception
from tsgt.radio.superframe.slots import FrameTiming, slot_sequence
from tsgt.radio.superframe.station import SuperframeStation
from tsgt.radio.superframe.station_state import EXCHANGE_EVERY

__all__ = [
    "COMPOSED_NS",
    "EXCHANGE_EVERY",
    "KNOWN_LINEAGES",
    "LEAST_MARGIN_NS",
    "MOST_QUEUED",
    "SESSION_EVERY",
    "WORTH",
    "FrameLock",
    "FrameTiming",
    "Outbox",
    "Queued",
    "Reception",
    "Situation",
    "SuperframeMaster",
    "SuperframeStation",
    "TimedSighting",
    "slot_sequence",
]
