"""How old measurements are when frames begin on the instruments' beat, and when they follow each other at once.

    python benchmarks/run.py frame_lock

Frames only, without radios and daemons: exact times on the air at SF 9, 250 kHz, rate 4/6; a master that needs 6 ms
from the last reply to the next beacon; instruments with even intervals at random phases, 20 ppm apart; whole replies
lost at random. Ages are from the measurement to RxDone at the master. The figures stand in
docs/explanation/frame-lock.md.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.radio import LoRaSettings
from tsgt.radio.superframe import COMPOSE_LEAD_NS, FramePlan, FrameTiming, PhaseLock
from tsgt.radio.superframe.demand import expected_measurements
from tsgt.radio.superframe.wire import GRANT_BYTES, SlotOrder
from tsgt.timesync import Period

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

SETTINGS = LoRaSettings(frequency_hz=905_000_000, spreading_factor=9, bandwidth_hz=250_000, coding_rate=6)
TIMING = FrameTiming.from_tolerances(
    SETTINGS, start_jitter_ns=5_000_000, turnaround_ns=8_000_000, clock_error_ppm=100
)
MASTER_NS = 6_000_000

REPLY_BYTES = (5, 17, 26, 33, 39, 45, 51, 57, 65)
"""With 0 to 8 measurements, code and all."""

BEACON_BYTES = {1: 12, 2: 12, 3: 12, 4: 13, 6: 15, 8: 17}
"""By number of stations."""

MOST_BYTES = {True: 71, False: 125}
"""The longest grant, below eight stations and from there."""

DURATION_NS = 300e9
SEEDS = 30


class Case(NamedTuple):
    """What is tried: latency is what a measurement needs until it can be sent, jitter how uneven the intervals are."""

    stations: int = 3
    loss: float = 0.0
    rate_hz: float = 2.5
    latency_ms: float = 0.0
    jitter_ms: float = 0.0


CASES = (
    Case(),
    Case(latency_ms=30.0),
    Case(jitter_ms=5.0),
    Case(loss=0.05),
    Case(loss=0.1),
    Case(loss=0.2),
    Case(rate_hz=2.0),
    Case(rate_hz=5.0),
    Case(stations=1),
    Case(stations=2),
    Case(stations=4),
    Case(stations=6),
    Case(stations=8),
)


@dataclass
class Station:
    """An instrument, what waits to be sent, and what the master knows of it."""

    made: list[int]
    latency_ns: float
    ready: int = 0
    queue: list[int] = field(default_factory=list)
    newest_ns: int = 0
    heard_ns: int = 0
    missing: int = 0

    def reply(self, composed_ns: int, longest_bytes: int) -> list[int]:
        """Return the newest measurements that fit into a reply."""
        while self.ready < len(self.made) and self.made[self.ready] + self.latency_ns <= composed_ns:
            self.queue.append(self.made[self.ready])
            self.ready += 1
        most = max(count for count, size in enumerate(REPLY_BYTES) if size <= longest_bytes)
        return self.queue[-most:] if most else []

    def taken(self, sent: list[int], slot_ns: int) -> None:
        """Take it that a reply has come, and is acknowledged."""
        self.heard_ns = slot_ns
        del self.queue[len(self.queue) - len(sent) :]
        if sent:
            self.newest_ns = max(self.newest_ns, sent[-1])
            self.missing = len(self.queue)  # by the sequence numbers


def grant(station: Station, slot_ns: int, beat: Period, most_bytes: int) -> int:
    """Return the grant for what a station is expected to have."""
    newest_us, heard_us = station.newest_ns // 1000, station.heard_ns // 1000
    due = expected_measurements(beat, newest_us=newest_us, replied_us=heard_us, slot_us=slot_ns // 1000)
    needed_bytes = REPLY_BYTES[min(due + station.missing, len(REPLY_BYTES) - 1)]
    return bisect_left(GRANT_BYTES, min(needed_bytes, most_bytes))


def run(case: Case, seed: int, *, locked: bool) -> tuple[FloatArray, float]:
    """Run frames; return the ages of all measurements, and the frames' mean length; both in ms."""
    rng = np.random.default_rng(seed)
    stations = []
    for _ in range(case.stations):
        period_ns = 1e9 / case.rate_hz * (1 + rng.normal(0, 20e-6))
        times = rng.uniform(0, period_ns) + np.arange(0, DURATION_NS, period_ns)
        times += rng.normal(0, 1e6 * case.jitter_ms, len(times))
        stations.append(Station([round(time) for time in np.sort(times)], 1e6 * case.latency_ms))
    lock, beacon_bytes = PhaseLock(TIMING, case.stations), BEACON_BYTES[case.stations]
    beacon_ns, most_bytes = TIMING.airtime_ns(beacon_bytes), MOST_BYTES[case.stations < 8]
    beat = Period(1e6 / case.rate_hz, 0, 1e3 * case.jitter_ms)
    plan, grants = FramePlan(0, SlotOrder()), [2] * case.stations
    ages, starts, earliest_ns = [], [], 0
    while earliest_ns < DURATION_NS:
        begin_ns = lock.forecast(earliest_ns, beacon_bytes) if locked else earliest_ns
        spans = [span for span in TIMING.slots(grants, plan.slot_order) if span is not None]
        grants = [
            grant(station, begin_ns + beacon_ns + span.start_ns, beat, most_bytes)
            for station, span in zip(stations, spans, strict=True)
        ]
        plan = (
            lock.plan(earliest_ns, grants, beacon_bytes)
            if locked
            else FramePlan(earliest_ns, plan.slot_order)
        )
        starts.append(plan.start_ns)
        end_ns = earliest_ns = plan.start_ns + beacon_ns
        spans = [span for span in TIMING.slots(grants, plan.slot_order) if span is not None]
        for index in sorted(range(case.stations), key=lambda index: spans[index].start_ns):
            station, span = stations[index], spans[index]
            sent = station.reply(end_ns + span.start_ns - COMPOSE_LEAD_NS, span.max_reply_bytes)
            if rng.random() < case.loss:
                earliest_ns = end_ns + span.end_ns + TIMING.guard_ns + TIMING.reception_ns + MASTER_NS
                continue
            done_ns = end_ns + span.start_ns + TIMING.airtime_ns(REPLY_BYTES[len(sent)]) + TIMING.reception_ns
            earliest_ns = done_ns + MASTER_NS
            station.taken(sent, end_ns + span.start_ns)
            lock.reply_received(index)
            for time_ns in sent:
                lock.add_measurement(index, time_ns // 1000)
                ages.append(1e-6 * (done_ns - time_ns))
    return np.array(ages), 1e-6 * float(np.mean(np.diff(starts)))


def described(results: list[tuple[FloatArray, float]]) -> str:
    """Return frame, p50, mean and p99, averaged over the seeds."""
    figures = [(frame, np.median(ages), ages.mean(), np.quantile(ages, 0.99)) for ages, frame in results]
    return " ".join(f"{figure:6.0f}" for figure in np.mean(figures, axis=0))


def main() -> None:
    """Print the table."""
    print("stations loss  Hz latency jitter | free: frame p50 mean p99    | locked: frame p50 mean p99")
    for case in CASES:
        free, locked = ([run(case, seed, locked=locked) for seed in range(SEEDS)] for locked in (False, True))
        medians = np.array([np.median(ages) for ages, _ in locked])
        print(
            f"{case.stations:4} {case.loss:8.2f} {case.rate_hz:4.1f} {case.latency_ms:5.0f} {case.jitter_ms:6.0f}   "
            f"| {described(free)} | {described(locked)} | p50 {np.quantile(medians, 0.1):.0f} to "
            f"{np.quantile(medians, 0.9):.0f} in 8 of 10 seeds, {np.mean(medians <= 150):.0%} within 150 ms",
            flush=True,
        )
