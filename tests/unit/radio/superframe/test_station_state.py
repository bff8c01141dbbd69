"""State of one station at the master: timestamps, prisms, link delay, status, grants."""

from __future__ import annotations

from dataclasses import replace

import pytest
from harness.hardware.radios import MS
from harness.radio.scripted_stations import (
    TIMING,
    ZERO_NS,
    ScriptedFrames,
    measurement,
    older,
    scripted_frames,
)

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
"""Of the nominal link delay; see :class:`~tsgt.timesync.link_delay.LinkDelayEstimator`."""


@pytest.fixture
def frames() -> ScriptedFrames:
    """Three stations that have joined."""
    frames = scripted_frames()
    frames.join()
    return frames


def slot_us(frames: ScriptedFrames, station: int = 1) -> int:
    """Return the start of a station's slot in session time."""
    return frames.sent_us + frames.span(station).start_ns // 1000


# --- Times ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("age_ms", [-15, 0, 6, 400, 1000, 2000])
def test_narrow_time_is_unwrapped(frames: ScriptedFrames, age_ms: float) -> None:
    """From two seconds before the slot to slightly after it; the master adds the link delay."""
    frames.run(20)
    frames.begin()
    made_us = slot_us(frames) - round(1000 * age_ms)
    (found,) = frames.measure(1, age_ms=age_ms).measurements
    assert found.measured_ns == pytest.approx(ZERO_NS + 1000 * made_us + LINK_NS, abs=9 * US)
    assert found.bound_ns == pytest.approx(128 * US + 9 * US + LINK_BOUND_NS, abs=60 * US)
    assert 30 * US < found.sigma_ns < found.bound_ns / 3


def test_measurement_made_during_late_slot_is_not_wrapped(frames: ScriptedFrames) -> None:
    """A short reply may start late in a long slot."""
    frames.begin()
    made_us = slot_us(frames) + 50_000
    block = MeasurementBlock(measurements=(measurement(1, made_us),))
    (found,) = frames.reply(1, Reply(blocks=(block,)), sequence=1, late_ns=60 * MS).measurements
    assert found.measured_ns == pytest.approx(ZERO_NS + 1000 * made_us + LINK_NS, abs=9 * US)


@pytest.mark.parametrize("age_s", [3, 3600, 86_400, 12 * 86_400])
def test_wide_time_before_master_start(frames: ScriptedFrames, age_s: int) -> None:
    """Even before its clock was at zero."""
    frames.begin()
    made_us = slot_us(frames) - age_s * 1_000_000
    (found,) = frames.measure(1, age_ms=1000 * age_s, wide=True).measurements
    assert found.measured_ns == pytest.approx(ZERO_NS + 1000 * made_us + LINK_NS, abs=9 * US)


def test_session_time_wraps() -> None:
    """After 12.7 days on the air, but not in the timestamps."""
    frames = scripted_frames()
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


def test_block_is_decoded_oldest_first(frames: ScriptedFrames) -> None:
    """Numbers and times of older measurements are relative to the newest."""
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
def test_beacon_relative_time_counts_from_beacon(frames: ScriptedFrames, late_ms: float) -> None:
    """The lateness of the reply enlarges its bound."""
    frames.begin()
    made_us = slot_us(frames) - 120_000
    block = MeasurementBlock(
        measurements=(measurement(1, made_us, origin_us=frames.sent_us),), beacon_relative=True, quality=0
    )
    received = frames.reply(1, Reply(blocks=(block,)), sequence=1, late_ns=round(late_ms * MS))
    (found,) = received.measurements
    assert found.measured_ns == pytest.approx(ZERO_NS + 1000 * made_us + LINK_NS, abs=9 * US)
    assert received.lateness_ns == pytest.approx(late_ms * MS + 200 * US, abs=US)
    on_time_ns = 16 * US + 9 * US + LINK_BOUND_NS + 12 * US
    assert found.bound_ns == pytest.approx(on_time_ns + max(received.lateness_ns, 0), abs=60 * US)


