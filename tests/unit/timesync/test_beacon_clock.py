"""The master's time on a station's clock."""

from __future__ import annotations

import numpy as np
import pytest

from tsgt.timesync import BeaconClock, beacon_clock

FRAME_NS = 400_000_000
START_NS = 5_000_000_000_000
SIGMA_NS = 10_000


def received_ns(session_us: float, ppm: float = 0.0) -> int:
    """Return what a station's clock shows that gains on the master's by so much."""
    return START_NS + round(1000 * session_us * (1 + ppm / 1e6))


def taught(pairs: int, *, ppm: float = 0.0, jitter_us: float = 0.0, seed: int = 0) -> BeaconClock:
    """Return a clock with pairs 0.4 s apart."""
    clock, rng = BeaconClock(), np.random.default_rng(seed)
    for k in range(pairs):
        late_ns = round(1000 * rng.normal(0.0, jitter_us)) if jitter_us else 0
        assert clock.add(received_ns(sent_us(k), ppm) + late_ns, sent_us(k), SIGMA_NS, unambiguous=k < 2)
    return clock


def sent_us(k: int) -> int:
    """Return when beacon k left."""
    return 7_000 + k * FRAME_NS // 1000


def test_without_pairs_it_knows_nothing_but_durations() -> None:
    """There is no time, no full number; a duration is that of the own clock, give or take 120 ppm."""
    clock = BeaconClock()
    assert clock.at(START_NS) is None
    assert clock.unwrap(START_NS, 5) is None
    assert clock.last_received_ns is None
    assert clock.samples == 0
    assert clock.elapsed(START_NS, START_NS + FRAME_NS)[::2] == pytest.approx((400_000.0, 48.0))


def test_one_pair_gives_no_time() -> None:
    """Its beacon may have been held back by anything; and so the low bits of others are not completed by it."""
    clock = taught(1)
    assert clock.at(received_ns(sent_us(0))) is None
    assert clock.unwrap(received_ns(sent_us(1)), sent_us(1) & 0xFFFF) is None
    assert clock.elapsed(START_NS, START_NS + FRAME_NS)[::2] == pytest.approx((400_000.0, 48.0))


def test_two_pairs_give_a_time_with_an_honest_bound() -> None:
    """They may be off by what the master's stamp can be, and tell little of the rate."""
    clock = taught(2)
    at, later = clock.at(received_ns(sent_us(1))), clock.at(received_ns(sent_us(1) + 60e6, ppm=100))
    assert at is not None
    assert later is not None
    assert at.time_us == pytest.approx(sent_us(1))
    assert at.bound_us == pytest.approx(3_540, rel=0.01)
    assert abs(later.time_us - sent_us(1) - 60e6) < later.bound_us < 20_000


def test_of_two_first_pairs_that_do_not_agree_neither_is_a_time() -> None:
    """One of them was held back by 248 ms. The third decides which."""
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


def test_pairs_that_are_not_in_full_give_no_time() -> None:
    """However many there are."""
    clock = BeaconClock()
    assert not any(clock.add(received_ns(sent_us(k)), sent_us(k), SIGMA_NS) for k in range(10))
    assert clock.at(received_ns(sent_us(5))) is None


def test_what_low_bits_do_not_tell_is_in_the_bound() -> None:
    """A pair that seems to be 14 ms off may be 65.5 ms more off."""
    clock = taught(150)
    clock.add(received_ns(sent_us(150) + 14_000), sent_us(150), SIGMA_NS)
    at = clock.at(received_ns(sent_us(150) + 14_000))
    assert at is not None
    assert at.bound_us > 14_000 + 65_536


@pytest.mark.parametrize("ppm", [-100.0, 0.0, 100.0])
def test_it_follows_a_clock_that_drifts(ppm: float) -> None:
    """With a minute of pairs the time is good to some us, between and behind them."""
    clock = taught(150, ppm=ppm, jitter_us=28)
    for session_us in (5e6, sent_us(149) + 0.6e6):
        at = clock.at(received_ns(session_us, ppm))
        assert at is not None
        assert at.time_us == pytest.approx(session_us, abs=20)
        assert at.bound_us < 128


def test_a_time_before_the_first_pair_is_known_too() -> None:
    """What was measured before the first beacon is timed with the rate of after it."""
    at = taught(150, ppm=50).at(received_ns(-10e6, 50))
    assert at is not None
    assert abs(at.time_us + 10e6) < min(at.bound_us, 20)


