"""TODO face."""

from tsgt.radio.classic.messages import (
    COMMAND_BYTES,
    MEASUREMENT_BYTES,
    OK,
    PING_REPLY_BYTES,
    TIME_REPLY_BYTES,
    CommandMessage,
    MeasurementMessage,
    decode_command,
    raw_status,
    status_of,
)
from tsgt.radio.classic.transactions import CommandTransaction, Poll, Shot, Synchronisation
from tsgt.radio.classic.turn import Timing

__all__ = [
    "COMMAND_BYTES",
    "MEASUREMENT_BYTES",
    "OK",
    "PING_REPLY_BYTES",
    "TIME_REPLY_BYTES",
    "CommandMessage",
    "CommandTransaction",
    "MeasurementMessage",
    "Poll",
    "Shot",
    "Synchronisation",
    "Timing",
    "decode_command",
    "raw_status",
    "status_of",
]
