"""The polling protocol of the paper (Vaidis et al. 2021), both sides, sans-I/O.

In: packets with their timestamps. Out: packets to send, and measurements, clock samples and commands. `messages` has the
byte formats of the authors' field nodes, `transactions` the master's side (poll, command, synchronisation), `station` the
station's side. Radio and clock are handled by tsgt.master.classic and tsgt.station.links.
"""

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
from tsgt.radio.classic.station import ClassicCommand, ClassicStation
from tsgt.radio.classic.transactions import (
    TURNAROUND_NS,
    CommandTransaction,
    LinkTiming,
    Poll,
    Request,
    SingleMeasurementPoll,
    Synchronisation,
    Transaction,
)

__all__ = [
    "COMMAND_BYTES",
    "MEASUREMENT_BYTES",
    "OK",
    "PING_REPLY_BYTES",
    "TIME_REPLY_BYTES",
    "TURNAROUND_NS",
    "ClassicCommand",
    "ClassicStation",
    "CommandMessage",
    "CommandTransaction",
    "LinkTiming",
    "MeasurementMessage",
    "Poll",
    "Request",
    "SingleMeasurementPoll",
    "Synchronisation",
    "Transaction",
    "decode_command",
    "raw_status",
    "status_of",
]
