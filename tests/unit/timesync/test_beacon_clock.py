"""The master's session time on a station's clock."""

from __future__ import annotations

import numpy as np
import pytest

from tsgt.timesync import BeaconClock, beacon_clock

FRAME_NS = 400_000_000
START_NS = 5_000_000_000_000
SIGMA_NS = 10_000


def received_ns(session_us: float, ppm: float = 0.0) -> int:
    """Return the reception on a station's clock that runs fast by ``ppm``."""
    return START_NS + round(1000 * session_us * (1 + ppm / 1e6))


def clock_with(pairs: int, *, ppm: float = 0.0, jitter_us: float = 0.0, seed: int = 0) -> BeaconClock:
    """Return a clock with samples 0.4 s apart."""
    clock, rng = BeaconClock(), np.random.default_rng(seed)
    for k in range(pairs):
        late_ns = round(1000 * rng.normal(0.0, jitter_us)) if jitter_us else 0
        assert clock.add(received_ns(sent_us(k), ppm) + late_ns, sent_us(k), SIGMA_NS, unambiguous=k < 2)
    return clock


def sent_us(k: int) -> int:
    """Return the session time at which beacon k is sent."""
    return 7_000 + k * FRAME_NS // 1000


def test_without_samples_only_durations_are_known() -> None:
    """There is no time and no unwrapping; a duration is that of the own clock within 120 ppm."""
    clock = BeaconClock()
    assert clock.at(START_NS) is None
    assert clock.unwrap(START_NS, 5, SIGMA_NS) is None
    assert clock.last_received_ns is None
    assert clock.samples == 0
    assert clock.elapsed(START_NS, START_NS + FRAME_NS)[::2] == pytest.approx((400_000.0, 48.0))


def test_single_sample_gives_no_time() -> None:
    """Its beacon may be delayed by any time, so it does not unwrap the low bits of others either."""
    clock = clock_with(1)
    assert clock.at(received_ns(sent_us(0))) is None
    assert clock.unwrap(received_ns(sent_us(1)), sent_us(1) & 0xFFFF, SIGMA_NS) is None
    assert clock.elapsed(START_NS, START_NS + FRAME_NS)[::2] == pytest.approx((400_000.0, 48.0))


def test_two_samples_give_a_bounded_time() -> None:
    """The bound covers coarse timestamps of the master, and the skew is hardly known."""
    clock = clock_with(2)
    at, later = clock.at(received_ns(sent_us(1))), clock.at(received_ns(sent_us(1) + 60e6, ppm=100))
    assert at is not None
    assert later is not None
    assert at.time_us == pytest.approx(sent_us(1))
    assert at.bound_us == pytest.approx(3_540, rel=0.01)
    assert abs(later.time_us - sent_us(1) - 60e6) < later.bound_us < 20_000


def test_two_inconsistent_first_samples_give_no_time() -> None:
    """One of them is delayed by 248 ms. The third sample decides which."""
    for held in (0, 1):
        clock = BeaconClock()
        taken = []
        for k in range(4):
            late_us = 248_000 if k == held else 0
            taken.append(clock.add(received_ns(sent_us(k) + late_us), sent_us(k), SIGMA_NS, unambiguous=True))
            if k == 1:
                assert clock.at(received_ns(sent_us(1))) is None
        at = clock.at(received_ns(sent_us(0)))
        assert at is not None
        assert abs(at.time_us - sent_us(0)) <= at.bound_us
        assert taken.count(False) == 1 + held


def test_reception_noticed_late_does_not_unwrap() -> None:
    """A chip that is polled every 100 ms gives a time within 50 ms: a beacon of 40 ms later has other low bits."""
    clock = clock_with(150)
    full = sent_us(150)
    polled_ns = received_ns(full + 40_000)
    assert clock.unwrap(polled_ns, full & 0xFFFF, SIGMA_NS) == full + 0x10000  # as if it were exact
    assert clock.unwrap(polled_ns, full & 0xFFFF, round(100e6 / 12**0.5)) is None


def test_ambiguous_samples_give_no_time() -> None:
    """Any number of ambiguous samples does not initialise the clock."""
    clock = BeaconClock()
    assert not any(clock.add(received_ns(sent_us(k)), sent_us(k), SIGMA_NS) for k in range(10))
    assert clock.at(received_ns(sent_us(5))) is None


