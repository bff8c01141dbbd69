"""The LoRa radio: what the program requires of any radio, and what is common to both protocols.

In: payloads and send times. Out: packets with the timestamps of their reception. `base` has the interface, `sx127x` the
driver, `airtime` the durations on the air, `classic` and `superframe` the two protocols (sans-I/O), `planning` capacity and
regional limits, `legality` whether a configuration keeps to them, `commands` what a master commands a station, `supervisor` reopens a failed radio, `ping` is a bench test.
"""

from tsgt.radio.airtime import (
    HEADER_SYMBOLS,
    SYNC_QUARTER_SYMBOLS,
    TX_DONE_NS,
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
    Packet,
    Radio,
    RadioOpener,
    Transmission,
)
from tsgt.radio.commands import Command, DirectCommand, Direction, MeasureCommand, SearchCommand, TrackCommand

__all__ = [
    "BANDWIDTHS_HZ",
    "HEADER_SYMBOLS",
    "MAX_PAYLOAD_BYTES",
    "SYNC_QUARTER_SYMBOLS",
    "TX_DONE_NS",
    "Command",
    "DirectCommand",
    "Direction",
    "LoRaSettings",
    "MeasureCommand",
    "Packet",
    "Radio",
    "RadioOpener",
    "SearchCommand",
    "TrackCommand",
    "Transmission",
    "airtime_us",
    "bit_rate_Bps",
    "low_data_rate_required",
    "payload_symbols",
    "symbol_time_ns",
]
