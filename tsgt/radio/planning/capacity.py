"""What a channel carries: how often each station gets through, how old its data is, how long everybody transmits.

Means over a long run, from the same times on air, grants and rules that the two protocols are made of. Losses are taken
as independent of each other. A measurement's age is the time from when the client has it to when the master has received
it. What an instrument needs until a measurement can be read comes on top, and differs from one to the next: 50 to 130 ms
for the simulated ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.classic import COMMAND_BYTES, MEASUREMENT_BYTES, PING_REPLY_BYTES, TIME_REPLY_BYTES
from tsgt.radio.superframe import (
    COMPOSED_NS,
    EXCHANGE_EVERY,
    LEAST_MARGIN_NS,
    SESSION_EVERY,
    WORTH,
    grants,
    slot_sequence,
)
from tsgt.radio.superframe.wire import (
    CODE_BYTES,
    GRANT_BYTES,
    Beacon,
    SessionPart,
    SlotOrder,
    StationEntry,
    encode_beacon,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from tsgt.radio.classic import Timing
    from tsgt.radio.superframe import FrameTiming

HOST_NS = 3_400_000
"""What a computer takes from a packet to what it sends next, on average, where it is not told when to send: that of
the simulation."""

_ENOUGH = 1e-4
"""Less likely than this is not counted."""

_PHASES = 16
"""So many sets of instruments' phases are tried."""

_EVEN = 100
"""Of waits that are anything up to a frame, so many are taken."""

_PRIMES = (2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53)


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """What is to be carried.

    Attributes
    ----------
    stations
        How many.
    rate_hz
        How often each instrument measures.
    loss
        Probability that a radio does not hear a packet.
    """

    stations: int
    rate_hz: float
    loss: float = 0.0

    @property
    def period_ns(self) -> float:
        """From one measurement of an instrument to its next."""
        return 1e9 / self.rate_hz

    @property
    def heard_both_ways(self) -> float:
        """Probability that a packet and its answer are both heard."""
        return (1 - self.loss) ** 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Cycle:
    """What comes of it.

    Attributes
    ----------
    cycle_ms
        From a station's turn to its next.
    rate_hz
        Different measurements of each station that arrive.
    age_p50_ms, age_p99_ms
        How old half of them, and all but one in a hundred, are at most when they arrive, counted from when the client
        had them; of those that arrive live.
    master_duty, station_duty
        For what part of the time the master transmits, and each station.
    """

    cycle_ms: float
    rate_hz: float
    age_p50_ms: float
    age_p99_ms: float
    master_duty: float
    station_duty: float


def classic_cycle(
    load: Load, timing: Timing, *, resync_cycles: int, resync_interval_ns: int, host_ns: int = HOST_NS
) -> Cycle:
    """Compute what the paper's protocol carries, long after the first synchronisation.

    Parameters
    ----------
    load
        What it is to carry.
    timing
        Of its packets.
    resync_cycles, resync_interval_ns
        Of each later synchronisation of a station, and from one to the next.
    host_ns
        What each computer takes for an answer.
    """
    heard = load.heard_both_ways
    request_ns = timing.airtime_ns(COMMAND_BYTES)

    def exchange_ns(reply_bytes: int) -> float:
        """Mean time that a request and its reply take, or the wait for it."""
        answered_ns = timing.airtime_ns(reply_bytes) + 2 * timing.rx_done_ns + host_ns
        unanswered_ns = timing.tx_done_ns + timing.timeout_ns(reply_bytes)
        return request_ns + heard * answered_ns + (1 - heard) * unanswered_ns + host_ns

    cycle_ns = load.stations * exchange_ns(MEASUREMENT_BYTES)
    once_ns = 3 * (request_ns + host_ns)  # one p, two c
    resync_ns = once_ns + resync_cycles * (exchange_ns(PING_REPLY_BYTES) + exchange_ns(TIME_REPLY_BYTES))
    polling = max(1 - load.stations * resync_ns / resync_interval_ns, 0.0)
    # A measurement is lost when the next one is there before a poll got through.
    polls = load.period_ns / cycle_ns
    caught = heard * polls if polls < 1 else 1 - (1 - heard) ** polls
    wait_ns = min(cycle_ns, load.period_ns)
    transport_ns = host_ns + timing.airtime_ns(MEASUREMENT_BYTES) + timing.rx_done_ns
    return Cycle(
        cycle_ms=cycle_ns / 1e6,
        rate_hz=polling * caught * load.rate_hz,
        age_p50_ms=(0.50 * wait_ns + transport_ns) / 1e6,
        age_p99_ms=(0.99 * wait_ns + transport_ns) / 1e6,
        master_duty=load.stations * request_ns / cycle_ns,
        station_duty=(1 - load.loss) * timing.airtime_ns(MEASUREMENT_BYTES) / cycle_ns,
    )


