"""The master's timestamps of one station's measurements: link delay, beacon delay, reception bounds. Sans-I/O."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from tsgt.radio.superframe.reception import TimedMeasurement
from tsgt.radio.superframe.slots import EXACT_SIGMA_NS
from tsgt.radio.superframe.wire import (
    MAX_NARROW_AGE_NS,
    TIME_BITS,
    TIME_UNIT_US,
    WIDE_TIME_BITS,
    angle_rad,
    distance_m,
    quality_bound_us,
)

if TYPE_CHECKING:
    from tsgt.radio.superframe.reception import ReplyTiming
    from tsgt.radio.superframe.wire import MeasurementBlock, Reply
    from tsgt.timesync import LinkDelayEstimator

SIGMAS = 4  # sigmas in the bound of a timestamp

MAX_AHEAD_US = 20_000  # latest time of a measurement after the nominal, or actual, start of its reply

MAX_AMBIGUOUS_DELAY_NS = 30_000_000
"""Beacons delayed by more may agree with each other in the 16 low bits of their times."""

_ROUNDING_NS = 9_000  # half a time unit, plus rounding to microseconds


class BeaconDelayMonitor:
    """Detects that beacons reach a station later than it can notice from the low bits of their times.

    The station's replies are then late by the same delay. While beacons carry their full time, the first one on time
    contradicts the delayed ones, and with the next one the station knows. ``delay_ns`` is the maximum delay so far;
    0 from the second consecutive reply on time, if the beacon after the first one carried its time.
    """

    def __init__(self) -> None:
        self.delay_ns = 0
        self._on_time: int | None = None

    def add(self, counter: int, lateness_ns: int, *, beacon_time_sent: bool) -> None:
        """Take the maximum lateness of a frame's reply; ``beacon_time_sent``: the next beacon carries this one's time."""
        if lateness_ns > MAX_AMBIGUOUS_DELAY_NS:
            self.delay_ns, self._on_time = max(self.delay_ns, lateness_ns), None
            return
        if self._on_time == counter - 1:
            self.delay_ns = 0
        self._on_time = counter if beacon_time_sent else None


class StationTiming:
    """Puts one station's measurements on the master's CLOCK_MONOTONIC, where session time starts at ``zero_ns``."""

    def __init__(self, link_delay: LinkDelayEstimator, zero_ns: int) -> None:
        self.link_delay = link_delay
        self.beacon_delay = BeaconDelayMonitor()
        self._zero_ns = zero_ns
        self._last_exchange: tuple[int, int] | None = None

    def reset(self) -> None:
        """Forget the last exchange: the station starts a new session."""
        self._last_exchange = None

    def session_us(self, monotonic_ns: int) -> int:
        """Return the session time."""
        return (monotonic_ns - self._zero_ns + 500) // 1000

    def update_beacon_delay(self, at: ReplyTiming) -> None:
        """Take the lateness of a reply."""
        lateness_ns = self._excess_delay_ns(at) + SIGMAS * at.sent_sigma_ns
        self.beacon_delay.add(at.counter, lateness_ns, beacon_time_sent=at.sent_sigma_ns <= EXACT_SIGMA_NS)

    def update_link_delay(self, turnaround_us: int | None, at: ReplyTiming) -> bool:
        """Measure the link delay of the previous frame, if this reply has its turnaround; return False if impossible."""
        before, self._last_exchange = self._last_exchange, None
        possible = True
        if before is not None and before[0] == at.counter - 1 and turnaround_us is not None:
            possible = self.link_delay.add(before[1] - 1000 * turnaround_us)
        if max(at.sent_sigma_ns, at.received_sigma_ns) <= EXACT_SIGMA_NS:
            self._last_exchange = (at.counter, at.received_ns - at.sent_ns)
        return possible

    def is_ambiguous(self, reply: Reply, at: ReplyTiming) -> bool:
        """Whether a reply is so late that a narrow time in it may have wrapped.

        A station decides at the start of its slot which measurements need a wide block. In a reply sent much later,
        because its computer was stopped or the packet was delayed, a measurement may have become too old, or may be newer
        than the slot. The reply is ignored; the station sends the measurements again.
        """
        oldest_us = self.session_us(at.slot_ns) - MAX_NARROW_AGE_NS // 1000 - MAX_AHEAD_US
        return any(self._newest_us(block, at) - _wrap_us(block) >= oldest_us for block in reply.blocks)

    def timestamps(
        self, block: MeasurementBlock, newest_sequence: int, prism: int, at: ReplyTiming
    ) -> list[TimedMeasurement]:
        """Return the measurements of a block with full sequence numbers and timestamps."""
        newest = block.measurements[0]
        newest_us = self._newest_us(block, at)
        claimed_ns = 1000 * quality_bound_us(block.quality)
        if block.beacon_relative:  # off by any delay of this beacon, which delays the reply as well
            claimed_ns += self._excess_delay_ns(at) + SIGMAS * at.sent_sigma_ns
        else:
            claimed_ns += self.beacon_delay.delay_ns
        link = self.link_delay
        sigma_ns = math.hypot(claimed_ns / SIGMAS, _ROUNDING_NS / math.sqrt(3), link.sigma_ns)
        bound_ns = claimed_ns + _ROUNDING_NS + link.bound_ns + link.anomaly_ns
        timed = []
        for measurement in block.measurements:
            older = measurement is not newest
            sequence = newest_sequence + (measurement.sequence - newest.sequence if older else 0)
            time_us = newest_us + (TIME_UNIT_US * (measurement.time - newest.time) if older else 0)
            if sequence < 0:
                continue
            timed.append(
                TimedMeasurement(
                    sequence=sequence,
                    prism=prism,
                    measured_ns=self._zero_ns + 1000 * time_us + link.link_delay_ns,
                    sigma_ns=round(sigma_ns),
                    bound_ns=bound_ns,
                    status=measurement.status,
                    horizontal_angle_rad=angle_rad(measurement.horizontal),
                    zenith_angle_rad=angle_rad(measurement.zenith),
                    slope_distance_m=distance_m(measurement.distance, far=block.far),
                )
            )
        return timed

    def _excess_delay_ns(self, at: ReplyTiming) -> int:
        """Return the maximum lateness beyond the measured link delay, which counts twice: beacon and reply."""
        usual_ns = 2 * (self.link_delay.link_delay_ns - self.link_delay.nominal_ns)
        return max(_max_lateness_ns(at) - usual_ns, 0)

    def _newest_us(self, block: MeasurementBlock, at: ReplyTiming) -> int:
        """Return the session time of a block's newest measurement: the last one before the reply's start that fits."""
        end_us = self.session_us(at.slot_ns + max(_max_lateness_ns(at), 0)) + MAX_AHEAD_US
        origin_us = self.session_us(at.sent_ns) if block.beacon_relative else 0
        return end_us - (end_us - origin_us - TIME_UNIT_US * block.measurements[0].time) % _wrap_us(block)


def _max_lateness_ns(at: ReplyTiming) -> int:
    return at.lateness_ns + SIGMAS * at.received_sigma_ns


def _wrap_us(block: MeasurementBlock) -> int:
    """Return the period after which a block's times repeat."""
    return TIME_UNIT_US << (WIDE_TIME_BITS if block.wide else TIME_BITS)
