"""The master's side of the superframe, frame by frame against stations that a test plays."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from statistics import median
from typing import TYPE_CHECKING
from unittest.mock import patch

import pytest
from harness.frames import KEY, TIMING, ZERO_NS, Frames, frames_of, measurement
from harness.radios import MS

from tsgt.model import Status
from tsgt.radio import DirectCommand, Direction, MeasureCommand, SearchCommand, TrackCommand
from tsgt.radio.superframe import PhaseLock, master
from tsgt.radio.superframe.station_state import FULL_TIME_FRAMES
from tsgt.radio.superframe.wire import (
    GRANT_BYTES,
    Authenticator,
    CommandResponse,
    EncodedCommand,
    EncodedDirection,
    JoinConfirmation,
    MeasurementBlock,
    Reply,
    SessionInfo,
    SingleMeasurement,
    SlotOrder,
    StatusReport,
)

if TYPE_CHECKING:
    from tsgt.radio import Command

STATE = StatusReport(prism=1, direct=False, connected=True, missed_slots=0, rejected_beacons=0, rssi_dbm=-80)


@pytest.fixture
def frames() -> Frames:
    """Three stations that have joined, two frames ago."""
    frames = frames_of()
    frames.join()
    frames.run(1)
    return frames


def sessions(frames: Frames, count: int, silent: tuple[int, ...] = ()) -> list[int]:
    """Run frames; return the numbers of those whose beacon could be joined by."""
    found = []
    for _ in range(count):
        frames.run(1, silent)
        if frames.beacon.session is not None:
            found.append(frames.master.counter)
    return found


# --- Beacons --------------------------------------------------------------------------------------------------------


def test_the_first_beacon_says_what_is_needed_to_join() -> None:
    """Session, times, and a slot for each that an introduction fits into; no earlier beacon left at any time."""
    frames = frames_of()
    beacon = frames.begin()
    assert beacon.session == SessionInfo(
        nonce=frames.master.session,
        counter_high=0,
        sent_high=0,
        guard=TIMING.guard_ns // 250_000,
        turnaround=TIMING.turnaround_ns // 250_000,
    )
    assert beacon.sent == 0
    assert [GRANT_BYTES[entry.grant] for entry in beacon.stations] == [44, 44, 44]
    assert [entry.ack_bitmap for entry in beacon.stations] == [0, 0, 0]


def test_a_beacon_tells_when_the_one_before_it_left(frames: Frames) -> None:
    """In full where a station may join, else its low bits; a time that looks like none is told a microsecond later."""
    frames.run(30)
    for _ in range(8):
        sent_us = frames.sent_us
        beacon = frames.begin()
        frames.end()
        assert beacon.sent == sent_us % 65_536
        if beacon.session is not None:
            assert beacon.session.sent_high == sent_us >> 16
    frames.begin()
    frames.master.sent(ZERO_NS + (7 << 16) * 1000, 3000)
    frames.end()
    assert frames.begin().sent == 1


@pytest.mark.parametrize("lost", ["edge", "end"])
def test_an_unknown_end_of_a_beacon_is_not_told(frames: Frames, lost: str) -> None:
    """An edge that was lost, or a transmission that failed: 0 stands for it. Its number is used up."""
    before = frames.begin(sigma_ns=MS, fails=lost == "end").frame
    beacon = frames.begin()
    assert beacon.sent == 0
    assert beacon.frame == before + 1


def test_a_beacon_that_failed_leaves_nothing_behind(frames: Frames) -> None:
    """Nobody counts as silent in its frame, replies to it are refused, and what it confirmed is confirmed again."""
    frames = frames_of()
    frames.join()
    confirmations = frames.begin(fails=True).confirmations
    assert len(confirmations) == 3
    assert frames.master.received(frames.packet(1, Reply()), frames.sent_ns + 200 * MS, 0) is None
    assert frames.begin().confirmations == confirmations
    frames.end()
    assert frames.begin().confirmations == ()


def test_how_to_join_is_told_more_often_while_somebody_is_missing(frames: Frames) -> None:
    """In each fourth beacon while a station has not joined or is silent, otherwise in each thirty-second."""
    assert [number for number in sessions(frames, 70) if number > FULL_TIME_FRAMES] == [32, 64]
    assert [number % 4 for number in sessions(frames, 21, silent=(2,))] == [0, 0, 0, 0]
    unjoined = frames_of()
    assert sessions(unjoined, 21, silent=(1, 2, 3)) == [*range(12), 12, 16, 20]


def test_a_station_that_introduces_itself_is_told_the_time_in_full_at_once() -> None:
    """Twice and once more, for it believes no time that is not confirmed; and again if it has not heard that."""
    frames = frames_of((1,))
    frames.run(20, silent=(1,))
    for _ in range(2):
        before = frames.begin().frame
        frames.reply(1, Reply(join_request=frames.stations[1].join_request))
        frames.end()
        assert sessions(frames, 3) == [before + 1, before + 2, before + 3]
        frames.run(6)


@pytest.mark.parametrize(("direct", "often"), [(True, 4), (False, 32)])
def test_a_station_that_does_not_know_the_time_is_told_it_in_full_more_often(
    *, direct: bool, often: int
) -> None:
    """It tells what it measures by the beacon that it has heard."""
    frames = frames_of((1,))
    frames.join()
    frames.run(12)
    told = []
    for number in range(13, 13 + 2 * often):
        session = frames.begin().session
        if session is not None:
            told.append(frames.master.counter)
        origin_us = frames.sent_us if direct else 0
        measured = measurement(number, frames.sent_us + 10_000, origin_us=origin_us, wide=True)
        frames.reply(
            1,
            Reply(blocks=(MeasurementBlock(measurements=(measured,), wide=True, beacon_relative=direct),)),
            sequence=number,
        )
        frames.end()
    assert len(told) == 2
    assert told[1] - told[0] == often


def test_stations_may_have_any_numbers() -> None:
    """Numbers that nobody has get no slot."""
    frames = frames_of((2, 5))
    frames.join()
    frames.run(3)
    assert [bool(entry.grant) for entry in frames.beacon.stations] == [False, True, False, False, True]


def test_a_session_ends_before_its_numbers_do(frames: Frames) -> None:
    """The next one begins with another nonce; stations join again, and what came before is not taken twice."""
    with patch.object(master, "MAX_FRAMES_PER_SESSION", 5):
        before = frames.master.session
        frames.run(3)
        frames.begin()
        assert frames.master.session != before
        assert frames.master.counter == 0
        assert frames.beacon.session is not None
        assert frames.master.received(frames.packet(1, Reply()), frames.now_ns + 200 * MS, 0) is None
        station = frames.stations[1]
        old = MeasurementBlock(
            measurements=(measurement(station.sequence - 1, frames.sent_us, wide=True),), wide=True
        )
        heard = frames.reply(
            1, Reply(blocks=(old,), join_request=station.join_request), sequence=station.sequence - 1
        )
        assert heard.joined
        assert (heard.measurements, heard.repeated) == ((), 1)


# --- Who is believed ------------------------------------------------------------------------------------------------


def test_a_station_joins_with_its_first_reply() -> None:
    """Its measurement is taken; the next beacon proves to it that it was heard, and no further one does."""
    frames = frames_of()
    frames.begin()
    heard = frames.measure(1, introduce=True)
    assert heard.joined
    assert len(heard.measurements) == 1
    frames.end()
    assert frames.begin().confirmations == (JoinConfirmation(1, frames.stations[1].nonce),)
    heard = frames.measure(1, introduce=True)  # it has missed that
    assert not heard.joined
    frames.end()
    assert frames.begin().confirmations == (JoinConfirmation(1, frames.stations[1].nonce),)
    frames.measure(1)
    frames.end()
    assert frames.begin().confirmations == ()


def test_a_station_that_starts_again_is_believed_at_once(frames: Frames) -> None:
    """Another nonce counts from the reply on that it comes in, and the old one no more."""
    station = frames.stations[2]
    old = station.nonce
    frames.begin()
    station.nonce, station.first_sequence, station.sequence = 0xCAFE, 1002, 1002
    heard = frames.measure(2, introduce=True)
    assert heard.joined
    assert [each.sequence for each in heard.measurements] == [1002]
    frames.end()
    assert frames.begin().confirmations == (JoinConfirmation(2, 0xCAFE),)
    assert frames.arrive(2, frames.packet(2, Reply(), nonce=old)) is None
    assert frames.arrive(2, frames.packet(2, Reply())) is not None


def test_without_introduction_nobody_unknown_is_believed() -> None:
    """A reply of a station that has not joined has a nonce that nobody knows."""
    frames = frames_of()
    frames.begin()
    assert frames.arrive(1, frames.packet(1, Reply())) is None
    assert frames.master.rejected_packets == 1


def test_what_is_not_a_reply_to_this_beacon_is_refused(frames: Frames) -> None:
    """Flipped, cut, of another station, of another frame, with another key, with another number: all counted."""
    frames.begin()
    early = frames.packet(1, Reply())
    frames.end()
    frames.begin()
    good = frames.packet(1, Reply(status_report=STATE))
    bad = [good[:length] for length in range(len(good))]
    bad += [
        bytes(byte ^ (1 << bit % 8 if index == bit // 8 else 0) for index, byte in enumerate(good))
        for bit in range(8 * len(good))
    ]
    bad.append(early)
    bad.append(frames.packet(1, Reply(), sequence=5))
    other = replace(frames, authenticator=Authenticator(bytes(32)))
    other.beacon, other.payload = frames.beacon, frames.payload
    bad.append(other.packet(1, Reply()))
    before = frames.master.rejected_packets
    for packet in bad:
        assert frames.arrive(1, packet) is None
    assert frames.master.rejected_packets == before + len(bad)
    assert frames.arrive(1, good) is not None


def test_a_reply_counts_once_and_after_its_beacon(frames: Frames) -> None:
    """One that is played again within the frame, or that came before the beacon was out, is none."""
    frames.begin()
    good = frames.packet(1, Reply())
    assert frames.master.received(good, frames.sent_ns - 1, 0) is None
    assert frames.arrive(1, good) is not None
    assert frames.arrive(2, good) is None


def test_without_a_key_frames_run_all_the_same() -> None:
    """The codes are those of a key that everybody knows."""
    frames = frames_of(key=None)
    frames.join()
    frames.run(3)
    frames.begin()
    with_key = replace(frames, authenticator=Authenticator(KEY))
    with_key.beacon, with_key.payload = frames.beacon, frames.payload
    assert frames.arrive(1, with_key.packet(1, Reply())) is None
    assert frames.arrive(1, frames.packet(1, Reply())) is not None


# --- Acknowledgement ------------------------------------------------------------------------------------------------


def test_only_what_is_written_is_acknowledged(frames: Frames) -> None:
    """The history is that of the last four frames; a reply counts when its last measurement is in the recording."""
    frames.writes = False
    frames.begin()
    first = frames.measure(1).measurements[0].sequence
    frames.arrive(2, frames.packet(2, Reply()))  # says nothing that could be lost
    frames.end()
    assert [entry.ack_bitmap for entry in frames.begin().stations] == [0b0110, 0b0111, 0b0110]
    frames.end()
    frames.master.station(1).window.mark_written([first])
    assert [entry.ack_bitmap for entry in frames.begin().stations] == [0b1110, 0b1110, 0b1100]


def test_a_repeated_measurement_is_acknowledged_when_the_first_one_is_written(frames: Frames) -> None:
    """It is not handed on again."""
    frames.writes = False
    frames.begin()
    number = frames.measure(1).measurements[0].sequence
    frames.end()
    frames.begin()
    run = MeasurementBlock(measurements=(measurement(number, frames.sent_us - 300_000),))
    heard = frames.reply(1, Reply(blocks=(run,)), sequence=number)
    assert (heard.measurements, heard.repeated) == ((), 1)
    frames.end()
    assert frames.begin().stations[0].ack_bitmap & 0b11 == 0
    frames.master.station(1).window.mark_written([number])
    frames.end()
    assert frames.begin().stations[0].ack_bitmap & 0b111 == 0b110


def test_the_cumulative_number_goes_round(frames: Frames) -> None:
    """Each frame tells one station up to where nothing is missing."""
    frames.run(300)
    for _ in range(3):
        beacon = frames.begin()
        station = beacon.frame + 256  # of the 300
        station_state = frames.master.station(frames.master.counter % 3 + 1)
        assert beacon.cumulative == station_state.window.cumulative % 256 == 301 % 256
        assert station
        frames.end()


def test_a_measurement_that_the_disk_lost_is_taken_again(frames: Frames) -> None:
    """As if it had never come."""
    frames.writes = False
    frames.begin()
    number = frames.measure(1).measurements[0].sequence
    frames.end()
    frames.master.station(1).window.mark_lost([number])
    frames.begin()
    run = MeasurementBlock(measurements=(measurement(number, frames.sent_us - 300_000),))
    heard = frames.reply(1, Reply(blocks=(run,)), sequence=number)
    assert [each.sequence for each in heard.measurements] == [number]


# --- Orders ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("order", "code", "argument"),
    [
        (TrackCommand(3), 0, 2),
        (TrackCommand(None), 0, 1),
        (SearchCommand(), 1, 0),
        (SearchCommand(Direction(math.pi, math.pi / 2, 0.0087)), 4, 3),
        (DirectCommand(), 2, 0),
        (MeasureCommand(), 3, 0),
    ],
)
def test_an_order_is_repeated_until_it_is_answered(
    frames: Frames, order: Command, code: int, argument: int
) -> None:
    """With the same ticket; the answer is handed on once, however often the station gives it."""
    command_id = frames.master.station(2).submit(order)
    for _ in range(3):
        frames.run(1)
        towards = EncodedDirection(2**15, 2**14) if code == 4 else None
        assert frames.beacon.commands == (EncodedCommand(2, command_id, code, argument, towards),)
    frames.begin()
    other = frames.reply(2, Reply(response=CommandResponse((command_id + 1) % 16, ok=True)))
    assert (other.command, other.response) == (None, None)
    frames.end()
    frames.begin()
    heard = frames.reply(2, Reply(response=CommandResponse(command_id, ok=False)))
    assert (heard.command, heard.response) == (order, CommandResponse(command_id, ok=False))
    frames.end()
    assert frames.begin().commands == ()
    assert frames.reply(2, Reply(response=CommandResponse(command_id, ok=False))).response is None


def test_an_order_that_is_withdrawn_is_said_no_more(frames: Frames) -> None:
    """One of another kind stands; an answer that comes all the same is nobody's."""
    command_id = frames.master.station(2).submit(SearchCommand())
    frames.master.station(1).submit(TrackCommand(1))
    frames.run(1)
    for station in (1, 2):
        frames.master.station(station).withdraw(SearchCommand)
    frames.begin()
    assert [(part.station, part.code) for part in frames.beacon.commands] == [(1, 0)]
    heard = frames.reply(2, Reply(response=CommandResponse(command_id, ok=True)))
    assert (heard.command, heard.response) == (None, None)


