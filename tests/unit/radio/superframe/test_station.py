"""The station's side of the superframe against a scripted master."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.hardware.radios import MS
from harness.radio.scripted_master import (
    KEY,
    SECOND,
    TIMING,
    TRACKING,
    ScriptedMaster,
    counted,
    local_ns,
    make_station,
    queued,
)

from tsgt.model import Status
from tsgt.radio import DirectCommand, MeasureCommand, SearchCommand, TrackCommand, Transmission
from tsgt.radio.superframe import InstrumentState, SendQueue
from tsgt.radio.superframe.wire import (
    GRANT_BYTES,
    RESTART_SKIP,
    Authenticator,
    CommandResponse,
    EncodedCommand,
    SingleMeasurement,
    quality_bound_us,
)

if TYPE_CHECKING:
    from harness.radio.scripted_master import ReceivedMessage

    from tsgt.radio.superframe import BeaconReception, SuperframeStation

PERIOD_NS = 400 * MS


class Instrument:
    """Adds measurements to a send queue as the master's time passes."""

    def __init__(self, send_queue: SendQueue, first: int = 0) -> None:
        self._queue = send_queue
        self._next = first
        self._due_ns: int | None = None
        self.made_ns: dict[int, int] = {}

    def until(self, true_ns: int) -> None:
        """Measure every :data:`PERIOD_NS` up to this time."""
        if self._due_ns is None:
            self._due_ns = true_ns - 1
        while self._due_ns <= true_ns:
            self._queue.add(queued(self._next, self._due_ns))
            self.made_ns[self._next] = self._due_ns
            self._next += 1
            self._due_ns += PERIOD_NS


def joined() -> tuple[ScriptedMaster, SuperframeStation, SendQueue]:
    """Return a confirmed station with an empty queue."""
    send_queue = SendQueue(0)
    master, station = ScriptedMaster(), make_station(send_queue)
    for _ in range(3):
        master.frame(station)
    assert station.joined
    return master, station, send_queue


def test_station_joins_in_two_frames() -> None:
    """Its first reply has a join request and a measurement, and the next beacon confirms it."""
    send_queue = SendQueue(0)
    master, station = ScriptedMaster(grant=GRANT_BYTES.index(44)), make_station(send_queue)
    send_queue.add(queued(0, master.now_ns))
    first = master.frame(station)
    assert first is not None
    assert first.reply.join_request is not None
    assert (first.reply.join_request.stream_id, first.reply.join_request.oldest) == (9, 0)
    assert (first.reply.status_report is not None, first.sequences) == (True, (0,))
    assert first.reply.blocks[0].wide
    assert first.reply.blocks[0].prism == 1
    joined_before = station.joined
    send_queue.add(queued(1, master.now_ns))
    second = master.frame(station)
    assert second is not None
    assert (joined_before, station.joined) == (False, True)
    assert second.reply.join_request is None
    assert second.sequences == (1,)  # the same beacon acknowledges the other one
    assert not second.reply.blocks[0].wide
    assert second.reply.blocks[0].prism is None
    assert len(send_queue) == 1


def test_unconfirmed_master_cannot_acknowledge() -> None:
    """Acknowledgements are ignored until a beacon has confirmed the station."""
    send_queue = SendQueue(0)
    master, station = ScriptedMaster(confirm=False), make_station(send_queue)
    Instrument(send_queue).until(master.now_ns + SECOND)
    before = len(send_queue)
    for _ in range(20):
        assert master.frame(station) is not None
    assert len(send_queue) == before
    assert not station.joined