def test_ambiguity_of_the_low_bits_is_in_the_bound() -> None:
    """A sample that seems to be 14 ms off may be off by 65.5 ms more."""
    clock = clock_with(150)
    clock.add(received_ns(sent_us(150) + 14_000), sent_us(150), SIGMA_NS)
    at = clock.at(received_ns(sent_us(150) + 14_000))
    assert at is not None
    assert at.bound_us > 14_000 + 65_536


@pytest.mark.parametrize("ppm", [-100.0, 0.0, 100.0])
def test_skew_is_followed(ppm: float) -> None:
    """After a minute of samples the time is accurate to some us, between and after them."""
    clock = clock_with(150, ppm=ppm, jitter_us=28)
    for session_us in (5e6, sent_us(149) + 0.6e6):
        at = clock.at(received_ns(session_us, ppm))
        assert at is not None
        assert at.time_us == pytest.approx(session_us, abs=20)
        assert at.bound_us < 128


def test_time_before_the_first_sample_is_extrapolated() -> None:
    """Measurements before the first beacon are timed with the skew found after it."""
    at = clock_with(150, ppm=50).at(received_ns(-10e6, 50))
    assert at is not None
    assert abs(at.time_us + 10e6) < min(at.bound_us, 20)


def test_duration_is_corrected_by_the_skew() -> None:
    """Between two instants after the last sample 0.3 s are accurate to some us."""
    clock = clock_with(150, ppm=80, jitter_us=28)
    from_us = sent_us(150)
    elapsed = clock.elapsed(received_ns(from_us, 80), received_ns(from_us + 300_000, 80))
    assert elapsed.time_us == pytest.approx(300_000, abs=1)
    assert elapsed.bound_us < 30
    assert clock.elapsed(received_ns(from_us, 80), received_ns(from_us - 300_000, 80)).time_us < 0


def test_a_long_duration_is_the_difference_of_its_ends() -> None:
    """Over a minute both ends are known better than the skew."""
    clock = clock_with(150, ppm=80, jitter_us=28)
    elapsed = clock.elapsed(received_ns(1e6, 80), received_ns(58e6, 80))
    assert elapsed.time_us == pytest.approx(57e6, abs=20)
    assert elapsed.bound_us < 300


def test_low_bits_are_unwrapped() -> None:
    """The 16 low bits of a time and the reception of its beacon give the full time."""
    clock = clock_with(150, ppm=50)
    for frames in (1, 2, 250):
        full = sent_us(149 + frames)
        assert clock.unwrap(received_ns(full, 50), full & 0xFFFF, SIGMA_NS) == full


def test_low_bits_are_ambiguous_after_a_long_outage() -> None:
    """An hour after the last sample more than one time is possible."""
    assert clock_with(150).unwrap(received_ns(3.6e9), 0, SIGMA_NS) is None


def test_delayed_beacon_is_rejected() -> None:
    """A sample 0.3 ms off does not change the fit, but until the next one the bound contains it."""
    clock = clock_with(150, jitter_us=28)
    late_us, before = 300, clock.at(received_ns(sent_us(150)))
    assert not clock.add(received_ns(sent_us(150) + late_us), sent_us(150), SIGMA_NS)
    during, next_us = clock.at(received_ns(sent_us(150))), sent_us(151)
    assert clock.add(received_ns(next_us), next_us, SIGMA_NS)
    after = clock.at(received_ns(next_us))
    assert before is not None
    assert during is not None
    assert after is not None
    assert during.time_us == before.time_us
    assert during.bound_us > late_us
    assert after.bound_us < 128


@pytest.mark.parametrize("late_us", [500, 1_000, 2_000, 4_000, 6_000])
@pytest.mark.parametrize(("away_s", "again_s"), [(60, 30), (180, 30), (180, 120), (300, 120)])
def test_single_beacon_in_a_long_outage_waits_for_confirmation(
    away_s: int, again_s: int, late_us: int
) -> None:
    """After a long outage any delay is consistent, so the sample does not count together with later ones."""
    clock, alone = clock_with(150), 150 + round(2.5 * away_s)
    back = alone + round(2.5 * again_s)
    clock.add(received_ns(sent_us(alone)) + 1000 * late_us, sent_us(alone), SIGMA_NS)
    for k in range(back, back + 10):
        assert clock.add(received_ns(sent_us(k)), sent_us(k), SIGMA_NS)
        for before in range(150, k, 10):
            at = clock.at(received_ns(sent_us(before)))
            assert at is not None
            assert abs(at.time_us - sent_us(before)) <= at.bound_us
    assert clock.samples == 160


