"""The master's side of the superframe against scripted stations."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from statistics import median
from typing import TYPE_CHECKING
from unittest.mock import patch

import pytest
from harness.hardware.radios import MS
from harness.radio.scripted_stations import KEY, TIMING, ZERO_NS, ScriptedFrames, measurement, scripted_frames

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
def frames() -> ScriptedFrames:
    """Three stations that joined two frames ago."""
    frames = scripted_frames()
    frames.join()
    frames.run(1)
    return frames


def sessions(frames: ScriptedFrames, count: int, silent: tuple[int, ...] = ()) -> list[int]:
    """Run frames; return the counters of those with a session item."""
    found = []
    for _ in range(count):
        frames.run(1, silent)
        if frames.beacon.session is not None:
            found.append(frames.master.counter)
    return found


def test_beacon_of_another_master_is_counted(frames: ScriptedFrames) -> None:
    """One with a session item and the right key; not the own ones, a forged one, or noise."""
    other = scripted_frames()
    other.master.session = 7
    other.begin()
    own = frames.payload
    for payload in (other.payload, other.payload[:-1] + b"x", own, b"noise"):
        assert frames.master.received(payload, frames.now_ns + MS, 0) is None
    assert frames.master.other_beacons == 1


# --- Beacons --------------------------------------------------------------------------------------------------------


def test_first_beacon_invites_stations() -> None:
    """It has a session item and slots for join requests, and no time of a previous beacon."""
    frames = scripted_frames()
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


def test_beacon_carries_time_of_previous_beacon(frames: ScriptedFrames) -> None:
    """In full with a session item, otherwise its low bits; low bits 0 are sent as 1."""
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
def test_unknown_beacon_time_is_sent_as_zero(frames: ScriptedFrames, lost: str) -> None:
    """An inexact TxDone, or a failed transmission, which uses up its frame counter."""
    before = frames.begin(sigma_ns=MS, fails=lost == "end").frame
    beacon = frames.begin()
    assert beacon.sent == 0
    assert beacon.frame == before + 1


def test_failed_beacon_has_no_effect(frames: ScriptedFrames) -> None:
    """No station counts as silent, replies to it are rejected, confirmations are repeated."""
    frames = scripted_frames()
    frames.join()
    confirmations = frames.begin(fails=True).confirmations
    assert len(confirmations) == 3
    assert frames.master.received(frames.packet(1, Reply()), frames.sent_ns + 200 * MS, 0) is None
    assert frames.begin().confirmations == confirmations
    frames.end()
    assert frames.begin().confirmations == ()


def test_session_info_is_frequent_while_a_station_is_missing(frames: ScriptedFrames) -> None:
    """One beacon in four instead of one in 32."""
    assert [number for number in sessions(frames, 70) if number > FULL_TIME_FRAMES] == [32, 64]
    assert [number % 4 for number in sessions(frames, 21, silent=(2,))] == [0, 0, 0, 0]
    unjoined = scripted_frames()
    assert sessions(unjoined, 21, silent=(1, 2, 3)) == [*range(12), 12, 16, 20]


def test_joining_station_gets_full_time_at_once() -> None:
    """In three beacons, and again after another join request."""
    frames = scripted_frames((1,))
    frames.run(20, silent=(1,))
    for _ in range(2):
        before = frames.begin().frame
        frames.reply(1, Reply(join_request=frames.stations[1].join_request))
        frames.end()
        assert sessions(frames, 3) == [before + 1, before + 2, before + 3]
        frames.run(6)


@pytest.mark.parametrize(("direct", "often"), [(True, 4), (False, 32)])
def test_beacon_relative_times_make_full_time_frequent(*, direct: bool, often: int) -> None:
    """The station has no session time yet."""
    frames = scripted_frames((1,))
    frames.join()
    frames.run(12)
    frames_with_session = []
    for number in range(13, 13 + 2 * often):
        session = frames.begin().session
        if session is not None:
            frames_with_session.append(frames.master.counter)
        origin_us = frames.sent_us if direct else 0
        measured = measurement(number, frames.sent_us + 10_000, origin_us=origin_us, wide=True)
        frames.reply(
            1,
            Reply(blocks=(MeasurementBlock(measurements=(measured,), wide=True, beacon_relative=direct),)),
            sequence=number,
        )
        frames.end()
    assert len(frames_with_session) == 2
    assert frames_with_session[1] - frames_with_session[0] == often


def test_stations_may_have_any_numbers() -> None:
    """Unused numbers get no slot."""
    frames = scripted_frames((2, 5))
    frames.join()
    frames.run(3)
    assert [bool(entry.grant) for entry in frames.beacon.stations] == [False, True, False, False, True]


def test_new_session_starts_before_counter_wraps(frames: ScriptedFrames) -> None:
    """It has another nonce; stations join again, and repeated measurements are recognised."""
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
        received = frames.reply(
            1, Reply(blocks=(old,), join_request=station.join_request), sequence=station.sequence - 1
        )
        assert received.joined
        assert (received.measurements, received.repeated) == ((), 1)


# --- Authentication ------------------------------------------------------------------------------------------


def test_station_joins_with_first_reply() -> None:
    """Its measurement is accepted, and one beacon confirms the join request."""
    frames = scripted_frames()
    frames.begin()
    received = frames.measure(1, join=True)
    assert received.joined
    assert len(received.measurements) == 1
    frames.end()
    assert frames.begin().confirmations == (JoinConfirmation(1, frames.stations[1].nonce),)
    received = frames.measure(1, join=True)  # it has missed that
    assert not received.joined
    frames.end()
    assert frames.begin().confirmations == (JoinConfirmation(1, frames.stations[1].nonce),)
    frames.measure(1)
    frames.end()
    assert frames.begin().confirmations == ()


def test_restarted_station_joins_at_once(frames: ScriptedFrames) -> None:
    """The new nonce replaces the old one."""
    station = frames.stations[2]
    old = station.nonce
    frames.begin()
    station.nonce, station.first_sequence, station.sequence = 0xCAFE, 1002, 1002
    received = frames.measure(2, join=True)
    assert received.joined
    assert [each.sequence for each in received.measurements] == [1002]
    frames.end()
    assert frames.begin().confirmations == (JoinConfirmation(2, 0xCAFE),)
    assert frames.arrive(2, frames.packet(2, Reply(), nonce=old)) is None
    assert frames.arrive(2, frames.packet(2, Reply())) is not None


def test_reply_of_unjoined_station_is_rejected() -> None:
    """Its nonce is unknown."""
    frames = scripted_frames()
    frames.begin()
    assert frames.arrive(1, frames.packet(1, Reply())) is None
    assert frames.master.rejected_packets == 1


def test_invalid_replies_are_rejected_and_counted(frames: ScriptedFrames) -> None:
    """Corrupted, truncated, of another station, frame, key or sequence number."""
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


def test_replayed_or_early_reply_is_rejected(frames: ScriptedFrames) -> None:
    """Within the frame, and before TxDone of the beacon."""
    frames.begin()
    good = frames.packet(1, Reply())
    assert frames.master.received(good, frames.sent_ns - 1, 0) is None
    assert frames.arrive(1, good) is not None
    assert frames.arrive(2, good) is None


def test_frames_run_without_key() -> None:
    """Replies with a keyed code are rejected."""
    frames = scripted_frames(key=None)
    frames.join()
    frames.run(3)
    frames.begin()
    with_key = replace(frames, authenticator=Authenticator(KEY))
    with_key.beacon, with_key.payload = frames.beacon, frames.payload
    assert frames.arrive(1, with_key.packet(1, Reply())) is None
    assert frames.arrive(1, frames.packet(1, Reply())) is not None


# --- Acknowledgement ------------------------------------------------------------------------------------------------


def test_only_recorded_measurements_are_acknowledged(frames: ScriptedFrames) -> None:
    """The bitmap covers four frames; a reply counts when all its measurements are recorded."""
    frames.writes = False
    frames.begin()
    first = frames.measure(1).measurements[0].sequence
    frames.arrive(2, frames.packet(2, Reply()))  # says nothing that could be lost
    frames.end()
    assert [entry.ack_bitmap for entry in frames.begin().stations] == [0b0110, 0b0111, 0b0110]
    frames.end()
    frames.master.station(1).window.mark_written([first])
    assert [entry.ack_bitmap for entry in frames.begin().stations] == [0b1110, 0b1110, 0b1100]


def test_repeated_measurement_is_acknowledged_once_recorded(frames: ScriptedFrames) -> None:
    """It is not published again."""
    frames.writes = False
    frames.begin()
    number = frames.measure(1).measurements[0].sequence
    frames.end()
    frames.begin()
    block = MeasurementBlock(measurements=(measurement(number, frames.sent_us - 300_000),))
    received = frames.reply(1, Reply(blocks=(block,)), sequence=number)
    assert (received.measurements, received.repeated) == ((), 1)
    frames.end()
    assert frames.begin().stations[0].ack_bitmap & 0b11 == 0
    frames.master.station(1).window.mark_written([number])
    frames.end()
    assert frames.begin().stations[0].ack_bitmap & 0b111 == 0b110


def test_cumulative_acknowledgement_rotates_over_stations(frames: ScriptedFrames) -> None:
    """One station per frame."""
    frames.run(300)
    for _ in range(3):
        beacon = frames.begin()
        station = beacon.frame + 256  # of the 300
        station_state = frames.master.station(frames.master.counter % 3 + 1)
        assert beacon.cumulative == station_state.window.cumulative % 256 == 301 % 256
        assert station
        frames.end()


def test_lost_measurement_is_accepted_again(frames: ScriptedFrames) -> None:
    """It was received but not recorded."""
    frames.writes = False
    frames.begin()
    number = frames.measure(1).measurements[0].sequence
    frames.end()
    frames.master.station(1).window.mark_lost([number])
    frames.begin()
    block = MeasurementBlock(measurements=(measurement(number, frames.sent_us - 300_000),))
    received = frames.reply(1, Reply(blocks=(block,)), sequence=number)
    assert [each.sequence for each in received.measurements] == [number]


# --- Commands ---------------------------------------------------------------------------------------------------


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
def test_command_is_repeated_until_response(
    frames: ScriptedFrames, order: Command, code: int, argument: int
) -> None:
    """With the same id; the response is returned once."""
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
    received = frames.reply(2, Reply(response=CommandResponse(command_id, ok=False)))
    assert (received.command, received.response) == (order, CommandResponse(command_id, ok=False))
    frames.end()
    assert frames.begin().commands == ()
    assert frames.reply(2, Reply(response=CommandResponse(command_id, ok=False))).response is None


def test_withdrawn_command_is_not_sent(frames: ScriptedFrames) -> None:
    """Commands of other kinds stay pending; a late response is ignored."""
    command_id = frames.master.station(2).submit(SearchCommand())
    frames.master.station(1).submit(TrackCommand(1))
    frames.run(1)
    for station in (1, 2):
        frames.master.station(station).withdraw(SearchCommand)
    frames.begin()
    assert [(part.station, part.code) for part in frames.beacon.commands] == [(1, 0)]
    received = frames.reply(2, Reply(response=CommandResponse(command_id, ok=True)))
    assert (received.command, received.response) == (None, None)


def test_is_tracking_follows_last_status_report(frames: ScriptedFrames) -> None:
    """Prism, connection, direct mode; False while it is silent or has another command."""
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


def test_single_measurement_completes_command(frames: ScriptedFrames) -> None:
    """The grant has room for it."""
    command_id = frames.master.station(1).submit(MeasureCommand())
    frames.begin()
    shot = SingleMeasurement(command_id, Status.OK, 1, 2, 3)
    reply = Reply(single_measurement=shot)
    assert len(frames.packet(1, reply)) <= frames.span(1).max_reply_bytes
    received = frames.reply(1, reply)
    assert (received.single_measurement, received.response) == (shot, None)


def test_command_ids_wrap_after_sixteen(frames: ScriptedFrames) -> None:
    """Consecutive ids differ."""
    tickets = [frames.master.station(1).submit(SearchCommand()) for _ in range(17)]
    assert len(set(tickets)) == 16
    assert tickets[0] == tickets[16]


def test_no_command_to_unconfirmed_station() -> None:
    """Nor to one that may not know its confirmation."""
    frames = scripted_frames()
    frames.master.station(1).submit(SearchCommand())
    assert frames.begin().commands == ()
    frames.measure(1, join=True)
    frames.end()
    assert frames.begin().commands == ()
    frames.measure(1)
    frames.end()
    assert len(frames.begin().commands) == 1


# --- Slots ----------------------------------------------------------------------------------------------------------


def test_absent_station_has_slots_only_with_session_info() -> None:
    """After 20 silent frames."""
    frames = scripted_frames()
    frames.join()
    frames.run(40, silent=(3,))
    slots = []
    for _ in range(8):
        slots.append((frames.begin().session is not None, bool(frames.beacon.stations[2].grant)))
        assert all(entry.grant for entry in frames.beacon.stations[:2])
        frames.end()
    assert {invites == slot for invites, slot in slots} == {True}
    assert sum(slot for _, slot in slots) == 2


def test_idle_frames_are_spaced() -> None:
    """Frames without slots do not follow each other immediately."""
    frames = scripted_frames()
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


def test_finish_returns_silent_stations(frames: ScriptedFrames) -> None:
    """Those with a slot and without a reply."""
    frames.begin()
    frames.measure(2)
    assert frames.end() == [1, 3]
    frames.begin()
    for station in (1, 2, 3):
        frames.measure(station)
    assert frames.end() == []


def test_reply_deadline_is_last_pending_slot(frames: ScriptedFrames) -> None:
    """None when all stations have replied."""
    frames.begin()
    until_ns = [frames.master.reply_deadline_ns]
    for station in (3, 2, 1):
        frames.measure(station)
        until_ns.append(frames.master.reply_deadline_ns)
    assert until_ns[-1] is None
    whole = [ns for ns in until_ns if ns is not None]
    assert whole == sorted(whole, reverse=True)
    assert len(set(whole)) == 3


def test_phase_lock_sets_frame_length() -> None:
    """Measurements every 400 ms make frames of 400 ms."""
    frames = scripted_frames(phase_lock=PhaseLock(TIMING, 3))
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
            block = MeasurementBlock(
                measurements=tuple(measurement(each, each * 400_000 + number * 95_000) for each in fitting)
            )
            reply = Reply(blocks=(block,), turnaround_us=frames.turnarounds_us[number] if grant > 2 else None)
            frames.reply(number, reply, sequence=made)
        frames.end()
    lengths_ms = [(after - before) / MS for before, after in pairwise(starts[-20:])]
    assert median(lengths_ms) == pytest.approx(400, abs=0.1)


def test_default_grants_without_recording() -> None:
    """However many measurements are unacknowledged."""
    frames = scripted_frames(records=False)
    frames.writes = False
    frames.join()
    frames.run(10)
    assert [GRANT_BYTES[entry.grant] for entry in frames.begin().stations] == [44, 44, 44]
    assert [entry.ack_bitmap for entry in frames.beacon.stations] == [0, 0, 0]


def test_slots_follow_station_numbers_without_phase_lock(frames: ScriptedFrames) -> None:
    """The first station comes first."""
    assert frames.begin().slot_order == SlotOrder()