@pytest.mark.parametrize("loss", [0.0, 0.1, 0.3])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.slow
def test_all_measurements_arrive_within_their_bounds(loss: float, seed: int) -> None:
    """At any packet loss, beyond the wrap of eight-bit sequence numbers."""
    rng = np.random.default_rng(seed)
    send_queue = SendQueue(0)
    master, station, instrument = (
        ScriptedMaster(session_interval=4),
        make_station(send_queue),
        Instrument(send_queue),
    )
    for _ in range(700):
        instrument.until(master.now_ns + master.frame_ns)
        answered = master.frame(station, beacon_lost=rng.random() < loss, reply_lost=rng.random() < loss)
        if answered is not None:
            check_times(answered, instrument)
    for _ in range(30):
        master.frame(station)
    assert set(master.received) == set(instrument.made_ns)
    assert len(send_queue) == 0
    assert station.rejected_beacons == 0


def check_times(answered: ReceivedMessage, instrument: Instrument) -> None:
    """Compare with the truth within the claimed bound, one time unit and the master's rounding."""
    for block in answered.reply.blocks:
        bound_us = quality_bound_us(block.quality) + 10
        low_bits = {measurement.sequence % 256 for measurement in block.measurements}
        numbers = [number for number in answered.sequences if number % 256 in low_bits]
        assert numbers
        for number in numbers:
            assert abs(answered.times_ns[number] - instrument.made_ns[number]) <= 1000 * bound_us


def test_unrecorded_measurement_is_retransmitted() -> None:
    """The master acknowledges recorded measurements only."""
    master, station, send_queue = joined()
    send_queue.add(queued(0, master.now_ns))
    for _ in range(3):
        answered = master.frame(station, not_written=True)
        assert answered is not None
        assert answered.sequences == (0,)
    master.written.add(0)
    answered = master.frame(station)
    assert answered is not None
    assert answered.sequences == ()


def test_empty_reply_has_five_bytes() -> None:
    """Including the authentication code."""
    master, station, _ = joined()
    master.frame(station, beacon_lost=True)  # or the reply would have a turnaround
    answered = master.frame(station)
    assert answered is not None
    assert answered.payload_bytes == 5


def test_plain_measurement_has_seventeen_bytes() -> None:
    """After the clock has converged."""
    send_queue = SendQueue(0)
    master, station, instrument = ScriptedMaster(), make_station(send_queue), Instrument(send_queue)
    for _ in range(40):
        instrument.until(master.now_ns + master.frame_ns)
        master.frame(station)
    master.grant = GRANT_BYTES.index(17)
    instrument.until(master.now_ns + master.frame_ns)
    answered = master.frame(station)
    assert answered is not None
    assert (answered.payload_bytes, len(answered.sequences)) == (17, 1)
    bound_us = station.clock_bound_us(local_ns(master.now_ns))
    assert bound_us is not None
    assert bound_us < 100


def test_backlog_is_delivered_newest_first() -> None:
    """New measurements do not wait for a backlog of a thousand, which arrives completely."""
    send_queue = SendQueue(0)
    master, station, instrument = (
        ScriptedMaster(session_interval=4),
        make_station(send_queue),
        Instrument(send_queue),
    )
    for _ in range(50):
        instrument.until(master.now_ns + master.frame_ns)
        master.frame(station)
    for _ in range(1000):
        instrument.until(master.now_ns + master.frame_ns)
        master.frame(station, beacon_lost=True)
    assert len(send_queue) >= 1000
    frames = 0
    while len(send_queue) > 3:
        instrument.until(master.now_ns + master.frame_ns)
        answered = master.frame(station)
        frames += 1
        if answered is not None:
            newest = max(answered.sequences)
            assert newest >= max(instrument.made_ns) - 1
            for number in answered.sequences:
                error_ns = answered.times_ns[number] - instrument.made_ns[number]
                assert abs(error_ns) < 100_000
    assert frames < 100
    for _ in range(4):
        master.frame(station)
    assert set(master.received) == set(instrument.made_ns)


