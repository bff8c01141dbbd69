"""One station as the master knows it: times, prisms, link constant, state, and what it is granted."""

from __future__ import annotations

from dataclasses import replace

import pytest
from harness.frames import TIMING, ZERO_NS, Frames, frames_of, measurement, older
from harness.radios import MS

from tsgt.model import Status
from tsgt.radio import MeasureCommand
from tsgt.radio.superframe.wire import (
    GRANT_BYTES,
    EncodedMeasurement,
    MeasurementBlock,
    Reply,
    StatusReport,
    angle_code,
)

STATE = StatusReport(prism=1, direct=False, connected=True, missed_slots=0, rejected_beacons=0, rssi_dbm=-80)
US = 1_000
LINK_NS = TIMING.link_ns
LINK_BOUND_NS = 0.2 * 2_048_000
"""While it has not been measured; see :class:`~tsgt.timesync.link_delay.LinkDelayEstimator`."""


@pytest.fixture
def frames() -> Frames:
    """Three stations that have joined."""
    frames = frames_of()
    frames.join()
    return frames


def slot_us(frames: Frames, station: int = 1) -> int:
    """Return when a station's slot begins, in session time."""
    return frames.sent_us + frames.span(station).start_ns // 1000


# --- Times ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("age_ms", [-15, 0, 6, 400, 1000, 2000])
def test_a_narrow_time_is_found_again(frames: Frames, age_ms: float) -> None:
    """From two seconds before the slot to a little after it; the master adds the link constant."""
    frames.run(20)
    frames.begin()
    made_us = slot_us(frames) - round(1000 * age_ms)
    (found,) = frames.measure(1, age_ms=age_ms).measurements
    assert found.measured_ns == pytest.approx(ZERO_NS + 1000 * made_us + LINK_NS, abs=9 * US)
    assert found.bound_ns == pytest.approx(128 * US + 9 * US + LINK_BOUND_NS, abs=60 * US)
    assert 30 * US < found.sigma_ns < found.bound_ns / 3


def test_a_measurement_made_within_the_slot_of_a_late_reply_is_not_two_seconds_older(frames: Frames) -> None:
    """A short reply in a long slot may begin late, and say what was measured meanwhile."""
    frames.begin()
    made_us = slot_us(frames) + 50_000
    run = MeasurementBlock(measurements=(measurement(1, made_us),))
    (found,) = frames.reply(1, Reply(blocks=(run,)), sequence=1, late_ns=60 * MS).measurements
    assert found.measured_ns == pytest.approx(ZERO_NS + 1000 * made_us + LINK_NS, abs=9 * US)


@pytest.mark.parametrize("age_s", [3, 3600, 86_400, 12 * 86_400])
def test_a_wide_time_may_lie_long_before_the_masters_start(frames: Frames, age_s: int) -> None:
    """Even before its clock was at zero."""
    frames.begin()
    made_us = slot_us(frames) - age_s * 1_000_000
    (found,) = frames.measure(1, age_ms=1000 * age_s, wide=True).measurements
    assert found.measured_ns == pytest.approx(ZERO_NS + 1000 * made_us + LINK_NS, abs=9 * US)


def test_session_time_may_go_round() -> None:
    """After 12.7 days it begins again on the air, but not here."""
    frames = frames_of()
    frames.join()
    frames.run(1)
    frames.now_ns = ZERO_NS + (1 << 40) * 1000 - 100 * MS
    frames.begin()
    frames.end()
    frames.begin()
    assert frames.sent_us < 10_000_000
    (found,) = frames.measure(1, age_ms=1500).measurements
    made_ns = frames.sent_ns + frames.span(1).start_ns - 1500 * MS
    assert found.measured_ns == pytest.approx(made_ns + LINK_NS, abs=9 * US)


def test_the_measurements_of_a_run_follow_each_other(frames: Frames) -> None:
    """Newest first on the air, oldest first from here; numbers and times of the older ones hang on the newest."""
    frames.run(4)
    frames.begin()
    newest_us = slot_us(frames) - 50_000
    newest = measurement(7, newest_us)
    measurements = (newest, older(newest, 1), older(newest, 2))
    found = frames.reply(
        1, Reply(blocks=(MeasurementBlock(measurements=measurements),)), sequence=7
    ).measurements
    assert [each.sequence for each in found] == [5, 6, 7]
    assert [(found[-1].measured_ns - each.measured_ns) / MS for each in found] == pytest.approx(
        [800, 400, 0], abs=0.02
    )
    assert found[0].horizontal_angle_rad == pytest.approx(5 / 1000, abs=2e-7)
    assert found[0].zenith_angle_rad == pytest.approx(1.5, abs=2e-7)
    assert found[0].slope_distance_m == 75.0