def test_whether_a_station_tracks_is_what_it_said_last(frames: Frames) -> None:
    """Which prism, with an instrument, not in direct mode; not while it is away or has another order."""
    station_state = frames.master.station(2)
    state = replace(STATE, prism=2)

    def says(state: StatusReport) -> tuple[bool, bool]:
        frames.begin()
        frames.reply(2, Reply(status_report=state))
        frames.end()
        return station_state.is_tracking(2), station_state.is_tracking(3)

    assert not station_state.is_tracking(2)
    assert says(state) == (True, False)
    assert says(replace(state, prism=3)) == (False, True)
    assert says(replace(state, direct=True)) == (False, False)
    assert says(replace(state, connected=False)) == (False, False)
    assert says(state) == (True, False)
    frames.master.station(2).submit(SearchCommand())
    assert station_state.is_tracking(2)
    frames.master.station(2).submit(TrackCommand(2))
    assert not station_state.is_tracking(2)
    station_state.withdraw(TrackCommand)
    frames.run(3, silent=(2,))
    assert station_state.is_tracking(2)
    frames.run(1, silent=(2,))
    assert not station_state.is_tracking(2)


def test_a_shot_answers_an_order(frames: Frames) -> None:
    """And there is room for it."""
    command_id = frames.master.station(1).submit(MeasureCommand())
    frames.begin()
    shot = SingleMeasurement(command_id, Status.OK, 1, 2, 3)
    reply = Reply(single_measurement=shot)
    assert len(frames.packet(1, reply)) <= frames.span(1).max_reply_bytes
    heard = frames.reply(1, reply)
    assert (heard.single_measurement, heard.response) == (shot, None)


