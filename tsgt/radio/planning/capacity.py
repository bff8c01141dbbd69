"""Capacity of a channel: update rate and age of each station's measurements, and duty cycles.

Means over a long time, from the airtimes, grants and rules of the protocols themselves. Losses are taken as independent.
A measurement's age is the time from the client's reading to the master's reception. The latency of the instrument is
extra and depends on the model: 50 to 130 ms for the simulated ones.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.airtime import TX_DONE_NS
from tsgt.radio.classic import COMMAND_BYTES, MEASUREMENT_BYTES, PING_REPLY_BYTES, TIME_REPLY_BYTES
from tsgt.radio.superframe import (
    COMPOSE_LEAD_NS,
    EXCHANGE_INTERVAL,
    MIN_GAIN,
    MIN_MARGIN_NS,
    SESSION_INTERVAL,
    demand,
    slot_sequence,
)
from tsgt.radio.superframe.wire import (
    CODE_BYTES,
    GRANT_BYTES,
    Beacon,
    SessionInfo,
    SlotOrder,
    StationEntry,
    encode_beacon,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from tsgt.radio.classic import LinkTiming
    from tsgt.radio.superframe import FrameTiming

HOST_NS = 3_400_000
"""Mean turnaround of a computer from a packet to the next one without a scheduled start, as in the simulation."""

_MIN_PROBABILITY = 1e-4  # rarer events are ignored

_PHASE_SETS = 16  # number of sets of instrument phases to average over

_WAIT_SAMPLES = 100  # number of samples of a wait that is uniform within a frame

_PRIMES = (2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrafficLoad:
    """The load of a channel.

    Attributes
    ----------
    stations
        Their number.
    rate_hz
        Measurement rate of each instrument.
    loss
        Probability that a packet is lost.
    """

    stations: int
    rate_hz: float
    loss: float = 0.0

    @property
    def period_ns(self) -> float:
        """Measurement interval of an instrument."""
        return 1e9 / self.rate_hz

    @property
    def exchange_success(self) -> float:
        """Probability that a packet and its reply are both received."""
        return (1 - self.loss) ** 2


@dataclass(frozen=True, slots=True, kw_only=True)
class CycleEstimate:
    """Predicted performance of a protocol.

    Attributes
    ----------
    cycle_ms
        From a station's turn to its next.
    rate_hz
        New measurements received from each station.
    age_p50_ms, age_p99_ms
        Median and 99th percentile of the age of those that arrive live.
    master_duty, station_duty
        Duty cycle of the master, and of each station.
    """

    cycle_ms: float
    rate_hz: float
    age_p50_ms: float
    age_p99_ms: float
    master_duty: float
    station_duty: float


def classic_cycle(
    load: TrafficLoad,
    timing: LinkTiming,
    *,
    resync_cycles: int,
    resync_interval_ns: int,
) -> CycleEstimate:
    """Predict the paper's protocol, long after the first synchronisation.

    ``resync_cycles``, ``resync_interval_ns``: cycles of a station's resynchronisation, and the interval between two.
    """
    success = load.exchange_success
    request_ns = timing.airtime_ns(COMMAND_BYTES)

    def exchange_ns(reply_bytes: int) -> float:
        """Return the mean duration of a request with its reply or its timeout."""
        replied_ns = timing.airtime_ns(reply_bytes) + 2 * timing.rx_done_ns + HOST_NS
        missed_ns = TX_DONE_NS + timing.timeout_ns(reply_bytes)
        return request_ns + success * replied_ns + (1 - success) * missed_ns + HOST_NS

    cycle_ns = load.stations * exchange_ns(MEASUREMENT_BYTES)
    once_ns = 3 * (request_ns + HOST_NS)  # one p, two c
    resync_ns = once_ns + resync_cycles * (exchange_ns(PING_REPLY_BYTES) + exchange_ns(TIME_REPLY_BYTES))
    polling = max(1 - load.stations * resync_ns / resync_interval_ns, 0.0)
    # A measurement is lost when the next one is made before a poll succeeds.
    polls = load.period_ns / cycle_ns
    delivered = success * polls if polls < 1 else 1 - (1 - success) ** polls
    wait_ns = min(cycle_ns, load.period_ns)
    transport_ns = HOST_NS + timing.airtime_ns(MEASUREMENT_BYTES) + timing.rx_done_ns
    return CycleEstimate(
        cycle_ms=cycle_ns / 1e6,
        rate_hz=polling * delivered * load.rate_hz,
        age_p50_ms=(0.50 * wait_ns + transport_ns) / 1e6,
        age_p99_ms=(0.99 * wait_ns + transport_ns) / 1e6,
        master_duty=load.stations * request_ns / cycle_ns,
        station_duty=(1 - load.loss) * timing.airtime_ns(MEASUREMENT_BYTES) / cycle_ns,
    )


def superframe_cycle(load: TrafficLoad, timing: FrameTiming, *, phase_lock: bool = True) -> CycleEstimate:
    """Predict the superframe; with ``phase_lock`` frames follow the instruments."""
    beacon_ns = _beacon_ns(load.stations, timing)
    # The master waits for a missing reply until it can no longer arrive.
    missing = 1 - load.exchange_success**load.stations
    around_ns = beacon_ns + timing.turnaround_ns + timing.reception_ns + HOST_NS
    around_ns += missing * (timing.guard_ns + timing.tolerance_ns)
    fixed_ns = around_ns + (load.stations - 1) * timing.guard_ns
    # Longer frames carry more measurements each, hence longer slots. The last slot ends with its reply.
    frame_ns, needed_ns = 0.0, fixed_ns
    while needed_ns > frame_ns + 1e3:
        frame_ns = needed_ns
        slot = _slot(load, timing, frame_ns / load.period_ns)
        needed_ns = fixed_ns + (load.stations - 1) * slot.granted_ns + slot.sent_ns
    waits = [_Waits(frame_ns, tuple(frame_ns * (k + 0.5) / _WAIT_SAMPLES for k in range(_WAIT_SAMPLES)))]
    if phase_lock:
        frame = _Frame(
            duration_ns=frame_ns,
            sigma_ns=math.sqrt(load.stations) * slot.granted_sigma_ns,
            first_ns=beacon_ns + timing.turnaround_ns,
            step_ns=slot.granted_ns + timing.guard_ns,
        )
        waits = [_locked(load, frame, phases) or waits[0] for phases in _phases(load.stations)]
    cycle_ns = len(waits) / sum(1 / each.cycle_ns for each in waits)
    transport_ns = COMPOSE_LEAD_NS + slot.carrying_ns + timing.reception_ns
    p50_ns, p99_ns = _quantiles(waits, load.exchange_success)
    return CycleEstimate(
        cycle_ms=cycle_ns / 1e6,
        rate_hz=min(load.rate_hz, slot.max_measurements * load.exchange_success / cycle_ns * 1e9),
        age_p50_ms=(p50_ns + transport_ns) / 1e6,
        age_p99_ms=(p99_ns + transport_ns) / 1e6,
        master_duty=beacon_ns / cycle_ns,
        station_duty=(1 - load.loss) * slot.sent_ns / cycle_ns,
    )


class _Frame(NamedTuple):
    """Duration of a frame and its sigma; start of its first slot, and the interval between slots."""

    duration_ns: float
    sigma_ns: float
    first_ns: float
    step_ns: float


class _Slot(NamedTuple):
    """Means over a station's slots; ``carrying_ns``: airtime of a measurement's reply, by measurements."""

    granted_ns: float
    granted_sigma_ns: float
    sent_ns: float
    carrying_ns: float
    max_measurements: int


def _slot(load: TrafficLoad, timing: FrameTiming, per_frame: float) -> _Slot:
    granted_ns = squared = sent_ns = carrying_ns = carried = 0.0
    failed = 1 - load.exchange_success
    cap = demand.max_grant(timing, load.stations)
    for silent in range(100):
        # The instrument's phase decides how many measurements were made since the last received reply.
        expected = (silent + 1) * per_frame
        for count, share in ((int(expected), 1 - expected % 1), (int(expected) + 1, expected % 1)):
            for extended, part in ((False, 1 - 1 / EXCHANGE_INTERVAL), (True, 1 / EXCHANGE_INTERVAL)):
                weight = (1 - failed) * failed**silent * share * part
                # A reply carries no more; the lengths of replies are cached, and after many silent frames counts are large.
                sendable = min(count, demand.MAX_MEASUREMENTS)
                predicted = demand.Demand(max(sendable, 1), extended=extended)
                longest = GRANT_BYTES[demand.grant(predicted, cap=cap, silent_frames=silent)]
                sent = min(demand.demand_bytes(replace(predicted, measurements=sendable)), longest)
                granted_ns += weight * timing.airtime_ns(longest)
                squared += weight * timing.airtime_ns(longest) ** 2
                sent_ns += weight * timing.airtime_ns(sent)
                carrying_ns += weight * count * timing.airtime_ns(sent)
                carried += weight * count
        if failed ** (silent + 1) < _MIN_PROBABILITY:
            break
    counts = range(1, demand.MAX_MEASUREMENTS + 1)
    most = max(count for count in counts if demand.demand_bytes(demand.Demand(count)) <= GRANT_BYTES[cap])
    sigma_ns = math.sqrt(max(squared - granted_ns**2, 0.0))
    return _Slot(granted_ns, sigma_ns, sent_ns, carrying_ns / carried, most)


def _beacon_ns(stations: int, timing: FrameTiming) -> float:
    """Return the mean airtime of a beacon."""
    plain = Beacon(
        frame=0,
        sent=0,
        cumulative=0,
        slot_order=SlotOrder(),
        stations=(StationEntry(ack_bitmap=0, grant=0),) * stations,
    )
    session = SessionInfo(nonce=0, counter_high=0, sent_high=0, guard=0, turnaround=0)
    plain_ns, long_ns = (
        timing.airtime_ns(len(encode_beacon(beacon)) + CODE_BYTES)
        for beacon in (plain, replace(plain, session=session))
    )
    return plain_ns + (long_ns - plain_ns) / SESSION_INTERVAL


class _Waits(NamedTuple):
    """Waits of measurements until a reply is composed, equally likely; and the mean cycle."""

    cycle_ns: float
    waits_ns: tuple[float, ...]


def _phases(stations: int) -> Iterator[list[float]]:
    """Yield evenly distributed phases as fractions of a period: multiples of irrational numbers (Weyl sequence)."""
    for k in range(1, _PHASE_SETS + 1):
        yield [k * math.sqrt(prime) % 1 for prime in _PRIMES[:stations]]


def _locked(load: TrafficLoad, frame: _Frame, phases: Sequence[float]) -> _Waits | None:
    """Return the waits in frames that ``PhaseLock`` chooses, phases as fractions of a period; None: no gain."""
    period_ns = load.period_ns
    periods = max(math.ceil(frame.duration_ns / period_ns), 1)
    pause_ns = periods * period_ns - frame.duration_ns
    best: list[float] = []
    for order in _orders(load.stations):
        slots_ns = [-phase * period_ns for phase in phases]
        for place, station in enumerate(slot_sequence(load.stations, order)):
            slots_ns[station] += frame.first_ns + place * frame.step_ns
        for reference_ns in slots_ns:
            waits = [(slot_ns - reference_ns) % period_ns for slot_ns in slots_ns]
            if not best or sum(waits) < sum(best):
                best = waits
    # Longer frames delay the following ones: Kingman's bound for a queue that is served in the pauses.
    delay_ns = frame.sigma_ns**2 / (2 * pause_ns) if pause_ns else math.inf
    gain_ns = period_ns / 2 - MIN_MARGIN_NS - sum(best) / load.stations - delay_ns
    if gain_ns < (pause_ns / 2 if periods == 1 else pause_ns) + MIN_GAIN * period_ns:
        return None
    # The period holds as many whole frames as fit.
    frames = max(int(period_ns / frame.duration_ns), 1)
    waits_ns = tuple(
        min((wait_ns + k * frame.duration_ns) % period_ns for k in range(frames))
        + MIN_MARGIN_NS
        + delay_ns
        + later * period_ns
        for wait_ns in best
        for later in range(periods)
    )
    return _Waits(periods * period_ns / frames, waits_ns)


def _orders(stations: int) -> list[SlotOrder]:
    return [SlotOrder(first, reverse) for first in range(stations) for reverse in (False, True)]


def _quantiles(frames_waits: Sequence[_Waits], success: float) -> tuple[float, float]:
    """Return median and 99th percentile of the waits, extended by whole frames until a reply is received."""
    weighted = []
    # Frames that are not locked have the same waits at all phases: at a high loss these are long lists.
    for waits, sets in Counter(frames_waits).items():
        for frames in range(1000):
            share = sets * success * (1 - success) ** frames / len(waits.waits_ns)
            weighted += [(wait_ns + frames * waits.cycle_ns, share) for wait_ns in waits.waits_ns]
            if (1 - success) ** (frames + 1) < _MIN_PROBABILITY:
                break
    weighted.sort()
    total = sum(share for _, share in weighted)
    found = []
    for quantile in (0.5, 0.99):
        below = 0.0
        for value_ns, share in weighted:
            below += share
            if below >= quantile * total:
                found.append(value_ns)
                break
    return found[0], found[1]