@pytest.mark.parametrize("late_ms", [-0.5, 0.0, 4.0])
def test_a_direct_time_counts_from_this_frames_beacon(frames: Frames, late_ms: float) -> None:
    """It is worth no more than the beacon was on time, which the reply's lateness tells."""
    frames.begin()
    made_us = slot_us(frames) - 120_000
    run = MeasurementBlock(
        measurements=(measurement(1, made_us, origin_us=frames.sent_us),), beacon_relative=True, quality=0
    )
    heard = frames.reply(1, Reply(blocks=(run,)), sequence=1, late_ns=round(late_ms * MS))
    (found,) = heard.measurements
    assert found.measured_ns == pytest.approx(ZERO_NS + 1000 * made_us + LINK_NS, abs=9 * US)
    assert heard.lateness_ns == pytest.approx(late_ms * MS + 200 * US, abs=US)
    on_time_ns = 16 * US + 9 * US + LINK_BOUND_NS + 12 * US
    assert found.bound_ns == pytest.approx(on_time_ns + max(heard.lateness_ns, 0), abs=60 * US)


def test_a_delay_does_not_hide_in_a_short_link(frames: Frames) -> None:
    """Replies over a link that is shorter than the nominal one come early; held back, they come on time."""
    frames.link_ns = TIMING.link_ns - 100 * US
    for _ in range(8):
        exchange(frames)
    late_us = 200
    frames.begin()
    made_us = slot_us(frames) - 120_000
    run = MeasurementBlock(
        measurements=(measurement(1, made_us - late_us, origin_us=frames.sent_us),),
        beacon_relative=True,
        quality=0,
    )
    heard = frames.reply(1, Reply(blocks=(run,)), sequence=1, late_ns=late_us * US)
    assert heard.lateness_ns == pytest.approx(0, abs=US)
    assert heard.measurements[0].bound_ns > late_us * US


def test_a_direct_time_is_worth_no_more_than_the_masters_stamp(frames: Frames) -> None:
    """Where the edge of the beacon's end was lost, four milliseconds."""
    frames.begin(sigma_ns=MS)
    run = MeasurementBlock(
        measurements=(measurement(1, slot_us(frames) - 9000, origin_us=frames.sent_us),),
        beacon_relative=True,
        quality=0,
    )
    (found,) = frames.reply(1, Reply(blocks=(run,)), sequence=1).measurements
    assert 4 * MS < found.bound_ns < 5 * MS


@pytest.mark.parametrize(("quality", "bound_us"), [(0, 16), (4, 256), (15, 524_288)])
def test_a_worse_time_says_so(frames: Frames, quality: int, bound_us: int) -> None:
    """The quality is what the station claims; the master adds what it knows of its own part."""
    frames.begin()
    newest = measurement(2, slot_us(frames))
    run = MeasurementBlock(measurements=(newest, older(newest, 1)), quality=quality)
    found = frames.reply(1, Reply(blocks=(run,)), sequence=2).measurements[-1]
    assert found.bound_ns == pytest.approx(bound_us * US + 9 * US + LINK_BOUND_NS, abs=60 * US)
    assert found.sigma_ns >= bound_us * US / 4


def test_numbers_are_found_again_far_beyond_their_bits(frames: Frames) -> None:
    """After hundreds of measurements, and across a gap."""
    frames.run(600)
    assert frames.master.station(2).window.cumulative == 600
    frames.stations[2].sequence += 120
    frames.begin()
    assert frames.measure(2).measurements[0].sequence == 721
    assert frames.master.station(2).window.outstanding == 120


def test_a_run_that_reaches_below_zero_is_cut(frames: Frames) -> None:
    """No station has measurements before its first; one that says so is believed in the rest."""
    frames.begin()
    newest = measurement(1, slot_us(frames))
    run = MeasurementBlock(measurements=(newest, older(newest, 2)))
    heard = frames.reply(1, Reply(blocks=(run,)), sequence=1)
    assert [each.sequence for each in heard.measurements] == [1]


# --- Prisms, state --------------------------------------------------------------------------------------------------


def test_the_prism_is_what_the_station_told(frames: Frames) -> None:
    """That of the configuration, until the station has told another; a run may name one itself."""
    frames.begin()
    assert frames.measure(2).measurements[0].prism == 2
    frames.end()
    frames.begin()
    frames.reply(2, Reply(status_report=replace(STATE, prism=5)))
    frames.end()
    frames.begin()
    run = MeasurementBlock(measurements=(measurement(2, slot_us(frames, 2)),))
    other = MeasurementBlock(measurements=(measurement(3, slot_us(frames, 2)),), prism=3)
    heard = frames.reply(2, Reply(blocks=(run, other)), sequence=2)
    assert [(each.sequence, each.prism) for each in heard.measurements] == [(2, 5), (3, 3)]