def test_long_delayed_beacon_does_not_prevent_unwrapping() -> None:
    """Its sample is 40 ms off; the low bits of the next ones are still unwrapped."""
    clock = clock_with(150)
    clock.add(received_ns(sent_us(150) + 40_000), sent_us(150), SIGMA_NS)
    assert clock.unwrap(received_ns(sent_us(152)), sent_us(152) & 0xFFFF, SIGMA_NS) == sent_us(152)


def test_replayed_beacons_never_outvote_the_fit() -> None:
    """Samples without a live one never start a segment, however many agree."""
    clock = clock_with(150)
    for k in range(150, 180):
        assert not clock.add(received_ns(sent_us(k + 50)), sent_us(k), SIGMA_NS, unambiguous=True, live=False)
    at = clock.at(received_ns(sent_us(230)))
    assert at is not None
    assert abs(at.time_us - sent_us(230)) < 1000


def test_bound_holds_before_outvoted_first_samples() -> None:
    """Two delayed first samples define neither their own time nor earlier ones."""
    clock = BeaconClock()
    for k in range(2):
        clock.add(received_ns(sent_us(k) + 30_000), sent_us(k), SIGMA_NS, unambiguous=True)
    for k in range(2, 10):
        clock.add(received_ns(sent_us(k)), sent_us(k), SIGMA_NS, unambiguous=True)
        for early_us in (sent_us(0) - 20_000_000, sent_us(0)):
            at = clock.at(received_ns(early_us))
            assert at is not None
            assert abs(at.time_us - early_us) <= at.bound_us


@pytest.mark.parametrize("delayed", [(9,), (9, 11), (8, 9), (0, 6, 10), (0, 1, 5, 10)])
@pytest.mark.parametrize("late_us", [3_000, 5_000, 6_500])
def test_bound_holds_with_equally_delayed_early_samples(late_us: int, delayed: tuple[int, ...]) -> None:
    """Up to four before the jitter is known: it then shows that they do not belong to the others."""
    clock = BeaconClock()
    for k in range(40):
        late_ns = 1000 * late_us if k in delayed else 0
        clock.add(received_ns(sent_us(k)) + late_ns, sent_us(k), SIGMA_NS, unambiguous=True)
        if clock.converged:
            for back_us in (0, 500_000, 2_000_000, 8_000_000, 20_000_000):
                at = clock.at(received_ns(sent_us(k) - back_us))
                assert at is not None
                assert abs(at.time_us - sent_us(k) + back_us) <= at.bound_us


def test_slewed_clock_is_followed_within_seconds() -> None:
    """NTP slews the clock by 500 ppm: some samples are rejected, then the new skew is known; the bound always holds."""
    clock = clock_with(150)
    local_ns = received_ns(sent_us(149))
    for k in range(150, 160):
        local_ns += round(FRAME_NS * (1 + 500e-6))
        clock.add(local_ns, sent_us(k), SIGMA_NS)
        at = clock.at(local_ns)
        assert at is not None
        assert abs(at.time_us - sent_us(k)) < at.bound_us
    elapsed = clock.elapsed(local_ns, local_ns + FRAME_NS)
    assert elapsed.time_us == pytest.approx(FRAME_NS / 1000 * (1 - 500e-6), abs=5)
    assert at is not None
    assert at.bound_us < 300


def test_bound_between_two_segments_contains_both() -> None:
    """Between the segments it is unknown which one holds."""
    clock = clock_with(150)
    for k in range(170, 180):  # 8 s without beacons, in which the clock was taken back by 3 ms
        clock.add(received_ns(sent_us(k) - 3_000), sent_us(k), SIGMA_NS)
    for session_us, expected_us in ((sent_us(152), 0), (sent_us(168), -3_000)):
        at = clock.at(received_ns(session_us + expected_us))
        assert at is not None
        assert abs(at.time_us - session_us) < at.bound_us < 8_000
    before = clock.at(received_ns(sent_us(100)))
    assert before is not None
    assert before.bound_us < 128