def test_late_reply_is_not_sent() -> None:
    """A reply that would overlap the next slot counts as a missed slot and is sent in the next frame."""
    master, station, send_queue = joined()
    send_queue.add(queued(0, master.now_ns))
    received = station.received(master.packet(master.beacon()))
    assert received is not None
    assert received.slot_ns is not None
    assert station.compose(TRACKING, received.slot_ns + 400 * MS) is None
    assert station.missed_slots == 1
    answered = master.frame(station, InstrumentState(1, direct=False, connected=False))
    assert answered is not None
    assert answered.sequences == (0,)
    assert answered.reply.status_report is not None
    assert answered.reply.status_report.missed_slots == 1


def test_late_transmission_counts_as_missed_slot() -> None:
    """The radio delayed the start of the reply."""
    master, station, _ = joined()
    received = station.received(master.packet(master.beacon()))
    assert received is not None
    assert received.slot_ns is not None
    assert station.compose(TRACKING, received.slot_ns - MS) is not None
    started_ns = received.slot_ns + 400 * MS
    station.sent(Transmission(started_at_ns=started_ns, done_at_ns=started_ns + MS, stamp_sigma_ns=20_000))
    assert station.missed_slots == 1


def test_slot_starts_relative_to_beacon_end() -> None:
    """On the station's clock, after the slots of other stations."""
    master, station, _ = joined()
    payload = master.beacon()
    received = station.received(master.packet(payload))
    assert received is not None
    assert received.slot_ns is not None
    end_ns = master.now_ns + TIMING.airtime_ns(len(payload))
    first_slot_ns = TIMING.airtime_ns(17) + TIMING.guard_ns
    expected_ns = local_ns(end_ns) + TIMING.turnaround_ns + first_slot_ns
    assert abs(received.slot_ns - expected_ns) < 10_000


def test_inexact_beacon_timestamp_gives_no_slot() -> None:
    """The start of the slot is unknown."""
    master, station, _ = joined()
    received = station.received(master.packet(master.beacon(), sigma_ns=2 * MS))
    assert received is not None
    assert received.slot_ns is None
    assert station.compose(TRACKING, local_ns(master.now_ns)) is None


@pytest.mark.parametrize("grant", range(len(GRANT_BYTES)))
def test_a_reply_never_exceeds_its_grant(grant: int) -> None:
    """An unknown station does not reply where its join request does not fit."""
    send_queue = SendQueue(0)
    master, station = ScriptedMaster(grant=grant), make_station(send_queue)
    Instrument(send_queue).until(master.now_ns + 3 * SECOND)
    answered = master.frame(station)
    if GRANT_BYTES[grant] < 21:
        assert answered is None
    else:
        assert answered is not None
        assert answered.payload_bytes <= GRANT_BYTES[grant]
    master.grant = len(GRANT_BYTES) - 1
    for _ in range(3):
        master.frame(station)
    Instrument(send_queue, 100).until(master.now_ns + 3 * SECOND)
    master.grant = grant
    answered = master.frame(station, tracking(2))
    if answered is not None:
        assert answered.payload_bytes <= GRANT_BYTES[grant]


def tracking(prism: int) -> InstrumentState:
    """Return a state that the master does not know yet."""
    return InstrumentState(prism, direct=False, connected=True)


def test_blocks_name_their_prism_until_master_knows_it() -> None:
    """A measurement keeps its prism, whenever it is delivered."""
    master, station, send_queue = joined()
    send_queue.add(queued(0, master.now_ns, prism=1))
    send_queue.add(queued(1, master.now_ns + 1, prism=3))
    lost = master.frame(station, tracking(3), not_written=True)
    assert lost is not None
    assert lost.reply.status_report is not None
    assert [block.prism for block in lost.reply.blocks] == [3, 1]
    known = master.frame(station, tracking(3))
    assert known is not None
    assert [block.prism for block in known.reply.blocks] == [3, 1]
    send_queue.add(queued(2, master.now_ns + 2, prism=3))
    plain = master.frame(station, tracking(3))
    assert plain is not None
    assert [block.prism for block in plain.reply.blocks] == [None]


