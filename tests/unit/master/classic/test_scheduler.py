"""The scheduler on a model of the channel, without radio and clock."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import pytest
from harness.hardware.radios import PAPER

from tsgt.master.classic.scheduler import (
    ScheduledTransaction,
    Scheduler,
    StationPlan,
    SynchronisationSchedule,
)
from tsgt.model import ClockSample
from tsgt.radio.classic import CommandTransaction, LinkTiming, Poll, Synchronisation
from tsgt.radio.classic.messages import no_measurement_yet

MS = 1_000_000
SECOND = 1000 * MS
TIMING = LinkTiming(PAPER, 250 * MS)
SAMPLE = ClockSample(sent_ns=0, station_ns=1, received_ns=2, forward_ns=0, back_ns=0)

# Durations at the paper's settings: a poll that is answered and one that is not, a cycle, what is around the cycles.
POLL_NS, TIMEOUT_NS, CYCLE_NS, FRAME_NS = 195 * MS, 304 * MS, 245 * MS, 162 * MS

PAPERS = SynchronisationSchedule(initial_cycles=50, resync_cycles=5, interval_ns=300 * SECOND)


@dataclass
class Channel:
    """Executes transactions: stations respond, are dead, refuse commands, give no samples, or are inconclusive."""

    schedule: SynchronisationSchedule = PAPERS
    stations: int = 3
    now_ns: int = 0
    dead: set[int] = field(default_factory=set)
    refusing: set[int] = field(default_factory=set)
    stampless: set[int] = field(default_factory=set)
    inconclusive: set[int] = field(default_factory=set)
    transactions: list[tuple[int, ScheduledTransaction]] = field(default_factory=list)
    spent_ns: Counter[int] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.scheduler = Scheduler(
            [StationPlan(station=n, prism=n + 3) for n in range(1, self.stations + 1)],
            self.schedule,
            TIMING,
            self.now_ns,
        )

    def run(self, until_s: float) -> None:
        """Run transactions until an instant."""
        while self.now_ns < until_s * SECOND:
            transaction = self.scheduler.next(self.now_ns)
            if isinstance(transaction, int):
                assert transaction > self.now_ns
                self.now_ns = transaction
                continue
            self.transactions.append((self.now_ns, transaction))
            took_ns = self._execute(transaction)
            self.spent_ns[transaction.station] += took_ns
            self.now_ns += took_ns
            self.scheduler.finished(transaction, self.now_ns)
            if isinstance(transaction, Synchronisation) and transaction.station in self.inconclusive:
                self.scheduler.synchronisation_inconclusive(transaction.station, self.now_ns)

    def _execute(self, transaction: ScheduledTransaction) -> int:
        dead = transaction.station in self.dead
        if isinstance(transaction, CommandTransaction):
            transaction.ok = None if dead else transaction.station not in self.refusing
            return 10 * SECOND if dead else 500 * MS
        if isinstance(transaction, Poll):
            transaction.message = None if dead else no_measurement_yet(transaction.station)
            return TIMEOUT_NS if dead else POLL_NS
        transaction.has_reply = not dead
        if dead:
            return FRAME_NS + 3 * TIMEOUT_NS
        if transaction.station in self.stampless:
            return FRAME_NS + 2 * transaction._cycles * CYCLE_NS
        transaction.samples = [SAMPLE] * transaction._cycles
        return FRAME_NS + transaction._cycles * CYCLE_NS

    def of(self, kind: type[Any], *, since_s: float = 0) -> list[tuple[int, Any]]:
        """Return transactions of a kind with their instants."""
        return [
            (at, transaction)
            for at, transaction in self.transactions
            if isinstance(transaction, kind) and at >= since_s * SECOND
        ]

    def rate_hz(self, station: int, since_s: float) -> float:
        """How often a station was polled with success."""
        polls = [
            transaction
            for _, transaction in self.of(Poll, since_s=since_s)
            if transaction.station == station and transaction.has_reply
        ]
        return len(polls) / (self.now_ns / SECOND - since_s)


def test_stations_are_commanded_synchronised_and_polled() -> None:
    """All are synchronised before the first poll."""
    channel = Channel()
    channel.run(60)
    kinds = [(type(transaction), transaction.station) for _, transaction in channel.transactions[:9]]
    assert kinds == [(kind, n) for kind in (CommandTransaction, Synchronisation, Poll) for n in (1, 2, 3)]
    assert channel.of(CommandTransaction)[0][1]._command.to_bytes() == b"n14"
    assert [transaction._cycles for _, transaction in channel.of(Synchronisation)[:3]] == [50, 50, 50]


def test_three_stations_get_the_channel_capacity() -> None:
    """Round robin; synchronisations take less than a twentieth of the time."""
    channel = Channel()
    channel.run(700)
    for station in (1, 2, 3):
        assert channel.rate_hz(station, 100) == pytest.approx(SECOND / POLL_NS / 3, rel=0.05)
    assert all(
        transaction.station == place % 3 + 1 for place, (_, transaction) in enumerate(channel.transactions)
    )


def test_synchronisations_are_staggered_evenly() -> None:
    """After the first minutes each station has its own every 300 s, 100 s after the one before it."""
    channel = Channel()
    channel.run(3000)
    later = [(at, transaction.station) for at, transaction in channel.of(Synchronisation, since_s=700)]
    assert [transaction._cycles for _, transaction in channel.of(Synchronisation, since_s=100)] == [5] * len(
        channel.of(Synchronisation, since_s=100)
    )
    for (one_ns, one), (other_ns, other) in pairwise(later):
        assert (other_ns - one_ns) / SECOND == pytest.approx(100, abs=2)
        assert other == one % 3 + 1


def test_early_synchronisations_are_spaced() -> None:
    """Stations that were synchronised one after the other do not take the channel together."""
    channel = Channel(SynchronisationSchedule(initial_cycles=5, resync_cycles=5, interval_ns=300 * SECOND))
    channel.run(300)
    starts_ns = [at for at, _ in channel.of(Synchronisation, since_s=10)]
    assert min(b - a for a, b in pairwise(starts_ns)) > 5 * SECOND


def test_dead_station_gets_a_twentieth_of_the_time() -> None:
    """The others are polled more often than with it alive."""
    channel = Channel()
    channel.run(120)
    channel.dead.add(3)
    spent_ns = channel.spent_ns[3]
    channel.run(150)
    channel.run(1350)
    assert (channel.spent_ns[3] - spent_ns) / (1230 * SECOND) < 0.055
    two_alone_hz = SECOND / POLL_NS / 2
    assert channel.rate_hz(1, 150) > 0.93 * two_alone_hz
    assert channel.rate_hz(2, 150) > 0.93 * two_alone_hz


def test_absent_station_gets_a_twentieth_of_the_time() -> None:
    """Its synchronisations fail at growing intervals."""
    channel = Channel(dead={2})
    channel.run(60)
    assert not [transaction for _, transaction in channel.of(Poll) if transaction.station == 2]
    spent_ns = channel.spent_ns[2]
    channel.run(660)
    assert (channel.spent_ns[2] - spent_ns) / (600 * SECOND) < 0.055
    channel.dead.clear()
    channel.run(720)
    assert channel.rate_hz(2, 690) > 1.5
    back = [
        transaction
        for _, transaction in channel.of(Synchronisation, since_s=660)
        if transaction.station == 2 and transaction.samples
    ]
    assert back[0]._cycles == 5  # the others do not wait 12 s for it


@pytest.mark.parametrize(("outage_s", "found_s"), [(0.5, 1.0), (10, 6.0), (300, 25.0)])
def test_recovered_station_is_found_soon(outage_s: float, found_s: float) -> None:
    """In proportion to its silence; then it is part of every round."""
    channel = Channel()
    channel.run(60)
    channel.dead.add(1)
    channel.run(60 + outage_s)
    channel.dead.clear()
    channel.run(60 + outage_s + found_s)
    channel.run(90 + outage_s + found_s)
    since_s = 60 + outage_s + found_s
    assert channel.rate_hz(1, since_s) == pytest.approx(channel.rate_hz(2, since_s), rel=0.05)


def test_lost_packet_causes_no_back_off() -> None:
    """Lost packet causes no back off."""
    channel = Channel()
    channel.run(60)
    channel.dead.add(1)
    channel.run(60.5)
    channel.dead.clear()
    channel.run(70)
    assert [transaction.station for _, transaction in channel.of(Poll)[-9:]] in (
        [1, 2, 3] * 3,
        [2, 3, 1] * 3,
        [3, 1, 2] * 3,
    )


def test_failed_poll_is_repeated_once() -> None:
    """A round later the gap between two measurements would be twice as long."""
    channel = Channel()
    channel.run(60)
    channel.dead.add(2)
    channel.run(62)
    stations = [transaction.station for _, transaction in channel.of(Poll)]
    unanswered = next(
        place for place, (_, transaction) in enumerate(channel.of(Poll)) if not transaction.has_reply
    )
    assert stations[unanswered : unanswered + 4] == [2, 2, 3, 1]


def test_refusing_station_is_commanded_again_and_never_polled() -> None:
    """In direct mode a poll would be a command to measure; commands back off."""
    channel = Channel(refusing={3})
    channel.run(300)
    assert not [transaction for _, transaction in channel.of(Poll) if transaction.station == 3]
    orders_ns = [at for at, transaction in channel.of(CommandTransaction) if transaction.station == 3]
    gaps_ns = [b - a for a, b in pairwise(orders_ns[2:])]
    assert gaps_ns[-1] > 9 * SECOND
    channel.refusing.clear()
    channel.run(330)
    assert [transaction for _, transaction in channel.of(Poll) if transaction.station == 3]


def test_lost_command_after_refusals_causes_no_long_back_off() -> None:
    """Refusals cost little, a lost packet much."""
    channel = Channel(stations=1, refusing={1})
    channel.run(20)
    assert [transaction.ok for _, transaction in channel.of(CommandTransaction)[:5]] == [False] * 5
    lost = channel.scheduler.next(channel.now_ns)
    assert isinstance(lost, CommandTransaction)
    channel.scheduler.finished(lost, channel.now_ns + SECOND)
    assert isinstance(channel.scheduler.next(channel.now_ns + SECOND), Synchronisation)


def test_reset_clock_is_synchronised_first() -> None:
    """The station may have restarted, so the command to track is repeated."""
    channel = Channel()
    channel.run(90)
    channel.scheduler.resynchronise(2, channel.now_ns)
    channel.run(92)
    first, second = [transaction for at, transaction in channel.transactions if at >= 90 * SECOND][:2]
    assert isinstance(first, CommandTransaction)
    assert isinstance(second, Synchronisation)
    assert first.station == second.station == 2
    channel.run(400)
    following = [at / SECOND for at, t in channel.of(Synchronisation, since_s=91) if t.station == 2]
    assert following[0] < 190  # its skew is estimated again


def test_inconclusive_synchronisation_is_repeated_at_once() -> None:
    """Inconclusive synchronisation is repeated at once."""
    channel = Channel(inconclusive={2})
    channel.run(44)
    channel.inconclusive.clear()
    kinds = [type(transaction) for _, transaction in channel.transactions if transaction.station == 2]
    assert kinds[:4] == [CommandTransaction, Synchronisation] * 2
    channel.run(100)
    assert channel.rate_hz(2, 80) == pytest.approx(channel.rate_hz(1, 80), rel=0.1)


def share_of_2(channel: Channel) -> float:
    """Return the share of the time that station 2 takes in the quarter of an hour from the third minute on."""
    channel.run(180)
    spent_ns = channel.spent_ns[2]
    channel.run(1080)
    return (channel.spent_ns[2] - spent_ns) / (900 * SECOND)


@pytest.mark.parametrize("samples", [True, False])
def test_inconclusive_synchronisations_back_off(*, samples: bool) -> None:
    """The other stations get their share."""
    channel = Channel()
    channel.run(60)
    channel.inconclusive.add(2)
    if not samples:
        channel.stampless.add(2)
    channel.scheduler.synchronisation_inconclusive(2, channel.now_ns)
    assert share_of_2(channel) < 0.34
    channel.inconclusive.clear()
    channel.stampless.clear()
    channel.run(1200)
    assert channel.rate_hz(2, 1150) == pytest.approx(channel.rate_hz(1, 1150), rel=0.1)


def test_separate_inconclusive_synchronisations_do_not_back_off() -> None:
    """Only consecutive ones count, without a poll in between."""
    channel = Channel()
    channel.run(60)
    for until_s in range(70, 130, 10):
        before_ns = channel.now_ns
        channel.scheduler.synchronisation_inconclusive(2, before_ns)
        channel.run(until_s)
        at_once = [transaction for at, transaction in channel.transactions if at >= before_ns][:2]
        assert [(type(transaction), transaction.station) for transaction in at_once] == [
            (CommandTransaction, 2),
            (Synchronisation, 2),
        ]


def test_synchronisations_without_samples_back_off() -> None:
    """Synchronisations without samples back off."""
    channel = Channel()
    channel.run(60)
    channel.stampless.add(2)
    channel.scheduler.resynchronise(2, channel.now_ns)
    assert share_of_2(channel) < 0.34


def test_late_confirmation_is_not_attributed_to_another_station() -> None:
    """While a station may still respond, the others have to confirm twice."""
    channel = Channel(stations=2, dead={1})
    channel.run(40)
    assert (
        len([transaction for _, transaction in channel.of(CommandTransaction) if transaction.station == 2])
        == 2
    )
    assert [transaction for _, transaction in channel.of(Synchronisation) if transaction.station == 2]


def test_idle_channel_has_a_deadline() -> None:
    """When every station is backed off there is an instant to wait for."""
    channel = Channel(stations=1, dead={1})
    channel.run(600)
    assert channel.spent_ns[1] < 60 * SECOND


def test_aborted_transaction_is_repeated() -> None:
    """The radio failed within the first command."""
    channel = Channel()
    first = channel.scheduler.next(0)
    assert isinstance(first, CommandTransaction)
    channel.run(60)
    assert [transaction.station for _, transaction in channel.of(CommandTransaction)] == [2, 3, 1]