def test_large_jump_requires_an_unambiguous_sample() -> None:
    """Agreeing samples do not start a segment 20 ms off unless one of them is unambiguous."""
    clock, jump_us = clock_with(150), 20_000
    for k in range(150, 160):
        assert not clock.add(received_ns(sent_us(k) + jump_us), sent_us(k), SIGMA_NS)
    assert not clock.add(received_ns(sent_us(160) + jump_us), sent_us(160), SIGMA_NS, unambiguous=True)
    assert clock.add(received_ns(sent_us(161) + jump_us), sent_us(161), SIGMA_NS)


def test_unwrapping_follows_a_jump_beyond_16_bits() -> None:
    """After a computer slept for a minute, the next session item starts a new segment."""
    clock, slept_us = clock_with(150), -60_000_000
    for k in range(150, 160):
        local_ns = received_ns(sent_us(k) + slept_us + 60_000_000 * 2)
        full = sent_us(k) if k == 152 else clock.unwrap(local_ns, sent_us(k) & 0xFFFF, SIGMA_NS)
        if full is not None:
            clock.add(local_ns, full, SIGMA_NS, unambiguous=k == 152)
    at = clock.at(local_ns)
    assert at is not None
    assert abs(at.time_us - sent_us(159)) < at.bound_us < 1_000


def test_understated_sigma_is_detected() -> None:
    """Timestamps claimed to 10 us that scatter by 1 ms have the bound of 1 ms."""
    for seed in range(20):
        clock = clock_with_coarse_timestamps(seed)
        at = clock.at(received_ns(sent_us(30)))
        assert at is not None
        assert abs(at.time_us - sent_us(30)) < at.bound_us
        assert at.bound_us > 700


def clock_with_coarse_timestamps(seed: int) -> BeaconClock:
    """Return a clock whose timestamps scatter by 1 ms; some samples are rejected."""
    clock, rng = BeaconClock(), np.random.default_rng(seed)
    for k in range(30):
        clock.add(received_ns(sent_us(k) + rng.normal(0, 1_000)), sent_us(k), SIGMA_NS, unambiguous=k < 4)
    return clock


def test_coarse_timestamp_among_fine_ones_has_little_weight() -> None:
    """The edge of a beacon was lost, and polling found it 0.5 ms late."""
    clock = clock_with(150, jitter_us=28)
    before = clock.at(received_ns(sent_us(150)))
    assert clock.add(received_ns(sent_us(150) + 500), sent_us(150), 1_000_000)
    after = clock.at(received_ns(sent_us(150)))
    assert before is not None
    assert after is not None
    assert after.time_us == pytest.approx(before.time_us, abs=5)


def test_older_sample_is_rejected() -> None:
    """A sample received before the newest one is rejected."""
    clock = clock_with(10)
    assert not clock.add(received_ns(sent_us(9)), sent_us(9), SIGMA_NS)
    assert clock.samples == 10
    assert clock.last_received_ns == received_ns(sent_us(9))


def test_oldest_samples_are_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    """The number of samples is limited, and the present time does not suffer."""
    monkeypatch.setattr(beacon_clock, "MAX_SAMPLES", 100)
    monkeypatch.setattr(beacon_clock, "_DROPPED_SAMPLES", 20)
    clock = clock_with(500, ppm=50, jitter_us=28)
    assert 80 <= clock.samples <= 100
    for k in (450, 499):
        at = clock.at(received_ns(sent_us(k), 50))
        assert at is not None
        assert abs(at.time_us - sent_us(k)) < 40
        assert at.bound_us < 128


def test_short_old_segment_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    """A segment with few samples is dropped as a whole."""
    monkeypatch.setattr(beacon_clock, "MAX_SAMPLES", 100)
    monkeypatch.setattr(beacon_clock, "_DROPPED_SAMPLES", 20)
    clock = clock_with(10)
    for k in range(20, 200):
        clock.add(received_ns(sent_us(k) + 2_000), sent_us(k), SIGMA_NS)
    assert clock.samples <= 100 + 1
