"""TODO face."""

from tsgt.timesync.beacon_clock import MOST_PAIRS, BeaconClock
from tsgt.timesync.instrument_clock import LATEST_NS, InstrumentClock
from tsgt.timesync.link_delay import RoundTrip
from tsgt.timesync.offset_regression import highest_offset_ns, sag_ns
from tsgt.timesync.periodicity import Beat, Rhythm
from tsgt.timesync.two_way import ArrivalCheck, ClockEstimate, ClockFilter, RegressionFilter, clock_filter

__all__ = [
    "LATEST_NS",
    "MOST_PAIRS",
    "ArrivalCheck",
    "BeaconClock",
    "Beat",
    "ClockEstimate",
    "ClockFilter",
    "InstrumentClock",
    "RegressionFilter",
    "Rhythm",
    "RoundTrip",
    "clock_filter",
    "highest_offset_ns",
    "sag_ns",
]