def test_orders_have_other_tickets(frames: Frames) -> None:
    """Sixteen of them go round."""
    tickets = [frames.master.station(1).submit(SearchCommand()) for _ in range(17)]
    assert len(set(tickets)) == 16
    assert tickets[0] == tickets[16]


def test_who_would_not_obey_is_told_no_order() -> None:
    """A station that has not joined, or does not know yet that it has."""
    frames = frames_of()
    frames.master.station(1).submit(SearchCommand())
    assert frames.begin().commands == ()
    frames.measure(1, introduce=True)
    frames.end()
    assert frames.begin().commands == ()
    frames.measure(1)
    frames.end()
    assert len(frames.begin().commands) == 1


# --- Slots ----------------------------------------------------------------------------------------------------------


def test_a_station_that_stays_away_costs_less_and_less() -> None:
    """After twenty frames it has a slot only where it could join."""
    frames = frames_of()
    frames.join()
    frames.run(40, silent=(3,))
    slots = []
    for _ in range(8):
        slots.append((frames.begin().session is not None, bool(frames.beacon.stations[2].grant)))
        assert all(entry.grant for entry in frames.beacon.stations[:2])
        frames.end()
    assert {invites == slot for invites, slot in slots} == {True}
    assert sum(slot for _, slot in slots) == 2


