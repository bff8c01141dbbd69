"""The radio: settings, packets, and what the program asks of any LoRa radio."""

from tsgt.radio.airtime import (
    HEADER_SYMBOLS,
    SYNC_QUARTER_SYMBOLS,
    airtime_us,
    bit_rate_Bps,
    low_data_rate_required,
    payload_symbols,
    symbol_time_ns,
)
from tsgt.radio.base import (
    BANDWIDTHS_HZ,
    MAX_PAYLOAD_BYTES,
    LoRaSettings,
    OpenRadio,
    Packet,
    Radio,
    Transmitted,
)
from tsgt.radio.commands import Command, DirectCommand, Direction, MeasureCommand, SearchCommand, TrackCommand

__all__ = [
    "BANDWIDTHS_HZ",
    "HEADER_SYMBOLS",
    "MAX_PAYLOAD_BYTES",
    "SYNC_QUARTER_SYMBOLS",
    "Command",
    "DirectCommand",
    "Direction",
    "LoRaSettings",
    "MeasureCommand",
    "OpenRadio",
    "Packet",
    "Radio",
    "SearchCommand",
    "TrackCommand",
    "Transmitted",
    "airtime_us",
    "bit_rate_Bps",
    "low_data_rate_required",
    "payload_symbols",
    "symbol_time_ns",
]
