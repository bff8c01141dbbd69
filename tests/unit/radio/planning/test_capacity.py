"""The predicted capacity of a channel."""

from __future__ import annotations

import math
from typing import Any

import pytest

from tsgt.radio import LoRaSettings
from tsgt.radio.classic import LinkTiming
from tsgt.radio.planning import CycleEstimate, TrafficLoad, classic_cycle, superframe_cycle
from tsgt.radio.superframe import FrameTiming


def classic(stations: int = 3, loss: float = 0.0, *, rate_hz: float = 2.5, **settings: Any) -> CycleEstimate:
    """Plan the paper's protocol with a master's defaults."""
    return classic_cycle(
        TrafficLoad(stations=stations, rate_hz=rate_hz, loss=loss),
        LinkTiming(modem(**settings), 250_000_000),
        resync_cycles=5,
        resync_interval_ns=300_000_000_000,
    )


def superframe(
    stations: int = 3,
    loss: float = 0.0,
    *,
    phase_lock: bool = True,
    start_jitter_ns: int = 5_000_000,
    **settings: Any,
) -> CycleEstimate:
    """Plan the superframe with a master's defaults."""
    timing = FrameTiming.from_tolerances(
        modem(**settings), start_jitter_ns=start_jitter_ns, turnaround_ns=8_000_000, clock_error_ppm=100
    )
    return superframe_cycle(
        TrafficLoad(stations=stations, rate_hz=2.5, loss=loss), timing, phase_lock=phase_lock
    )


def modem(**settings: Any) -> LoRaSettings:
    """Return the paper's settings, with changes."""
    paper = {"spreading_factor": 9, "bandwidth_hz": 250_000, "coding_rate": 6}
    return LoRaSettings(frequency_hz=905_000_000, **{**paper, **settings})


def test_classic_rate_matches_the_simulation() -> None:
    """In ten simulated minutes, with more synchronisations than later, three stations got 1.593 Hz each."""
    assert classic().rate_hz == pytest.approx(1.593, rel=0.02)


@pytest.mark.parametrize(("loss", "part"), [(0.0, 0.65), (0.05, 0.56), (0.1, 0.48), (0.2, 0.36), (0.3, 0.26)])
def test_classic_rate_falls_faster_than_the_loss(loss: float, part: float) -> None:
    """A lost packet costs a timeout of all stations' time; the shares match a frame-level study."""
    assert classic(loss=loss).rate_hz / 2.5 == pytest.approx(part, abs=0.015)


def test_one_station_is_polled_faster_than_it_measures() -> None:
    """All its measurements arrive but during synchronisations, and a lost poll usually costs nothing."""
    assert classic(1).rate_hz == pytest.approx(2.5, rel=0.01)
    assert classic(1, 0.1).rate_hz == pytest.approx(2.5 * (1 - 0.19 ** (400 / 223)), rel=0.02)


def test_classic_rate_follows_the_airtime() -> None:
    """The spreading factor of the authors' nodes gives a higher rate, a slower one a lower rate."""
    assert (
        classic(spreading_factor=8).rate_hz
        > 1.5 * classic().rate_hz
        > 2 * classic(spreading_factor=10).rate_hz
    )


@pytest.mark.parametrize("loss", [0.0, 0.1, 0.3])
@pytest.mark.parametrize("stations", [1, 3, 8])
def test_superframe_carries_all_measurements(stations: int, loss: float) -> None:
    """At the paper's settings up to eight stations deliver all of 2.5 Hz, with or without loss."""
    assert superframe(stations, loss).rate_hz == pytest.approx(2.5)


def test_sixteen_stations_exceed_the_capacity() -> None:
    """Sixteen stations with loss deliver less than they measure."""
    assert superframe(16, 0.1).rate_hz < 2.2


@pytest.mark.parametrize(
    ("stations", "loss", "p50_ms", "p99_ms"),
    [(3, 0.0, 290, 474), (3, 0.1, 349, 1299), (3, 0.2, 439, 2297), (4, 0.0, 369, 627), (6, 0.0, 563, 990)],
)
def test_ages_without_phase_lock_match_a_frame_level_study(
    stations: int, loss: float, p50_ms: float, p99_ms: float
) -> None:
    """They agree to a tenth with a study whose guard times were 0.75 ms shorter."""
    cycle = superframe(stations, loss, phase_lock=False)
    assert cycle.age_p50_ms == pytest.approx(p50_ms, rel=0.1)
    assert cycle.age_p99_ms == pytest.approx(p99_ms, rel=0.1)


@pytest.mark.parametrize("loss", [0.7, 0.9])
def test_age_at_a_high_loss_is_that_of_the_frames_until_a_reply(loss: float) -> None:
    """By the geometric distribution, less what is rarer than one in 10 000; the first reply and the transport come to it."""
    cycle, failed = superframe(3, loss, phase_lock=False), 1 - (1 - loss) ** 2
    for quantile, age_ms in ((0.5, cycle.age_p50_ms), (0.99, cycle.age_p99_ms)):
        frames = math.log(1 - quantile) / math.log(failed)
        assert 0.99 * frames < age_ms / cycle.cycle_ms < frames + 1


def test_phase_lock_halves_the_age() -> None:
    """Frames of 400 ms in phase with three instruments halve the age."""
    locked, free = superframe(), superframe(phase_lock=False)
    assert locked.cycle_ms == pytest.approx(400)
    assert locked.age_p50_ms < 150 < 250 < free.age_p50_ms


def test_frames_longer_than_the_period_are_not_locked() -> None:
    """A frame that does not fit into the instruments' period starts as soon as it can."""
    free = superframe(4, 0.1, phase_lock=False)
    assert superframe(4, 0.1).cycle_ms == pytest.approx(free.cycle_ms)


def test_shorter_guards_make_shorter_frames() -> None:
    """Real-time priority saves 3 ms of each of two guard times, and shorter frames carry less."""
    usual, quick = (superframe(phase_lock=False, start_jitter_ns=ns) for ns in (5_000_000, 2_000_000))
    assert 6 < usual.cycle_ms - quick.cycle_ms < 9


def test_duty_cycles_are_airtime_over_cycle() -> None:
    """Beacons of 12 bytes and replies of 17, sometimes longer, every 400 ms."""
    cycle = superframe()
    assert cycle.master_duty == pytest.approx(78.3 / 400, rel=0.03)
    assert cycle.station_duty == pytest.approx(90.6 / 400, rel=0.06)


def test_station_with_loss_transmits_less() -> None:
    """A station that misses the beacon does not reply."""
    assert superframe(loss=0.3).station_duty < superframe().station_duty