def test_late_slots_and_rejected_beacons_are_counted_on(frames: Frames) -> None:
    """What the station tells are low bits; what it counted before it was first heard does not matter."""
    told = []
    for late, doubted in ((250, 14), (3, 1), (3, 1), (4, 1)):
        frames.begin()
        heard = frames.reply(
            1, Reply(status_report=replace(STATE, missed_slots=late, rejected_beacons=doubted))
        )
        told.append(heard.rejected_beacons)
        frames.end()
    assert told == [0, 3, 0, 0]
    assert (frames.master.station(1).missed_slots, frames.master.station(1).rejected_beacons) == (10, 3)


# --- Link constant --------------------------------------------------------------------------------------------------


def exchange(
    frames: Frames, *, late_ns: int = 0, off_us: int = 0, sigma_ns: int = 3000, sent_sigma_ns: int = 3000
) -> bool:
    """Run a frame in which the station says how long its last reply took; return whether that is doubted."""
    frames.begin(sigma_ns=sent_sigma_ns)
    turnaround_us = frames.turnarounds_us[1] + off_us
    heard = frames.reply(1, Reply(turnaround_us=turnaround_us), late_ns=late_ns, sigma_ns=sigma_ns)
    frames.end()
    return heard.link_delay_anomaly


def link_error_ns(frames: Frames) -> float:
    """How far the constant is off that a measurement is stamped with."""
    frames.begin()
    made_us = slot_us(frames) - 100_000
    (found,) = frames.measure(1).measurements
    frames.end()
    return found.measured_ns - (ZERO_NS + 1000 * made_us + frames.link_ns)


def test_the_link_constant_is_measured(frames: Frames) -> None:
    """From four stamps: however late a reply is, the constant comes out."""
    assert link_error_ns(frames) == pytest.approx(-100_000, abs=9 * US)
    for late_ms in range(8):
        assert not exchange(frames, late_ns=late_ms * MS)
    assert link_error_ns(frames) == pytest.approx(0, abs=9 * US)


def test_a_reply_that_somebody_held_back_is_told(frames: Frames) -> None:
    """It took longer than the station says, by more than any radio does."""
    for _ in range(8):
        assert not exchange(frames)
    assert exchange(frames, off_us=-2000)
    assert link_error_ns(frames) == pytest.approx(0, abs=9 * US)


@pytest.mark.parametrize("which", ["sigma_ns", "sent_sigma_ns"])
def test_a_stamp_without_an_edge_measures_nothing(frames: Frames, which: str) -> None:
    """Neither of the beacon nor of the reply; the frame after that is not judged by it."""
    exchange(frames)
    exchange(frames, **{which: MS})
    assert not exchange(frames, off_us=5000)
    assert not exchange(frames)


def test_a_missed_frame_measures_nothing(frames: Frames) -> None:
    """The turn-round is that of the frame before, or none."""
    exchange(frames)
    frames.run(1, silent=(1,))
    assert not exchange(frames, off_us=5000)


# --- Grants ---------------------------------------------------------------------------------------------------------


def granted(frames: Frames, station: int = 1) -> int:
    """Return what a station is granted in the next frame, in bytes; the frame ends without anybody."""
    frames.begin()
    found = GRANT_BYTES[frames.beacon.stations[station - 1].grant]
    frames.end()
    return found


def settled() -> Frames:
    """Stations whose link is known, a good while after the start."""
    frames = frames_of()
    frames.join()
    for _ in range(9):
        frames.begin()
        for station in (1, 2, 3):
            frames.reply(station, Reply(turnaround_us=frames.turnarounds_us[station]))
        frames.end()
    frames.run(12)
    return frames


def test_one_measurement_needs_seventeen_bytes() -> None:
    """In most frames; now and then there is room for a turn-round as well."""
    frames = settled()
    found = []
    for _ in range(64):
        frames.run(1)
        found += [GRANT_BYTES[entry.grant] for entry in frames.beacon.stations]
    assert sorted(set(found)) == [17, 26]
    assert found.count(26) == 3 * 64 / 32


def test_whoever_was_not_heard_gets_room_for_what_has_come_up_since() -> None:
    """Until it has been silent for so long that it may be gone."""
    frames = settled()
    found = []
    for _ in range(8):
        frames.run(1, silent=(1,))
        found.append(GRANT_BYTES[frames.beacon.stations[0].grant])
    assert found[:3] == [17, 26, 35]
    assert max(found[3:6]) > 44
    assert set(found[6:]) == {44}


