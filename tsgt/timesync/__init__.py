"""All clock models of the system: whose clock follows whose, with offset, skew, and bound. Sans-I/O; at most numpy.

In: timestamps of one-way messages, two-way exchanges, or an instrument's responses. Out: times on the other clock with
sigma and bound. The station uses `beacon_clock` (the master's session time), `instrument_clock` (the instrument's over a serial line) and
`exchange_clock` (over a network); the master uses `two_way` (a station's clock), `link_delay`, and `periodicity`.
`clock_line` is the model of the clocks over the radio (`dual_rate` and `offset_regression` estimate it). An instrument's clock is the line
below delayed responses (`delay_envelope`, with the arithmetic in `envelope`), or without the delays that `duration_regression` explains.
"""

from tsgt.timesync.beacon_clock import MAX_SAMPLES, BeaconClock
from tsgt.timesync.envelope import fit_lower_envelope
from tsgt.timesync.exchange_clock import ExchangeClock
from tsgt.timesync.instrument_clock import MAX_DELAY_NS, HostTime, InstrumentClock
from tsgt.timesync.link_delay import LinkDelayEstimator
from tsgt.timesync.periodicity import Period, Periodicity

__all__ = [
    "MAX_DELAY_NS",
    "MAX_SAMPLES",
    "BeaconClock",
    "ExchangeClock",
    "HostTime",
    "InstrumentClock",
    "LinkDelayEstimator",
    "Period",
    "Periodicity",
    "fit_lower_envelope",
]
