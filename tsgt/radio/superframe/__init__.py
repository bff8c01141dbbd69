"""The superframe: the TDMA protocol between one master and up to 16 stations, both sides, sans-I/O.

In: packets with timestamps, measurements, commands, time, random bits. Out: beacons, replies, start and end of slots, and
measurements on the master's clock. In each frame the master sends a beacon with grants and acknowledgements, and the
stations reply in their slots. ``wire`` encodes and authenticates the messages.
"""

from tsgt.radio.superframe.command_exchange import InstrumentState
from tsgt.radio.superframe.condition import UNKNOWN_CONDITION, InstrumentCondition
from tsgt.radio.superframe.demand import EXCHANGE_INTERVAL
from tsgt.radio.superframe.master import SESSION_INTERVAL, SuperframeMaster
from tsgt.radio.superframe.phase_lock import MIN_GAIN, MIN_MARGIN_NS, FramePlan, PhaseLock
from tsgt.radio.superframe.receive_window import MAX_STREAMS
from tsgt.radio.superframe.reception import ReceivedReply, TimedMeasurement
from tsgt.radio.superframe.send_queue import QUEUE_CAPACITY, QueuedMeasurement, SendQueue
from tsgt.radio.superframe.session import BeaconReception, ReceivedBeacon
from tsgt.radio.superframe.slots import COMPOSE_LEAD_NS, FrameTiming, slot_sequence
from tsgt.radio.superframe.station import SuperframeStation

__all__ = [
    "COMPOSE_LEAD_NS",
    "EXCHANGE_INTERVAL",
    "MAX_STREAMS",
    "MIN_GAIN",
    "MIN_MARGIN_NS",
    "QUEUE_CAPACITY",
    "SESSION_INTERVAL",
    "UNKNOWN_CONDITION",
    "BeaconReception",
    "FramePlan",
    "FrameTiming",
    "InstrumentCondition",
    "InstrumentState",
    "PhaseLock",
    "QueuedMeasurement",
    "ReceivedBeacon",
    "ReceivedReply",
    "SendQueue",
    "SuperframeMaster",
    "SuperframeStation",
    "TimedMeasurement",
    "slot_sequence",
]