def test_delay_is_visible_on_short_link(frames: ScriptedFrames) -> None:
    """Replies over a link shorter than the nominal one come early; delayed ones come on time."""
    frames.link_ns = TIMING.link_ns - 100 * US
    for _ in range(8):
        exchange(frames)
    late_us = 200
    frames.begin()
    made_us = slot_us(frames) - 120_000
    block = MeasurementBlock(
        measurements=(measurement(1, made_us - late_us, origin_us=frames.sent_us),),
        beacon_relative=True,
        quality=0,
    )
    received = frames.reply(1, Reply(blocks=(block,)), sequence=1, late_ns=late_us * US)
    assert received.lateness_ns == pytest.approx(0, abs=US)
    assert received.measurements[0].bound_ns > late_us * US


def test_inexact_beacon_timestamp_enlarges_bound(frames: ScriptedFrames) -> None:
    """By four sigma: 4 ms without the edge."""
    frames.begin(sigma_ns=MS)
    block = MeasurementBlock(
        measurements=(measurement(1, slot_us(frames) - 9000, origin_us=frames.sent_us),),
        beacon_relative=True,
        quality=0,
    )
    (found,) = frames.reply(1, Reply(blocks=(block,)), sequence=1).measurements
    assert 4 * MS < found.bound_ns < 5 * MS


@pytest.mark.parametrize(("quality", "bound_us"), [(0, 16), (4, 256), (15, 524_288)])
def test_quality_sets_bound(frames: ScriptedFrames, quality: int, bound_us: int) -> None:
    """The master adds the uncertainty of the link delay."""
    frames.begin()
    newest = measurement(2, slot_us(frames))
    block = MeasurementBlock(measurements=(newest, older(newest, 1)), quality=quality)
    found = frames.reply(1, Reply(blocks=(block,)), sequence=2).measurements[-1]
    assert found.bound_ns == pytest.approx(bound_us * US + 9 * US + LINK_BOUND_NS, abs=60 * US)
    assert found.sigma_ns >= bound_us * US / 4


def test_sequence_numbers_are_unwrapped(frames: ScriptedFrames) -> None:
    """After hundreds of measurements, and across a gap."""
    frames.run(600)
    assert frames.master.station(2).window.cumulative == 600
    frames.stations[2].sequence += 120
    frames.begin()
    assert frames.measure(2).measurements[0].sequence == 721
    assert frames.master.station(2).window.outstanding == 120


def test_negative_sequence_numbers_are_dropped(frames: ScriptedFrames) -> None:
    """The rest of the block is accepted."""
    frames.begin()
    newest = measurement(1, slot_us(frames))
    block = MeasurementBlock(measurements=(newest, older(newest, 2)))
    received = frames.reply(1, Reply(blocks=(block,)), sequence=1)
    assert [each.sequence for each in received.measurements] == [1]


# --- Prisms, status ---------------------------------------------------------------------------------------------


def test_prism_follows_status_report(frames: ScriptedFrames) -> None:
    """Initially that of the configuration; a block may name another."""
    frames.begin()
    assert frames.measure(2).measurements[0].prism == 2
    frames.end()
    frames.begin()
    frames.reply(2, Reply(status_report=replace(STATE, prism=5)))
    frames.end()
    frames.begin()
    block = MeasurementBlock(measurements=(measurement(2, slot_us(frames, 2)),))
    other = MeasurementBlock(measurements=(measurement(3, slot_us(frames, 2)),), prism=3)
    received = frames.reply(2, Reply(blocks=(block, other)), sequence=2)
    assert [(each.sequence, each.prism) for each in received.measurements] == [(2, 5), (3, 3)]


def test_status_counters_are_unwrapped(frames: ScriptedFrames) -> None:
    """From the first report on."""
    counts = []
    for missed, rejected in ((250, 14), (3, 1), (3, 1), (4, 1)):
        frames.begin()
        received = frames.reply(
            1, Reply(status_report=replace(STATE, missed_slots=missed, rejected_beacons=rejected))
        )
        counts.append(received.rejected_beacons)
        frames.end()
    assert counts == [0, 3, 0, 0]
    assert (frames.master.station(1).missed_slots, frames.master.station(1).rejected_beacons) == (10, 3)