def test_the_rate_of_a_duration_is_the_masters() -> None:
    """Between two instants in the future of the last pair, 0.3 s are good to some us."""
    clock = taught(150, ppm=80, jitter_us=28)
    from_us = sent_us(150)
    elapsed = clock.elapsed(received_ns(from_us, 80), received_ns(from_us + 300_000, 80))
    assert elapsed.time_us == pytest.approx(300_000, abs=1)
    assert elapsed.bound_us < 30
    assert clock.elapsed(received_ns(from_us, 80), received_ns(from_us - 300_000, 80)).time_us < 0


def test_a_long_duration_is_the_difference_of_its_ends() -> None:
    """Over a minute both ends are known better than the rate."""
    clock = taught(150, ppm=80, jitter_us=28)
    elapsed = clock.elapsed(received_ns(1e6, 80), received_ns(58e6, 80))
    assert elapsed.time_us == pytest.approx(57e6, abs=20)
    assert elapsed.bound_us < 300


def test_low_bits_are_completed() -> None:
    """The 16 low bits of a time, and when the beacon was received, make the full time."""
    clock = taught(150, ppm=50)
    for frames in (1, 2, 250):
        full = sent_us(149 + frames)
        assert clock.unwrap(received_ns(full, 50), full & 0xFFFF) == full


def test_low_bits_are_not_completed_after_a_long_outage() -> None:
    """An hour after the last pair more than one time fits."""
    assert taught(150).unwrap(received_ns(3.6e9), 0) is None


def test_a_beacon_that_was_held_up_is_refused() -> None:
    """A pair 0.3 ms off does not bend the fit, but until the next one the bound contains it."""
    clock = taught(150, jitter_us=28)
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
def test_a_single_beacon_in_a_long_outage_may_have_been_held_back(
    away_s: int, again_s: int, late_us: int
) -> None:
    """So much later anything agrees with it, and so it does not count together with those that come then."""
    clock, alone = taught(150), 150 + round(2.5 * away_s)
    back = alone + round(2.5 * again_s)
    clock.add(received_ns(sent_us(alone)) + 1000 * late_us, sent_us(alone), SIGMA_NS)
    for k in range(back, back + 10):
        assert clock.add(received_ns(sent_us(k)), sent_us(k), SIGMA_NS)
        for before in range(150, k, 10):
            at = clock.at(received_ns(sent_us(before)))
            assert at is not None
            assert abs(at.time_us - sent_us(before)) <= at.bound_us
    assert clock.samples == 160


def test_a_beacon_that_was_held_up_for_long_does_not_keep_others_from_being_understood() -> None:
    """Its pair is 40 ms off; the low bits of the next ones are completed all the same."""
    clock = taught(150)
    clock.add(received_ns(sent_us(150) + 40_000), sent_us(150), SIGMA_NS)
    assert clock.unwrap(received_ns(sent_us(152)), sent_us(152) & 0xFFFF) == sent_us(152)


def test_recordings_of_long_ago_never_outvote_the_fit() -> None:
    """However many agree with each other: the master has heard no answer to any of them."""
    clock = taught(150)
    for k in range(150, 180):
        assert not clock.add(received_ns(sent_us(k + 50)), sent_us(k), SIGMA_NS, unambiguous=True, live=False)
    at = clock.at(received_ns(sent_us(230)))
    assert at is not None
    assert abs(at.time_us - sent_us(230)) < 1000


def test_first_pairs_that_are_outvoted_say_nothing_surely() -> None:
    """Neither of their own time nor of what was before them."""
    clock = BeaconClock()
    for k in range(2):
        clock.add(received_ns(sent_us(k) + 30_000), sent_us(k), SIGMA_NS, unambiguous=True)
    for k in range(2, 10):
        clock.add(received_ns(sent_us(k)), sent_us(k), SIGMA_NS, unambiguous=True)
        for early_us in (sent_us(0) - 20_000_000, sent_us(0)):
            at = clock.at(received_ns(early_us))
            assert at is not None
            assert abs(at.time_us - early_us) <= at.bound_us


def test_a_clock_that_was_touched_is_followed_within_seconds() -> None:
    """NTP slews the clock by 500 ppm: some pairs are refused, then the new rate is known; the bound holds all the time."""
    clock = taught(150)
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