def superframe_cycle(load: Load, timing: FrameTiming, *, phase_lock: bool = True) -> Cycle:
    """Compute what the superframe carries.

    Parameters
    ----------
    load
        What it is to carry.
    timing
        Of its frames.
    phase_lock
        Frames follow the instruments.
    """
    beacon_ns = _beacon_ns(load.stations, timing)
    # A reply that does not come is waited for until it could not come any more.
    missing = 1 - load.heard_both_ways**load.stations
    around_ns = beacon_ns + timing.turn_round_ns + timing.reception_ns + HOST_NS
    around_ns += missing * (timing.guard_ns + timing.tolerance_ns)
    fixed_ns = around_ns + (load.stations - 1) * timing.guard_ns
    # Longer frames bring more measurements each, and so longer slots. The last one is over when its reply is there.
    frame_ns, needed_ns = 0.0, fixed_ns
    while needed_ns > frame_ns + 1e3:
        frame_ns = needed_ns
        slot = _slot(load, timing, frame_ns / load.period_ns)
        needed_ns = fixed_ns + (load.stations - 1) * slot.granted_ns + slot.sent_ns
    waits = [_Waits(frame_ns, [frame_ns * (k + 0.5) / _EVEN for k in range(_EVEN)])]
    if phase_lock:
        frame = _Frame(
            needs_ns=frame_ns,
            spread_ns=math.sqrt(load.stations) * slot.granted_sigma_ns,
            first_ns=beacon_ns + timing.turn_round_ns,
            step_ns=slot.granted_ns + timing.guard_ns,
        )
        waits = [_locked(load, frame, phases) or waits[0] for phases in _phases(load.stations)]
    cycle_ns = len(waits) / sum(1 / each.cycle_ns for each in waits)
    transport_ns = COMPOSED_NS + slot.carrying_ns + timing.reception_ns
    p50_ns, p99_ns = _quantiles(waits, load.heard_both_ways)
    return Cycle(
        cycle_ms=cycle_ns / 1e6,
        rate_hz=min(load.rate_hz, slot.most * load.heard_both_ways / cycle_ns * 1e9),
        age_p50_ms=(p50_ns + transport_ns) / 1e6,
        age_p99_ms=(p99_ns + transport_ns) / 1e6,
        master_duty=beacon_ns / cycle_ns,
        station_duty=(1 - load.loss) * slot.sent_ns / cycle_ns,
    )


class _Frame(NamedTuple):
    """How long a frame needs and by how much that varies; when its first slot begins, and from one to the next."""

    needs_ns: float
    spread_ns: float
    first_ns: float
    step_ns: float


class _Slot(NamedTuple):
    """Means over a station's slots, and the limit.

    Attributes
    ----------
    granted_ns, granted_sigma_ns
        How long a slot is, and by how much that varies.
    sent_ns
        How long a reply is.
    carrying_ns
        How long a reply that a measurement comes with.
    most
        How many measurements fit.
    """

    granted_ns: float
    granted_sigma_ns: float
    sent_ns: float
    carrying_ns: float
    most: int


def _slot(load: Load, timing: FrameTiming, per_frame: float) -> _Slot:
    granted_ns = squared = sent_ns = carrying_ns = carried = 0.0
    cap = grants.longest_grant(timing, load.stations)
    failed = 1 - load.heard_both_ways
    cap = grants.longest_grant(timing, load.stations)
    for silent in range(100):
        # The instrument's phase decides how many measurements have come since the last reply that was heard.
        many = (silent + 1) * per_frame
        for count, share in ((int(many), 1 - many % 1), (int(many) + 1, many % 1)):
            for extended, part in ((False, 1 - 1 / EXCHANGE_EVERY), (True, 1 / EXCHANGE_EVERY)):
                weight = (1 - failed) * failed**silent * share * part
                demand = grants.Demand(max(count, 1), extended=extended)
                longest = GRANT_BYTES[grants.grant(demand, cap=cap, silent=silent)]
                sent = min(grants.demand_bytes(replace(demand, measurements=count)), longest)
                granted_ns += weight * timing.airtime_ns(longest)
                squared += weight * timing.airtime_ns(longest) ** 2
                sent_ns += weight * timing.airtime_ns(sent)
                carrying_ns += weight * count * timing.airtime_ns(sent)
                carried += weight * count
        if failed ** (silent + 1) < _ENOUGH:
            break
    counts = range(1, grants.MOST_MEASUREMENTS + 1)
    most = max(count for count in counts if grants.demand_bytes(grants.Demand(count)) <= GRANT_BYTES[cap])
    sigma_ns = math.sqrt(max(squared - granted_ns**2, 0.0))
    return _Slot(granted_ns, sigma_ns, sent_ns, carrying_ns / carried, most)