def test_command_is_executed_once() -> None:
    """Beacons repeat the command, replies repeat the response until it is acknowledged."""
    master, station, _ = joined()
    order = EncodedCommand(2, command_id=5, code=0, argument=2)
    assert master.frame(station, commands=[order, EncodedCommand(1, 6, 2)]) is not None
    assert station.next_command() == TrackCommand(3)
    assert station.next_command() is None
    master.frame(station, commands=[order])
    assert station.next_command() is None
    station.executed(ok=True)
    for _ in range(6):
        master.frame(station, commands=[order], reply_lost=True)
    answered = master.frame(station, commands=[order])
    assert answered is not None
    assert answered.reply.response == CommandResponse(5, ok=True)
    assert station.next_command() is None
    answered = master.frame(station)
    assert answered is not None
    assert answered.reply.response is None


def test_wrapped_command_id_is_a_new_command() -> None:
    """Fifteen commands were replaced while the station received no beacon."""
    master, station, _ = joined()
    master.frame(station, commands=[EncodedCommand(2, command_id=5, code=0, argument=2)])
    assert station.next_command() == TrackCommand(3)
    station.executed(ok=True)
    master.frame(station, commands=[EncodedCommand(2, command_id=6, code=1)])
    assert station.next_command() == SearchCommand()
    station.executed(ok=True)
    master.frame(station, commands=[EncodedCommand(2, command_id=5, code=2)])
    assert station.next_command() == DirectCommand()


def test_commands_are_executed_in_sequence() -> None:
    """Each has its own response."""
    master, station, _ = joined()
    parts = [EncodedCommand(2, command_id, kind) for command_id, kind in ((1, 1), (2, 2), (3, 3))]
    master.frame(station, commands=parts)
    assert station.next_command() == SearchCommand()
    station.executed(ok=False)
    answered = master.frame(station)
    assert answered is not None
    assert answered.reply.response == CommandResponse(1, ok=False)
    assert station.next_command() == DirectCommand()
    station.executed(ok=True)
    answered = master.frame(station)
    assert answered is not None
    assert answered.reply.response == CommandResponse(2, ok=True)
    assert station.next_command() == MeasureCommand()
    station.measured(Status.OK, 123, 456, 7.25)
    answered = master.frame(station)
    assert answered is not None
    assert answered.reply.single_measurement == SingleMeasurement(3, Status.OK, 123, 456, 72_500)
    assert station.next_command() is None
    with pytest.raises(RuntimeError, match="no command is being executed"):
        station.executed(ok=True)


def test_command_of_unconfirmed_master_is_ignored() -> None:
    """It may be a replay."""
    master, station = ScriptedMaster(confirm=False), make_station(SendQueue(0))
    for _ in range(3):
        master.frame(station, commands=[EncodedCommand(2, 1, 2)])
    assert station.next_command() is None


