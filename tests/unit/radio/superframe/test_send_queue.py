"""A station's send queue, and how far a master has acknowledged it."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

import pytest
from harness.radio.scripted_master import local_ns, queued
from hypothesis import given, settings
from hypothesis import strategies as st

from tsgt.radio.superframe import SendQueue, send_queue
from tsgt.radio.superframe.receive_window import ReceiveWindow
from tsgt.radio.superframe.send_queue import UNLIMITED_REACH, DeliveryProgress, PendingRange
from tsgt.radio.superframe.wire import RESTART_SKIP, JoinRequest

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tsgt.radio.superframe import QueuedMeasurement


START = 7 + RESTART_SKIP
"""Of a run after one whose last number was 6."""


def of(numbers: Iterable[int], *, first_sequence: int = 0, backlog: Iterable[int] = ()) -> SendQueue:
    """Return a queue with these numbers."""
    box = SendQueue(first_sequence, [queued(number, number) for number in backlog])
    for number in numbers:
        box.add(queued(number, number))
    return box


def everything(_: str) -> tuple[float, float]:
    """Return a reach without limits."""
    return UNLIMITED_REACH


def left(box: SendQueue) -> list[int]:
    """Return the queued numbers, newest first."""
    return [each.sequence for each in box.newest_first()]


def test_newest_first_order() -> None:
    """The backlog of earlier runs comes last."""
    box = of([1007, 1008], first_sequence=1007, backlog=[3, 5])
    assert left(box) == [1008, 1007, 5, 3]
    assert (len(box), box.oldest) == (4, 3)


def test_removal() -> None:
    """Of single numbers, queued or not, and of all up to one."""
    box = of(range(10))
    box.remove([2, 9, 77])
    box.remove_through(4)
    assert left(box) == [8, 7, 6, 5]
    box.remove_through(100)
    assert (len(box), box.oldest) == (0, 10)
    assert of([], first_sequence=40).oldest == 40


def test_sequence_numbers_ascend() -> None:
    """A lower number would be another measurement."""
    box = of([1, 2])
    with pytest.raises(ValueError, match="measurement 2 comes after 2"):
        box.add(queued(2, 2))


def test_full_queue_drops_oldest(monkeypatch: pytest.MonkeyPatch) -> None:
    """The queue remembers the dropped number."""
    monkeypatch.setattr(send_queue, "QUEUE_CAPACITY", 3)
    box = of(range(5))
    assert (left(box), box.dropped_through) == ([4, 3, 2], 1)


def test_long_backlog_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    """Like that of a full queue: the newest stay."""
    monkeypatch.setattr(send_queue, "QUEUE_CAPACITY", 3)
    box = of([], first_sequence=9, backlog=[0, 1, 4, 5, 6])
    assert (left(box), box.oldest, box.dropped_through) == ([6, 5, 4], 4, 1)


@pytest.mark.parametrize(
    ("numbers", "first_sequence", "backlog", "expected"),
    [
        ([], 0, [], PendingRange(0, ())),
        ([0, 1, 2], 0, [], PendingRange(0, ())),
        ([1, 2, 5], 0, [], PendingRange(1, ((3, 4),))),
        ([1, 3, 9], 0, [], PendingRange(1, ((2, 2), (4, 8)))),
        # Numbers that the restart has left out are known to be missing, those beyond are not.
        ([START], START, [6], PendingRange(6, ())),
        ([START], START, [5], PendingRange(5, ((6, 6),))),
        ([], START, [5], PendingRange(5, ((6, 6),))),
        ([START + 2], START, [5], PendingRange(5, ((6, 6), (START, START + 1)))),
        ([START + 2], START, [6], PendingRange(6, ((START, START + 1),))),
    ],
)
def test_pending_range(
    numbers: list[int], first_sequence: int, backlog: list[int], expected: PendingRange
) -> None:
    """Oldest number, and gaps above it."""
    assert of(numbers, first_sequence=first_sequence, backlog=backlog).pending_range(everything) == expected


@given(st.data())
def test_search_by_runs_finds_what_a_search_of_all_finds(data: st.DataObject) -> None:
    """For any queue, whatever has been removed from it, and whatever is within reach."""
    boots = data.draw(st.lists(st.integers(0, 12), max_size=4), label="measurements per boot")
    sequence, backlog = 0, []
    for boot, count in enumerate(boots):
        for _ in range(count):
            sequence += data.draw(st.sampled_from([1, 1, 1, 4]), label="step")
            backlog.append(queued(sequence, sequence, boot=str(boot)))
    box = SendQueue(sequence + RESTART_SKIP + 1, backlog)
    times = st.sampled_from([-inf, inf]) | st.integers(0, 80).map(local_ns)
    reaches = {str(boot): data.draw(st.tuples(times, times), label="reach") for boot in range(len(boots))}

    def is_within(each: QueuedMeasurement) -> bool:
        first_ns, last_ns = reaches[each.boot]
        return first_ns <= each.at_ns <= last_ns

    for _ in range(data.draw(st.integers(0, 5), label="steps")):
        if data.draw(st.booleans(), label="single numbers"):
            gone = data.draw(st.sets(st.integers(0, 60)), label="removed")
            box.remove(gone)
        else:
            through = data.draw(st.integers(0, 60), label="removed through")
            box.remove_through(through)
            gone = set(range(through + 1))
        backlog = [each for each in backlog if each.sequence not in gone]
        assert list(box.oldest_first()) == backlog
        assert list(box.newest_first()) == backlog[::-1]
        assert (len(box), box.oldest) == (len(backlog), min([e.sequence for e in backlog] or [box._next]))
        expected = [each for each in backlog if is_within(each)]
        assert list(box.oldest_first(reaches.__getitem__)) == expected
        assert list(box.newest_first(reaches.__getitem__)) == expected[::-1]
        pending = box.pending_range(reaches.__getitem__)
        waited_for = set(range(pending.oldest, sequence + 1))
        waited_for -= {number for first, last in pending.gaps for number in range(first, last + 1)}
        assert waited_for == {each.sequence for each in expected}
    assert box.retain(reaches.__getitem__) == len(backlog) - len(list(filter(is_within, backlog)))
    assert list(box.oldest_first()) == list(filter(is_within, backlog))


def test_cumulative_acknowledgement_is_read_conservatively() -> None:
    """Low bits mean the lowest possible number; unsent numbers are not acknowledged."""
    box = of(range(1000))
    delivery = DeliveryProgress(box, everything)
    delivery.mark_sent(range(600))
    delivery.acknowledge_through(300 % 256)
    assert box.oldest == 45  # it might be 300 too
    delivery.acknowledge_through(300 % 256)
    assert box.oldest == 45
    delivery.acknowledge_through(200)
    delivery.acknowledge_through(300 % 256)
    assert box.oldest == 301
    delivery.acknowledge_through(500 % 256)
    assert box.oldest == 501
    delivery.acknowledge_through(600 % 256)  # it has not been sent
    assert box.oldest == 501
    delivery.acknowledge_through(599 % 256)
    assert box.oldest == 600


def test_gap_blocks_cumulative_acknowledgement_until_join() -> None:
    """Nothing beyond a gap counts until the master knows of it."""
    box = of([*range(10), *range(300, 400)])
    delivery = DeliveryProgress(box, everything)
    delivery.mark_sent(range(400))
    delivery.acknowledge(range(10))
    outdated = [delivery.outdated]
    delivery.acknowledge_through(300 % 256)  # which the master says of 44, if at all
    assert box.oldest == 300
    delivery.acknowledge_through(9)
    assert box.oldest == 300
    outdated.append(delivery.outdated)
    delivery.request_join()
    assert delivery.oldest == 300
    delivery.join_acknowledged(300)
    assert [*outdated, delivery.outdated] == [True, True, False]
    delivery.acknowledge_through(350 % 256)
    assert box.oldest == 351


def test_passed_restart_needs_join_request_at_once() -> None:
    """Before later restarts are passed."""
    first, second, third = (start + n * RESTART_SKIP for n, start in enumerate((2148, 2166, 2314), 1))
    backlog = [*range(2140, 2148), *range(first, first + 18), *range(second, second + 148)]
    box = of([third], first_sequence=third, backlog=backlog)
    delivery = DeliveryProgress(box, everything)
    delivery.mark_sent([third])
    delivery.acknowledge_through(2147 % 256)
    assert box.oldest == first
    assert delivery.outdated
    delivery.request_join()
    delivery.join_acknowledged(delivery.oldest)
    for _ in range(2):  # of a master that has all of it
        delivery.acknowledge_through(third % 256)
    assert box.oldest == second
    delivery.request_join()
    delivery.join_acknowledged(delivery.oldest)
    delivery.acknowledge_through(third % 256)
    assert box.oldest > second


def test_small_gap_waits_for_others() -> None:
    """A join request takes the room of measurements."""
    box = of([*range(10), *range(20, 30), *range(40, 50)])
    delivery = DeliveryProgress(box, everything)
    delivery.mark_sent(range(50))
    delivery.acknowledge(range(10))
    assert not delivery.outdated
    delivery.acknowledge(range(20, 30))
    assert delivery.outdated


def test_dropped_measurements_are_a_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    """The master waits for them until the next join request."""
    monkeypatch.setattr(send_queue, "QUEUE_CAPACITY", 3)
    box = of(range(3))
    delivery = DeliveryProgress(box, everything)
    outdated = [delivery.outdated]
    box.add(queued(3, 3))
    outdated.append(delivery.outdated)
    delivery.request_join()
    delivery.join_acknowledged(delivery.oldest)
    assert [*outdated, delivery.outdated] == [False, True, False]


def test_discarded_measurements_are_a_gap() -> None:
    """An acknowledgement below it is not read as a number 256 higher."""
    box = of(range(1000))
    delivery = DeliveryProgress(box, everything)
    delivery.mark_sent(range(900, 1000))
    box.retain(lambda _: (local_ns(300), inf))
    delivery.request_join()
    delivery.acknowledge_through(-1 % 256)
    assert box.oldest == 300
    delivery.join_acknowledged(delivery.oldest)
    delivery.acknowledge_through(310 % 256)
    assert box.oldest == 311


def test_narrow_number_is_unambiguous() -> None:
    """For every highest number that the master may have."""
    delivery = DeliveryProgress(of(range(1000)), everything)
    assert not delivery.may_be_narrow(0, 0)
    delivery.mark_sent(range(100))
    delivery.acknowledge([50])
    assert delivery.may_be_narrow(100, 100)
    assert not delivery.may_be_narrow(200, 200)
    assert not delivery.may_be_narrow(60, 200)
    delivery.acknowledge([150])
    assert delivery.may_be_narrow(200, 200)


class Station:
    """A client that is killed, and whose disk may refuse writes."""

    def __init__(self) -> None:
        self.box = SendQueue(0)
        self._next = 0
        self._journalled = -1
        self.disk = True

    def has(self, number: int) -> bool:
        """Whether a number is journalled."""
        return number <= self._journalled

    def measure(self, count: int) -> None:
        """Add measurements, which are delivered even if the disk refuses them."""
        for _ in range(count):
            self.box.add(queued(self._next, 0))
            self._next += 1
        if self.disk:
            self._journalled = self._next - 1

    def restart(self) -> None:
        """Continue from the journal."""
        backlog = [each for each in self.box.newest_first() if each.sequence <= self._journalled]
        self._next = self._journalled + 1 + RESTART_SKIP
        self._journalled = self._next - 1
        self.box = SendQueue(self._next, backlog[::-1])


class Master:
    """A master whose disk accepts, delays or refuses writes."""

    def __init__(self, recorded: Iterable[int] = ()) -> None:
        self.window = ReceiveWindow()
        self.recorded = set(recorded)
        self._waiting: list[int] = []

    def take_join_request(self, delivery: DeliveryProgress, box: SendQueue) -> None:
        """Take an introduction."""
        self.window.join(
            JoinRequest(nonce=1, stream_id=7, first_sequence=box.first_sequence, oldest=delivery.oldest)
        )

    def receive(self, batch: Iterable[int]) -> None:
        """Receive measurements."""
        self._waiting += [number for number in batch if self.window.accept(number)]

    def settle(self, disk: str) -> None:
        """Take the result of the disk."""
        if disk == "waits":
            return
        if disk == "takes":
            self.recorded |= set(self._waiting)
            self.window.mark_written(self._waiting)
        else:
            self.window.mark_lost(self._waiting)
        self._waiting = []


class Exchange:
    """Frames of one run of the station with one master."""

    def __init__(self, station: Station, master: Master) -> None:
        self._box, self._master = station.box, master
        self._delivery = DeliveryProgress(station.box, everything)
        self._join_pending = True
        self._joined = False

    def discard(self, count: int) -> None:
        """Discard the oldest measurements."""
        left = [each.sequence for each, _ in zip(self._box.oldest_first(), range(count), strict=False)]
        self._box.remove(left)
        self._delivery.request_join()
        self._join_pending = True

    def frame(self, *, received: bool, disk: str, acknowledged: bool, cumulative: bool) -> None:
        """Send the newest; packets and acknowledgements may be lost."""
        box, master, delivery = self._box, self._master, self._delivery
        if delivery.outdated and not self._join_pending:
            delivery.request_join()
            self._join_pending = True
        batch = [each.sequence for each, _ in zip(box.newest_first(), range(12), strict=False)]
        narrow = [number for number in batch if delivery.may_be_narrow(number, max(batch))]
        delivery.mark_sent(batch)
        if received:
            if self._join_pending:
                master.take_join_request(delivery, box)
            assert [master.window.unwrap(number % 256) for number in narrow] == narrow
            master.receive(batch)
        master.settle(disk)
        self._joined = self._joined or (received and acknowledged)
        if not self._joined:
            return
        if received and acknowledged and master.window.is_written(batch):
            delivery.acknowledge(batch)
            if self._join_pending:
                delivery.join_acknowledged(delivery.oldest)
                self._join_pending = False
        if cumulative:
            delivery.acknowledge_through(master.window.cumulative % 256)


@given(st.data())
@settings(max_examples=150)
@pytest.mark.slow
def test_only_recorded_measurements_are_deleted(data: st.DataObject) -> None:
    """At any loss, restart, full disk and discarded backlog."""
    station, master = Station(), Master()
    for _ in range(data.draw(st.integers(1, 5), label="masters and runs")):
        if data.draw(st.booleans(), label="the station restarts"):
            station.restart()
        if data.draw(st.sampled_from([False, False, True]), label="the master restarts"):
            master = Master(master.recorded)
        exchange = Exchange(station, master)
        for _ in range(data.draw(st.integers(1, 6), label="stretches")):
            station.disk = data.draw(st.booleans(), label="the station's disk takes what there is")
            disk = data.draw(st.sampled_from(["takes", "waits", "refuses"]), label="the master's disk")
            received = data.draw(st.sampled_from([(True,), (False,), (True, False, False)]), label="received")
            if discarded := data.draw(st.sampled_from([0, 0, 0, 5, 60]), label="discarded"):
                exchange.discard(discarded)
            for frame in range(data.draw(st.integers(1, 12), label="frames")):
                station.measure(data.draw(st.sampled_from([0, 1, 2, 40]), label="new"))
                before = {each.sequence for each in station.box.newest_first() if station.has(each.sequence)}
                exchange.frame(
                    received=received[frame % len(received)],
                    disk=disk,
                    acknowledged=data.draw(st.booleans(), label="acknowledged"),
                    cumulative=data.draw(st.booleans(), label="cumulative"),
                )
                assert before - set(left(station.box)) <= master.recorded


def test_unjournalled_numbers_do_not_corrupt_cumulative_acknowledgement() -> None:
    """The master received them, and the restarted station skips them."""
    station, master = Station(), Master()
    first = Exchange(station, master)
    station.measure(3)
    first.frame(received=True, disk="takes", acknowledged=True, cumulative=True)
    station.disk = False
    station.measure(3)
    first.frame(received=True, disk="waits", acknowledged=False, cumulative=False)
    station.restart()
    station.disk = True
    second = Exchange(station, master)
    second.frame(received=True, disk="waits", acknowledged=True, cumulative=True)
    for _ in range(60):
        station.measure(5)
        second.frame(received=False, disk="waits", acknowledged=False, cumulative=True)
    assert len(station.box) == 300