def test_without_anybody_the_channel_is_left_alone() -> None:
    """Frames without a slot do not follow each other at once."""
    frames = frames_of()
    for _ in range(21):
        frames.begin()
        assert frames.end()
    starts = []
    for _ in range(9):
        frames.begin()
        silent = frames.end()
        assert bool(silent) == (frames.beacon.session is not None)
        starts.append(frames.sent_ns)
    assert min(after - before for before, after in pairwise(starts)) >= 390 * MS


def test_the_silent_are_named(frames: Frames) -> None:
    """Those that had a slot and were not heard."""
    frames.begin()
    frames.measure(2)
    assert frames.end() == [1, 3]
    frames.begin()
    for station in (1, 2, 3):
        frames.measure(station)
    assert frames.end() == []


def test_a_frame_waits_for_those_that_may_still_answer(frames: Frames) -> None:
    """It ends with the last slot whose station has not been heard, and when all have been heard at once."""
    frames.begin()
    until_ns = [frames.master.reply_deadline_ns]
    for station in (3, 2, 1):
        frames.measure(station)
        until_ns.append(frames.master.reply_deadline_ns)
    assert until_ns[-1] is None
    whole = [ns for ns in until_ns if ns is not None]
    assert whole == sorted(whole, reverse=True)
    assert len(set(whole)) == 3