def test_between_two_rates_both_are_possible() -> None:
    """What was measured while nobody knew which rate it was has a bound that contains both."""
    clock = taught(150)
    for k in range(170, 180):  # 8 s without beacons, in which the clock was taken back by 3 ms
        clock.add(received_ns(sent_us(k) - 3_000), sent_us(k), SIGMA_NS)
    for session_us, expected_us in ((sent_us(152), 0), (sent_us(168), -3_000)):
        at = clock.at(received_ns(session_us + expected_us))
        assert at is not None
        assert abs(at.time_us - session_us) < at.bound_us < 8_000
    before = clock.at(received_ns(sent_us(100)))
    assert before is not None
    assert before.bound_us < 128


def test_a_large_jump_needs_a_time_in_full() -> None:
    """Pairs that agree are not followed by 20 ms unless one of them is no matter of 16 bits."""
    clock, jump_us = taught(150), 20_000
    for k in range(150, 160):
        assert not clock.add(received_ns(sent_us(k) + jump_us), sent_us(k), SIGMA_NS)
    assert not clock.add(received_ns(sent_us(160) + jump_us), sent_us(160), SIGMA_NS, unambiguous=True)
    assert clock.add(received_ns(sent_us(161) + jump_us), sent_us(161), SIGMA_NS)


def test_after_a_jump_beyond_16_bits_low_bits_follow_the_full_time() -> None:
    """A computer that slept for a minute: the next session part begins the fit anew."""
    clock, slept_us = taught(150), -60_000_000
    for k in range(150, 160):
        local_ns = received_ns(sent_us(k) + slept_us + 60_000_000 * 2)
        full = sent_us(k) if k == 152 else clock.unwrap(local_ns, sent_us(k) & 0xFFFF)
        if full is not None:
            clock.add(local_ns, full, SIGMA_NS, unambiguous=k == 152)
    at = clock.at(local_ns)
    assert at is not None
    assert abs(at.time_us - sent_us(159)) < at.bound_us < 1_000


def test_stamps_that_are_worse_than_stated_are_noticed() -> None:
    """Stamps said to be good to 10 us that scatter by 1 ms: the bound is that of 1 ms."""
    for seed in range(20):
        clock = taught_coarsely(seed)
        at = clock.at(received_ns(sent_us(30)))
        assert at is not None
        assert abs(at.time_us - sent_us(30)) < at.bound_us
        assert at.bound_us > 700


def taught_coarsely(seed: int) -> BeaconClock:
    """Return a clock whose stamps scatter by 1 ms; some of its pairs are refused."""
    clock, rng = BeaconClock(), np.random.default_rng(seed)
    for k in range(30):
        clock.add(received_ns(sent_us(k) + rng.normal(0, 1_000)), sent_us(k), SIGMA_NS, unambiguous=k < 4)
    return clock


def test_a_coarse_stamp_among_fine_ones_counts_little() -> None:
    """The edge of a beacon was lost, and it was found by polling, 0.5 ms late."""
    clock = taught(150, jitter_us=28)
    before = clock.at(received_ns(sent_us(150)))
    assert clock.add(received_ns(sent_us(150) + 500), sent_us(150), 1_000_000)
    after = clock.at(received_ns(sent_us(150)))
    assert before is not None
    assert after is not None
    assert after.time_us == pytest.approx(before.time_us, abs=5)


def test_a_pair_must_be_newer() -> None:
    """A pair that was received before the newest one is refused."""
    clock = taught(10)
    assert not clock.add(received_ns(sent_us(9)), sent_us(9), SIGMA_NS)
    assert clock.samples == 10
    assert clock.last_received_ns == received_ns(sent_us(9))


def test_the_oldest_pairs_are_let_go_of(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the clock remembers is limited, and what it knows of now does not suffer."""
    monkeypatch.setattr(beacon_clock, "MAX_SAMPLES", 100)
    monkeypatch.setattr(beacon_clock, "_DROPPED_SAMPLES", 20)
    clock = taught(500, ppm=50, jitter_us=28)
    assert 80 <= clock.samples <= 100
    for k in (450, 499):
        at = clock.at(received_ns(sent_us(k), 50))
        assert at is not None
        assert abs(at.time_us - sent_us(k)) < 40
        assert at.bound_us < 128


def test_old_stretches_are_let_go_of(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stretch with few pairs goes as a whole."""
    monkeypatch.setattr(beacon_clock, "MAX_SAMPLES", 100)
    monkeypatch.setattr(beacon_clock, "_DROPPED_SAMPLES", 20)
    clock = taught(10)
    for k in range(20, 200):
        clock.add(received_ns(sent_us(k) + 2_000), sent_us(k), SIGMA_NS)
    assert clock.samples <= 100 + 1
