"""The queue of a station, and how far a master has got with it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from harness.hand_master import queued
from hypothesis import given, settings
from hypothesis import strategies as st

from tsgt.radio.superframe import SendQueue
from tsgt.radio.superframe import send_queue
from tsgt.radio.superframe.receive_window import ReceiveWindow
from tsgt.radio.superframe.send_queue import DeliveryProgress, PendingRange
from tsgt.radio.superframe.wire import RESTART_SKIP, JoinRequest

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tsgt.radio.superframe import QueuedMeasurement


START = 7 + RESTART_SKIP
"""Of a run after one whose last number was 6."""


def of(numbers: Iterable[int], *, first_sequence: int = 0, backlog: Iterable[int] = ()) -> SendQueue:
    """Make an outbox with these numbers."""
    box = SendQueue(first_sequence, [queued(number, number) for number in backlog])
    for number in numbers:
        box.add(queued(number, number))
    return box


def anything(_: QueuedMeasurement) -> bool:
    """Want everything."""
    return True


def left(box: SendQueue) -> list[int]:
    """Return what is queued, newest first."""
    return [each.sequence for each in box.newest_first()]


def test_the_newest_comes_first() -> None:
    """What earlier runs have left comes after what this one has measured."""
    box = of([1007, 1008], first_sequence=1007, backlog=[3, 5])
    assert left(box) == [1008, 1007, 5, 3]
    assert (len(box), box.oldest) == (4, 3)


def test_what_is_removed_is_gone() -> None:
    """Also numbers that are not there, and everything up to one."""
    box = of(range(10))
    box.remove([2, 9, 77])
    box.remove_through(4)
    assert left(box) == [8, 7, 6, 5]
    box.remove_through(100)
    assert (len(box), box.oldest) == (0, 10)
    assert of([], first_sequence=40).oldest == 40


def test_numbers_rise() -> None:
    """A number that is not higher than those before would be taken for another measurement."""
    box = of([1, 2])
    with pytest.raises(ValueError, match="measurement 2 comes after 2"):
        box.add(queued(2, 2))


def test_the_oldest_leaves_when_there_are_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    """The queue does not grow for ever, and says what it let go."""
    monkeypatch.setattr(send_queue, "QUEUE_CAPACITY", 3)
    box = of(range(5))
    assert (left(box), box.dropped_through) == ([4, 3, 2], 1)


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
def test_what_a_master_waits_for(
    numbers: list[int], first_sequence: int, backlog: list[int], expected: PendingRange
) -> None:
    """From the oldest on, and which numbers after it never come."""
    assert of(numbers, first_sequence=first_sequence, backlog=backlog).pending_range(anything) == expected


def test_the_cumulative_number_is_the_lowest_that_it_can_be() -> None:
    """Eight bits are read from what is certain on; what has not been sent is not delivered."""
    box = of(range(1000))
    delivery = DeliveryProgress(box, anything)
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


def test_a_gap_stops_the_cumulative_number_until_the_master_knows_of_it() -> None:
    """A number that never comes holds the master up; nothing beyond is taken for delivered meanwhile."""
    box = of([*range(10), *range(300, 400)])
    delivery = DeliveryProgress(box, anything)
    delivery.mark_sent(range(400))
    delivery.acknowledge(range(10))
    told = [delivery.outdated]
    delivery.acknowledge_through(300 % 256)  # which the master says of 44, if at all
    assert box.oldest == 300
    delivery.acknowledge_through(9)
    assert box.oldest == 300
    told.append(delivery.outdated)
    delivery.request_join()
    assert delivery.oldest == 300
    delivery.join_acknowledged(300)
    assert [*told, delivery.outdated] == [True, True, False]
    delivery.acknowledge_through(350 % 256)
    assert box.oldest == 351


def test_a_restart_that_lies_behind_is_told_before_those_that_do_not() -> None:
    """What a run in between has left, and the master has, need not come again until its restart lies behind as well."""
    first, second, third = (start + n * RESTART_SKIP for n, start in enumerate((2148, 2166, 2314), 1))
    left_before = [*range(2140, 2148), *range(first, first + 18), *range(second, second + 148)]
    box = of([third], first_sequence=third, backlog=left_before)
    delivery = DeliveryProgress(box, anything)
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


def test_a_small_gap_behind_is_not_told_as_long_as_there_are_others() -> None:
    """A backlog that goes out with losses has many, and an introduction takes the room of measurements."""
    box = of([*range(10), *range(20, 30), *range(40, 50)])
    delivery = DeliveryProgress(box, anything)
    delivery.mark_sent(range(50))
    delivery.acknowledge(range(10))
    assert not delivery.outdated
    delivery.acknowledge(range(20, 30))
    assert delivery.outdated


def test_what_had_to_leave_is_a_gap_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """The master waits for it until it is told not to."""
    monkeypatch.setattr(send_queue, "QUEUE_CAPACITY", 3)
    box = of(range(3))
    delivery = DeliveryProgress(box, anything)
    told = [delivery.outdated]
    box.add(queued(3, 3))
    told.append(delivery.outdated)
    delivery.request_join()
    delivery.join_acknowledged(delivery.oldest)
    assert [*told, delivery.outdated] == [False, True, False]


def test_what_is_left_behind_is_a_gap_until_the_master_knows_of_it() -> None:
    """It waits for the first number, and what it says of that is not of one that is 256 higher."""
    box = of(range(1000))
    delivery = DeliveryProgress(box, anything)
    delivery.mark_sent(range(900, 1000))
    box.retain(lambda each: each.sequence >= 300)
    delivery.request_join()
    delivery.acknowledge_through(-1 % 256)
    assert box.oldest == 300
    delivery.join_acknowledged(delivery.oldest)
    delivery.acknowledge_through(310 % 256)
    assert box.oldest == 311


def test_a_number_is_narrow_only_if_it_can_be_nothing_else() -> None:
    """Next to anything that the master may have as its highest."""
    delivery = DeliveryProgress(of(range(1000)), anything)
    assert not delivery.may_be_narrow(0, 0)
    delivery.mark_sent(range(100))
    delivery.acknowledge([50])
    assert delivery.may_be_narrow(100, 100)
    assert not delivery.may_be_narrow(200, 200)
    assert not delivery.may_be_narrow(60, 200)
    delivery.acknowledge([150])
    assert delivery.may_be_narrow(200, 200)


class Station:
    """A client that is killed now and then, with a disk that at times takes nothing."""

    def __init__(self) -> None:
        self.box = SendQueue(0)
        self._next = 0
        self._journalled = -1
        self.disk = True

    def has(self, number: int) -> bool:
        """Whether it is in the journal."""
        return number <= self._journalled

    def measure(self, count: int) -> None:
        """Add so many measurements; what the disk does not take is delivered all the same."""
        for _ in range(count):
            self.box.add(queued(self._next, 0))
            self._next += 1
        if self.disk:
            self._journalled = self._next - 1

    def restart(self) -> None:
        """Go on from what the disk has."""
        backlog = [each for each in self.box.newest_first() if each.sequence <= self._journalled]
        self._next = self._journalled + 1 + RESTART_SKIP
        self._journalled = self._next - 1
        self.box = SendQueue(self._next, backlog[::-1])


class Master:
    """One whose disk takes what has come at once, later, or never."""

    def __init__(self, recorded: Iterable[int] = ()) -> None:
        self.window = ReceiveWindow()
        self.recorded = set(recorded)
        self._waiting: list[int] = []

    def introduced(self, delivery: DeliveryProgress, box: SendQueue) -> None:
        """Take an introduction."""
        self.window.join(
            JoinRequest(nonce=1, stream_id=7, first_sequence=box.first_sequence, oldest=delivery.oldest)
        )

    def receive(self, batch: Iterable[int]) -> None:
        """Take measurements."""
        self._waiting += [number for number in batch if self.window.accept(number)]

    def settle(self, disk: str) -> None:
        """Hear of the disk, which takes, waits or refuses."""
        if disk == "waits":
            return
        if disk == "takes":
            self.recorded |= set(self._waiting)
            self.window.mark_written(self._waiting)
        else:
            self.window.mark_lost(self._waiting)
        self._waiting = []


class Exchange:
    """Frames of one run with one master."""

    def __init__(self, station: Station, master: Master) -> None:
        self._box, self._master = station.box, master
        self._delivery = DeliveryProgress(station.box, anything)
        self._introduces = True
        self._joined = False

    def leave(self, count: int) -> None:
        """Leave so many of the oldest in the journal, undelivered."""
        left = [each.sequence for each, _ in zip(self._box.oldest_first(), range(count), strict=False)]
        self._box.remove(left)
        self._delivery.request_join()
        self._introduces = True

    def frame(self, *, heard: bool, disk: str, acknowledged: bool, cumulative: bool) -> None:
        """Send the newest; the master hears it or not, and what its next beacon says comes or not."""
        box, master, delivery = self._box, self._master, self._delivery
        if delivery.outdated and not self._introduces:
            delivery.request_join()
            self._introduces = True
        batch = [each.sequence for each, _ in zip(box.newest_first(), range(12), strict=False)]
        narrow = [number for number in batch if delivery.may_be_narrow(number, max(batch))]
        delivery.mark_sent(batch)
        if heard:
            if self._introduces:
                master.introduced(delivery, box)
            assert [master.window.unwrap(number % 256) for number in narrow] == narrow
            master.receive(batch)
        master.settle(disk)
        self._joined = self._joined or (heard and acknowledged)
        if not self._joined:
            return
        if heard and acknowledged and master.window.is_written(batch):
            delivery.acknowledge(batch)
            if self._introduces:
                delivery.join_acknowledged(delivery.oldest)
                self._introduces = False
        if cumulative:
            delivery.acknowledge_through(master.window.cumulative % 256)


@given(st.data())
@settings(max_examples=150)
def test_nothing_is_deleted_that_the_master_has_not_recorded(data: st.DataObject) -> None:
    """Whatever is lost, whoever restarts, whichever disk is full, and whatever is left behind."""
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
            heard = data.draw(st.sampled_from([(True,), (False,), (True, False, False)]), label="heard")
            if leaves := data.draw(st.sampled_from([0, 0, 0, 5, 60]), label="left behind"):
                exchange.leave(leaves)
            for frame in range(data.draw(st.integers(1, 12), label="frames")):
                station.measure(data.draw(st.sampled_from([0, 1, 2, 40]), label="new"))
                before = {each.sequence for each in station.box.newest_first() if station.has(each.sequence)}
                exchange.frame(
                    heard=heard[frame % len(heard)],
                    disk=disk,
                    acknowledged=data.draw(st.booleans(), label="acknowledged"),
                    cumulative=data.draw(st.booleans(), label="cumulative"),
                )
                assert before - set(left(station.box)) <= master.recorded


def test_numbers_on_the_air_but_on_no_disk_before_a_restart_do_not_spoil_the_cumulative_number() -> None:
    """The master has some that it cannot write, and the station takes them for settled."""
    station, master = Station(), Master()
    first = Exchange(station, master)
    station.measure(3)
    first.frame(heard=True, disk="takes", acknowledged=True, cumulative=True)
    station.disk = False
    station.measure(3)
    first.frame(heard=True, disk="waits", acknowledged=False, cumulative=False)
    station.restart()
    station.disk = True
    second = Exchange(station, master)
    second.frame(heard=True, disk="waits", acknowledged=True, cumulative=True)
    for _ in range(60):
        station.measure(5)
        second.frame(heard=False, disk="waits", acknowledged=False, cumulative=True)
    assert len(station.box) == 300