# --- Link delay -------------------------------------------------------------------------------------------------


def exchange(
    frames: ScriptedFrames,
    *,
    late_ns: int = 0,
    off_us: int = 0,
    sigma_ns: int = 3000,
    sent_sigma_ns: int = 3000,
) -> bool:
    """Run a frame with a turnaround; return whether the master reports an anomaly."""
    frames.begin(sigma_ns=sent_sigma_ns)
    turnaround_us = frames.turnarounds_us[1] + off_us
    received = frames.reply(1, Reply(turnaround_us=turnaround_us), late_ns=late_ns, sigma_ns=sigma_ns)
    frames.end()
    return received.link_delay_anomaly


def link_error_ns(frames: ScriptedFrames) -> float:
    """Return the error of a timestamp caused by the link delay."""
    frames.begin()
    made_us = slot_us(frames) - 100_000
    (found,) = frames.measure(1).measurements
    frames.end()
    return found.measured_ns - (ZERO_NS + 1000 * made_us + frames.link_ns)


def test_link_delay_is_measured(frames: ScriptedFrames) -> None:
    """From four timestamps, however late a reply is."""
    assert link_error_ns(frames) == pytest.approx(-100_000, abs=9 * US)
    for late_ms in range(8):
        assert not exchange(frames, late_ns=late_ms * MS)
    assert link_error_ns(frames) == pytest.approx(0, abs=9 * US)


def test_delayed_reply_is_an_anomaly(frames: ScriptedFrames) -> None:
    """It took longer than the station states."""
    for _ in range(8):
        assert not exchange(frames)
    assert exchange(frames, off_us=-2000)
    assert link_error_ns(frames) == pytest.approx(0, abs=9 * US)


@pytest.mark.parametrize("which", ["sigma_ns", "sent_sigma_ns"])
def test_inexact_timestamps_measure_no_link_delay(frames: ScriptedFrames, which: str) -> None:
    """Of the beacon or of the reply, in this exchange and the next."""
    exchange(frames)
    exchange(frames, **{which: MS})
    assert not exchange(frames, off_us=5000)
    assert not exchange(frames)


def test_missed_frame_measures_no_link_delay(frames: ScriptedFrames) -> None:
    """A turnaround is that of the previous frame."""
    exchange(frames)
    frames.run(1, silent=(1,))
    assert not exchange(frames, off_us=5000)


# --- Grants ---------------------------------------------------------------------------------------------------------


def granted(frames: ScriptedFrames, station: int = 1) -> int:
    """Return a station's grant in the next frame, in bytes; no station replies."""
    frames.begin()
    found = GRANT_BYTES[frames.beacon.stations[station - 1].grant]
    frames.end()
    return found


def converged() -> ScriptedFrames:
    """Return stations with a measured link delay."""
    frames = scripted_frames()
    frames.join()
    for _ in range(9):
        frames.begin()
        for station in (1, 2, 3):
            frames.reply(station, Reply(turnaround_us=frames.turnarounds_us[station]))
        frames.end()
    frames.run(12)
    return frames


def test_grant_of_one_measurement() -> None:
    """17 bytes, and 26 with a turnaround in one of 32 frames."""
    frames = converged()
    found = []
    for _ in range(64):
        frames.run(1)
        found += [GRANT_BYTES[entry.grant] for entry in frames.beacon.stations]
    assert sorted(set(found)) == [17, 26]
    assert found.count(26) == 3 * 64 / 32


def test_silent_station_gets_larger_grants() -> None:
    """Until it may be absent."""
    frames = converged()
    found = []
    for _ in range(8):
        frames.run(1, silent=(1,))
        found.append(GRANT_BYTES[frames.beacon.stations[0].grant])
    assert found[:3] == [17, 26, 35]
    assert max(found[3:6]) > 44
    assert set(found[6:]) == {44}