def test_corrupted_beacon_is_rejected() -> None:
    """Any flipped bit and any other length."""
    master, station, _ = joined()
    payload = master.beacon()
    for bit in range(8 * len(payload)):
        forged = bytearray(payload)
        forged[bit // 8] ^= 1 << bit % 8
        assert station.received(master.packet(bytes(forged))) is None
    for length in range(len(payload)):
        assert station.received(master.packet(payload[:length])) is None
    assert station.received(master.packet(payload + b"\0")) is None
    assert station.received(master.packet(payload)) is not None


def test_noise_is_rejected() -> None:
    """Of any length."""
    rng = np.random.default_rng(1)
    master, station, _ = joined()
    for _ in range(3000):
        assert station.received(master.packet(rng.bytes(int(rng.integers(60))))) is None


def test_master_with_another_key_is_rejected() -> None:
    """The station counts authentication failures."""
    station = make_station(SendQueue(0))
    master = ScriptedMaster(authenticator=Authenticator(KEY[::-1]))
    assert master.frame(station) is None
    assert station.authentication_failures == 1
    assert station.heard_ns is None


def test_replayed_beacon_is_rejected() -> None:
    """The newest one and earlier ones."""
    master, station, _ = joined()
    payloads = [master.beacon() for _ in range(4)]
    assert station.received(master.packet(payloads[-1])) is not None
    for payload in payloads:
        assert station.received(master.packet(payload)) is None


def test_replayed_session_has_no_effect() -> None:
    """The station replies to it while the master is silent, but accepts no acknowledgement or command."""
    send_queue = SendQueue(0)
    station = make_station(send_queue)
    old = ScriptedMaster(session=0x111)
    recorded = [old.beacon(commands=[EncodedCommand(2, 1, 2)]) for _ in range(30)]
    master = ScriptedMaster()
    instrument = Instrument(send_queue)
    for _ in range(20):
        instrument.until(master.now_ns + master.frame_ns)
        master.frame(station)
    assert station.received(master.packet(recorded[0])) is None  # the master is not silent
    instrument.until(master.now_ns + 4 * SECOND)
    before = len(send_queue)
    for payload in recorded:
        master.now_ns += 4 * SECOND
        master.beacon_done_ns = master.now_ns
        received = station.received(master.packet(payload))
        assert received is not None
        assert received.reception is None
        if received.slot_ns is not None:
            station.compose(TRACKING, received.slot_ns - 6 * MS)
    assert station.next_command() is None
    joined_meanwhile = station.joined
    assert len(send_queue) == before
    answered = master.frame(station)
    assert answered is not None
    assert answered.reply.join_request is None
    assert (joined_meanwhile, station.joined) == (False, True)
    assert station.rejected_beacons == 0


def test_restarted_master_is_joined_after_timeout() -> None:
    """It gets everything that the previous session did not acknowledge."""
    master, station, send_queue = joined()
    master.frame(station)
    send_queue.add(queued(0, master.now_ns))
    new = ScriptedMaster(session=0x222, now_ns=master.now_ns, zero_ns=master.now_ns)
    answers = [new.frame(station) for _ in range(12)]
    first = next(index for index, answered in enumerate(answers) if answered is not None)
    assert first == 7
    assert station.joined
    assert set(new.received) == {0}
    assert len(send_queue) == 0


def test_delayed_beacon_is_rejected() -> None:
    """Its time is not used; those of the following beacons are."""
    master, station, _ = joined()
    for _ in range(30):
        master.frame(station)
    assert station.rejected_beacons == 0
    master.frame(station, late_ns=20 * MS)
    payload = master.beacon()
    received = station.received(master.packet(payload))
    assert received is not None
    assert (received.time_rejected, received.reception, station.rejected_beacons) == (True, None, 1)
    for _ in range(5):
        master.frame(station)
    assert station.rejected_beacons == 1


def test_long_outage_ends_with_session_info() -> None:
    """After 256 frames the low bits of the frame counter are ambiguous."""
    master, station, _ = joined()
    master.counter += 1000
    master.session_interval = 8
    answers = [master.frame(station) for _ in range(16)]
    received = [answered is not None for answered in answers]
    assert received.index(True) == next(i for i in range(16) if (master.counter - 15 + i) % 8 == 0)
    assert all(received[received.index(True) :])


def collect(
    master: ScriptedMaster, station: SuperframeStation, instrument: Instrument, frames: int
) -> list[BeaconReception]:
    """Run frames; return the journalled receptions."""
    receptions = []
    for _ in range(frames):
        instrument.until(master.now_ns + master.frame_ns)
        received = station.received(master.packet(master.beacon()))
        assert received is not None
        if received.reception is not None:
            receptions.append(received.reception)
        reply = master.compose(station, received)
        assert reply is not None
        master.take(reply)
    return receptions


def test_restarted_station_continues() -> None:
    """The backlog arrives with accurate timestamps; delivered measurements are not repeated."""
    send_queue = SendQueue(0)
    master, instrument = ScriptedMaster(session_interval=4), Instrument(send_queue)
    source = counted()
    station = make_station(send_queue, random_bits=source)
    receptions = collect(master, station, instrument, 60)
    for _ in range(10):
        instrument.until(master.now_ns + master.frame_ns)
        master.frame(station, beacon_lost=True)
    backlog = list(send_queue.newest_first())[::-1]
    assert len(backlog) > 5
    first_sequence = max(instrument.made_ns) + 1 + RESTART_SKIP
    again = SendQueue(first_sequence, backlog)
    station = make_station(again, receptions=receptions, random_bits=source)
    answers = [master.frame(station) for _ in range(8)]
    taken = [answered for answered in answers if answered is not None]
    assert taken[0].reply.join_request is not None
    assert taken[0].reply.join_request.first_sequence == first_sequence
    assert taken[0].reply.join_request.oldest == backlog[0].sequence
    assert len(again) == 0
    for answered in taken:
        for number in answered.sequences:
            assert abs(answered.times_ns[number] - instrument.made_ns[number]) < 60_000


def test_reboot_keeps_timestamps_of_known_clocks() -> None:
    """The clock of the earlier boot is used; measurements without one stay in the journal."""
    send_queue = SendQueue(0)
    master, instrument = ScriptedMaster(session_interval=4), Instrument(send_queue)
    source = counted()
    station = make_station(send_queue, random_bits=source)
    receptions = collect(master, station, instrument, 60)
    for _ in range(6):
        instrument.until(master.now_ns + master.frame_ns)
        master.frame(station, beacon_lost=True)
    old = [replace(each, boot="old") for each in send_queue.newest_first()][::-1]
    older = [replace(queued(number, number), boot="older") for number in range(2)]
    again = SendQueue(5000, [*older, *old])
    moved = [replace(reception, boot="old") for reception in receptions]
    station = make_station(again, boot="new", receptions=moved, random_bits=source)
    received = station.received(master.packet(master.beacon(session=True)))
    assert received is not None
    reply = master.compose(station, received)
    assert reply is not None
    join_request = master.take(reply).reply.join_request
    assert join_request is not None
    assert join_request.oldest == old[0].sequence
    received = station.received(master.packet(master.beacon()))
    assert received is not None
    assert (received.joined, received.discarded) == (True, 2)
    for number, time_ns in master.received.items():
        assert abs(time_ns - instrument.made_ns[number]) < 150_000
    for _ in range(5):
        master.frame(station)
    assert {each.sequence for each in old} <= set(master.received)
    assert len(again) == 0


@pytest.mark.parametrize(("beacons", "expected"), [(4, set()), (5, {1000})])
def test_unconverged_clock_is_not_used_after_reboot(beacons: int, expected: set[int]) -> None:
    """Its beacons may have been delayed."""
    send_queue = SendQueue(0)
    master, instrument = ScriptedMaster(session_interval=1), Instrument(send_queue)
    source = counted()
    station = make_station(send_queue, random_bits=source)
    receptions = collect(master, station, instrument, 12)[:beacons]
    left = [replace(queued(1000, receptions[-1].received_ns), boot="old")]
    again = SendQueue(RESTART_SKIP + 1001, left)
    moved = [replace(reception, boot="old") for reception in receptions]
    station = make_station(again, boot="new", receptions=moved, random_bits=source)
    for _ in range(5):
        master.frame(station)
    assert {1000} & set(master.received) == expected
    assert len(again) == 0


def test_untimeable_measurements_do_not_block_others() -> None:
    """Measurements of an earlier boot, minutes and hours after its last beacon."""
    send_queue = SendQueue(0)
    master, instrument = ScriptedMaster(session_interval=4), Instrument(send_queue)
    source = counted()
    station = make_station(send_queue, random_bits=source)
    moved = [replace(each, boot="old") for each in collect(master, station, instrument, 60)]
    now_ns = master.now_ns
    near = [queued(1000 + n, now_ns + n * SECOND, boot="old") for n in range(5)]
    far = [queued(1005 + n, now_ns + (6 * 3600 + n) * SECOND, boot="old") for n in range(30)]
    again = SendQueue(RESTART_SKIP + 1035, [*near, *far])
    station = make_station(again, boot="new", receptions=moved, random_bits=source)
    for _ in range(40):
        master.frame(station)
    assert set(master.received) & {each.sequence for each in (*near, *far)} == {
        each.sequence for each in near
    }
    assert len(again) == 0


def test_measurements_long_before_first_beacon_are_discarded() -> None:
    """Younger ones are delivered, and the master waits for no others."""
    send_queue = SendQueue(0)
    master = ScriptedMaster(session_interval=4, now_ns=6 * 3600 * SECOND)
    for number in range(20):
        send_queue.add(queued(number, number * SECOND))
    for number in range(20, 40):
        send_queue.add(queued(number, (2 * 3600 + number) * SECOND))
    station = make_station(send_queue)
    for _ in range(100):
        master.frame(station)
    assert len(send_queue) == 0
    assert set(master.received) == set(range(20, 40))


def test_untimeable_measurements_between_beacons_do_not_block_others_after_reboot() -> None:
    """Made in the middle of an outage of 40 hours; those near either end are delivered."""
    send_queue, source = SendQueue(0), counted()
    master, station = ScriptedMaster(), make_station(send_queue, random_bits=source)
    receptions = collect(master, station, Instrument(SendQueue(0)), 60)
    for number in range(1200):
        master.now_ns += 120 * SECOND
        send_queue.add(queued(number, master.now_ns))
    master.grant = 0
    for _ in range(8):
        received = station.received(master.packet(master.beacon()))
        assert received is not None
        receptions += [] if received.reception is None else [received.reception]
    master.grant = len(GRANT_BYTES) - 1
    again = SendQueue(RESTART_SKIP + 1200, send_queue.oldest_first())
    station = make_station(again, boot="later", receptions=receptions, random_bits=source)
    for _ in range(120):
        master.frame(station)
    assert len(again) == 0
    delivered = sorted(number for number in master.received if number < 1200)
    assert {delivered[0], delivered[-1]} == {0, 1199}
    assert 400 < len(delivered) < 800


def test_old_measurements_of_short_queue_are_delivered() -> None:
    """One that needs a block of its own takes precedence once in a while."""
    master, station, send_queue = joined()
    send_queue.add(queued(0, master.now_ns - 40 * SECOND, prism=5))
    master.grant = GRANT_BYTES.index(26)
    for number in range(1, 8):
        send_queue.add(queued(number, master.now_ns + master.frame_ns))
        master.frame(station)
    assert 0 in master.received


def test_oldest_of_backlog_is_delivered_when_grants_fit_new_measurements_only() -> None:
    """A master that lacks a single old measurement grants no more, and its cumulative acknowledgement waits for it."""
    master, station, send_queue = joined()
    for number in range(12):
        send_queue.add(queued(number, master.now_ns - 60 * SECOND, prism=5))
    master.grant = GRANT_BYTES.index(26)
    for number in range(12, 48, 2):
        for each in (number, number + 1):
            send_queue.add(queued(each, master.now_ns + master.frame_ns))
        master.frame(station)
    assert 0 in master.received


def test_turnaround_of_previous_frame_is_reported() -> None:
    """From RxDone of the beacon to TxDone of the reply, at the master's clock rate."""
    master, station, _ = joined()
    answered = master.frame(station)
    assert answered is not None
    told_us = answered.reply.turnaround_us
    assert told_us is not None
    before_ns = TIMING.turnaround_ns + TIMING.airtime_ns(17) + TIMING.guard_ns
    reply_ns = 1000 * told_us - before_ns + TIMING.reception_ns
    assert any(abs(reply_ns - TIMING.airtime_ns(length)) < 2 * MS for length in range(5, 30))
    master.frame(station, beacon_lost=True)
    answered = master.frame(station)
    assert answered is not None
    assert answered.reply.turnaround_us is None