def test_frames_follow_the_instruments_where_a_lock_says_so() -> None:
    """Measurements every 400 ms make frames of 400 ms."""
    frames = frames_of(phase_lock=PhaseLock(TIMING, 3))
    frames.join()
    starts = []
    for _ in range(60):
        frames.begin()
        starts.append(frames.sent_ns)
        for number in (1, 2, 3):
            grant = frames.beacon.stations[number - 1].grant
            station, slot_ns = frames.stations[number], frames.sent_ns + frames.span(number).start_ns
            made = (slot_ns - ZERO_NS - number * 95 * MS) // (400 * MS)
            fitting = range(made, max(station.sequence - 1, made - 2 - 3 * (grant > 2)), -1)
            if not fitting:
                frames.reply(number, Reply())
                continue
            station.sequence = made + 1
            run = MeasurementBlock(
                measurements=tuple(measurement(each, each * 400_000 + number * 95_000) for each in fitting)
            )
            reply = Reply(blocks=(run,), turnaround_us=frames.turnarounds_us[number] if grant > 2 else None)
            frames.reply(number, reply, sequence=made)
        frames.end()
    lengths_ms = [(after - before) / MS for before, after in pairwise(starts[-20:])]
    assert median(lengths_ms) == pytest.approx(400, abs=0.1)


def test_where_nothing_is_recorded_nothing_is_asked_for() -> None:
    """Slots are those that an answer to an order needs, however much is not acknowledged."""
    frames = frames_of(records=False)
    frames.writes = False
    frames.join()
    frames.run(10)
    assert [GRANT_BYTES[entry.grant] for entry in frames.begin().stations] == [44, 44, 44]
    assert [entry.ack_bitmap for entry in frames.beacon.stations] == [0, 0, 0]


def test_the_order_of_slots_is_that_of_the_numbers_without_a_lock(frames: Frames) -> None:
    """The first station comes first."""
    assert frames.begin().slot_order == SlotOrder()