def test_instrument_latency_is_learnt() -> None:
    """Measurements younger than any before get no room."""
    frames = converged()
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


def test_outstanding_measurements_are_granted() -> None:
    """Up to the cap, and no more if the station had room and did not send them."""
    frames = converged()
    frames.stations[1].sequence += 50
    frames.run(1)
    assert granted(frames) == 71
    frames.begin()
    frames.measure(1)  # and leave room for more
    frames.end()
    assert granted(frames) <= 26


def test_grant_continues_while_outstanding_ones_arrive() -> None:
    """The next one may need a block of its own."""
    frames = converged()
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


def test_unrecorded_measurements_are_granted_again() -> None:
    """The station repeats them."""
    frames = converged()
    frames.writes = False
    frames.run(1)
    assert granted(frames) >= 26


def test_restarted_station_repeats_backlog() -> None:
    """Until a reply leaves room."""
    frames = converged()
    station = frames.stations[1]
    last = station.sequence - 1
    station.nonce, station.oldest, station.first_sequence = 0xF00D, last - 9, last + 1001
    station.sequence = station.first_sequence
    frames.begin()
    frames.measure(1, join=True)
    frames.end()
    frames.begin()
    newest = measurement(last, slot_us(frames) - 10_000_000, wide=True)
    block = MeasurementBlock(measurements=(newest, *(older(newest, back) for back in (1, 2, 3))), wide=True)
    assert frames.reply(1, Reply(blocks=(block,)), sequence=last).repeated == 4
    frames.end()
    assert granted(frames) == 71
    frames.begin()
    frames.measure(1)  # and leave room for more
    frames.end()
    assert granted(frames) <= 26


def test_worse_quality_gets_larger_grant() -> None:
    """Also after a reply without measurements."""
    frames = converged()
    frames.begin()
    number = frames.stations[1].next_number()
    block = MeasurementBlock(measurements=(measurement(number, slot_us(frames)),), quality=5)
    frames.reply(1, Reply(blocks=(block,)), sequence=number)
    frames.reply(2, Reply())
    frames.end()
    frames.begin()
    assert [GRANT_BYTES[entry.grant] for entry in frames.beacon.stations[:2]] == [21, 30]  # and a turnaround


def test_pending_command_gets_room_for_response() -> None:
    """And for a single measurement."""
    frames = converged()
    frames.master.station(1).submit(MeasureCommand())
    assert granted(frames) >= 30


def test_max_grant_depends_on_station_count() -> None:
    """With eight stations a reply may have 15 measurements; with sixteen the frame limits it."""
    caps = {}
    for count in (7, 8, 16):
        frames = scripted_frames(range(1, count + 1))
        frames.join()
        frames.begin()
        for station in range(1, count + 1):
            newest = measurement(60, slot_us(frames, station))
            block = MeasurementBlock(measurements=(newest, *(older(newest, back) for back in range(1, 4))))
            frames.reply(station, Reply(blocks=(block,)), sequence=60)
        frames.end()
        caps[count] = granted(frames)
    assert caps == {7: 71, 8: 107, 16: 89}


def test_values_round_trip(frames: ScriptedFrames) -> None:
    """Within half a unit, far and near; no distance stays None."""
    frames.begin()
    far = MeasurementBlock(
        measurements=(EncodedMeasurement(1, 0, Status.OK, angle_code(6.2), angle_code(4.0), 2_000_000),),
        far=True,
    )
    none = MeasurementBlock(measurements=(EncodedMeasurement(2, 0, Status.ANGLE_ONLY, 1, 2, None),))
    received = frames.reply(1, Reply(blocks=(none, far)), sequence=2)
    assert [each.slope_distance_m for each in received.measurements] == [2000.0, None]
    assert received.measurements[0].horizontal_angle_rad == pytest.approx(6.2, abs=2e-7)
    assert received.measurements[1].status is Status.ANGLE_ONLY