def test_what_an_instrument_needs_is_learnt_from_its_replies() -> None:
    """Replies whose newest measurement is never younger than 300 ms get no room for one that is."""
    frames = settled()
    frames.run(32)
    frames.begin()
    room = GRANT_BYTES[frames.beacon.stations[0].grant]
    frames.end()
    for _ in range(32):
        frames.begin()
        for station in frames.stations:
            frames.measure(station, age_ms=300)
        frames.end()
    station_state = frames.master._stations[1]
    assert station_state.demand.ready_us == pytest.approx(300_000, abs=12_000)
    assert granted(frames) <= room


def test_missing_measurements_are_asked_for() -> None:
    """As many as the cap allows; no more when the station does not send them though it could."""
    frames = settled()
    frames.stations[1].sequence += 50
    frames.run(1)
    assert granted(frames) == 71
    frames.begin()
    frames.measure(1)  # and it had room for more
    frames.end()
    assert granted(frames) <= 26


def test_a_station_that_sends_what_was_missing_is_granted_on() -> None:
    """Though it left room: the next older one may need a run of its own, which takes more than that."""
    frames = settled()
    station = frames.stations[1]
    first_missing = station.sequence
    station.sequence += 50
    frames.run(1)
    frames.begin()
    old = measurement(first_missing + 20, slot_us(frames) - 10_000_000, wide=True)
    frames.reply(
        1, Reply(blocks=(MeasurementBlock(measurements=(old,), wide=True),)), sequence=first_missing + 20
    )
    frames.end()
    assert granted(frames) == 71


def test_what_is_not_written_yet_comes_again() -> None:
    """The station cannot know that it has been received."""
    frames = settled()
    frames.writes = False
    frames.run(1)
    assert granted(frames) >= 26


def test_what_an_earlier_run_has_left_comes_again() -> None:
    """A station that has started again cannot know what of it has come; until it leaves room, it has more of it."""
    frames = settled()
    station = frames.stations[1]
    last = station.sequence - 1
    station.nonce, station.oldest, station.first_sequence = 0xF00D, last - 9, last + 1001
    station.sequence = station.first_sequence
    frames.begin()
    frames.measure(1, introduce=True)
    frames.end()
    frames.begin()
    newest = measurement(last, slot_us(frames) - 10_000_000, wide=True)
    run = MeasurementBlock(measurements=(newest, *(older(newest, back) for back in (1, 2, 3))), wide=True)
    assert frames.reply(1, Reply(blocks=(run,)), sequence=last).repeated == 4
    frames.end()
    assert granted(frames) == 71
    frames.begin()
    frames.measure(1)  # and it had room for more
    frames.end()
    assert granted(frames) <= 26


def test_a_measurement_of_a_worse_quality_gets_the_room_that_it_takes() -> None:
    """As soon as one has come, or none has though there should be one."""
    frames = settled()
    frames.begin()
    number = frames.stations[1].next_number()
    run = MeasurementBlock(measurements=(measurement(number, slot_us(frames)),), quality=5)
    frames.reply(1, Reply(blocks=(run,)), sequence=number)
    frames.reply(2, Reply())
    frames.end()
    frames.begin()
    assert [GRANT_BYTES[entry.grant] for entry in frames.beacon.stations[:2]] == [21, 30]  # and a turn-round


def test_an_order_gets_room_for_its_answer() -> None:
    """A shot takes more."""
    frames = settled()
    frames.master.station(1).submit(MeasureCommand())
    assert granted(frames) >= 30


def test_many_stations_may_send_more_at_once_but_not_all_of_them() -> None:
    """With eight a reply may hold fifteen measurements; with sixteen a frame in which all do would be too long."""
    caps = {}
    for count in (7, 8, 16):
        frames = frames_of(range(1, count + 1))
        frames.join()
        frames.begin()
        for station in range(1, count + 1):
            newest = measurement(60, slot_us(frames, station))
            run = MeasurementBlock(measurements=(newest, *(older(newest, back) for back in range(1, 4))))
            frames.reply(station, Reply(blocks=(run,)), sequence=60)
        frames.end()
        caps[count] = granted(frames)
    assert caps == {7: 71, 8: 107, 16: 89}


def test_angles_and_distance_come_back_as_they_were(frames: Frames) -> None:
    """Within half a unit of the air, far and near; no distance stays none."""
    frames.begin()
    far = MeasurementBlock(
        measurements=(EncodedMeasurement(1, 0, Status.OK, angle_code(6.2), angle_code(4.0), 2_000_000),),
        far=True,
    )
    none = MeasurementBlock(measurements=(EncodedMeasurement(2, 0, Status.ANGLE_ONLY, 1, 2, None),))
    heard = frames.reply(1, Reply(blocks=(none, far)), sequence=2)
    assert [each.slope_distance_m for each in heard.measurements] == [2000.0, None]
    assert heard.measurements[0].horizontal_angle_rad == pytest.approx(6.2, abs=2e-7)
    assert heard.measurements[1].status is Status.ANGLE_ONLY