def _beacon_ns(stations: int, timing: FrameTiming) -> float:
    """Mean time that a beacon is on the air."""
    plain = Beacon(
        frame=0,
        sent=0,
        cumulative=0,
        order=SlotOrder(),
        stations=(StationEntry(history=0, grant=0),) * stations,
    )
    session = SessionPart(nonce=0, counter_high=0, sent_high=0, guard=0, turn_round=0)
    plain_ns, long_ns = (
        timing.airtime_ns(len(encode_beacon(beacon)) + CODE_BYTES)
        for beacon in (plain, replace(plain, session=session))
    )
    return plain_ns + (long_ns - plain_ns) / SESSION_EVERY


class _Waits(NamedTuple):
    """How long measurements wait until a reply is composed, each as likely as the other; and the mean cycle."""

    cycle_ns: float
    waits_ns: Sequence[float]


def _phases(stations: int) -> Iterator[list[float]]:
    """Spread phases evenly, in parts of a period: multiples of numbers whose multiples never meet."""
    for k in range(1, _PHASES + 1):
        yield [k * math.sqrt(prime) % 1 for prime in _PRIMES[:stations]]


def _locked(load: Load, frame: _Frame, phases: Sequence[float]) -> _Waits | None:
    """Return the waits in frames that follow instruments with these phases; None where that gains nothing.

    :class:`~tsgt.radio.superframe.phase_lock.FrameLock` chooses alike: whose measurement is met as soon as it is ready, and in
    which order the others answer.

    Parameters
    ----------
    load
        The stations.
    frame
        What a frame needs.
    phases
        When the instruments measure, by station, in parts of a period.
    """
    period_ns = load.period_ns
    beats = max(math.ceil(frame.needs_ns / period_ns), 1)
    pause_ns = beats * period_ns - frame.needs_ns
    best: list[float] = []
    for order in _orders(load.stations):
        slots_ns = [-phase * period_ns for phase in phases]
        for place, station in enumerate(slot_sequence(load.stations, order)):
            slots_ns[station] += frame.first_ns + place * frame.step_ns
        for leader_ns in slots_ns:
            tried = [(slot_ns - leader_ns) % period_ns for slot_ns in slots_ns]
            if not best or sum(tried) < sum(best):
                best = tried
    # Frames that take longer make those after them late: a queue that is served in the pauses.
    late_ns = frame.spread_ns**2 / (2 * pause_ns) if pause_ns else math.inf
    gain_ns = period_ns / 2 - LEAST_MARGIN_NS - sum(best) / load.stations - late_ns
    if gain_ns < (pause_ns / 2 if beats == 1 else pause_ns) + WORTH * period_ns:
        return None
    # Whole frames that fit in are run.
    frames = max(int(period_ns / frame.needs_ns), 1)
    waits_ns = [
        min((wait_ns + k * frame.needs_ns) % period_ns for k in range(frames))
        + LEAST_MARGIN_NS
        + late_ns
        + beat * period_ns
        for wait_ns in best
        for beat in range(beats)
    ]
    return _Waits(beats * period_ns / frames, waits_ns)


def _orders(stations: int) -> list[SlotOrder]:
    return [SlotOrder(first, reverse) for first in range(stations) for reverse in (False, True)]


def _quantiles(many: Sequence[_Waits], heard: float) -> tuple[float, float]:
    """Return median and 99th percentile of waits to which frames are added until one is heard."""
    weighted = []
    for waits in many:
        for frames in range(1000):
            share = heard * (1 - heard) ** frames / len(waits.waits_ns)
            weighted += [(wait_ns + frames * waits.cycle_ns, share) for wait_ns in waits.waits_ns]
            if (1 - heard) ** (frames + 1) < _ENOUGH:
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
