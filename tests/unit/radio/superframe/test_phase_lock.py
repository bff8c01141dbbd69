from __future__ import annotations

import itertools
import statistics
from dataclasses import dataclass, field

import numpy as np
import pytest
from harness.hardware.radios import MS, PAPER

from tsgt.radio.superframe import COMPOSE_LEAD_NS, FramePlan, FrameTiming, PhaseLock
from tsgt.radio.superframe.wire import GRANT_BYTES, SlotOrder

TIMING = FrameTiming.from_tolerances(PAPER, start_jitter_ns=5 * MS, turnaround_ns=8 * MS, clock_error_ppm=100)
BEACON_BYTES = 12
ONE, TWO = GRANT_BYTES.index(17), GRANT_BYTES.index(26)
MASTER_NS = 6 * MS
PERIOD_NS = 400 * MS
SECOND_NS = 1000 * MS


@dataclass
class Field:
    """Stations with an instrument each and a master, without radios.

    ``made`` are the times of the measurements in ns, ``latency_ns`` is the delay until they are ready. Each reply has the newest
    ready ones, as many as its grant allows; the others wait for the next reply, whose grant is larger.
    """

    made: list[list[int]]
    latency_ns: int = 0
    loss: float = 0.0
    seed: int = 0
    grants: list[int] = field(default_factory=list)
    follow: bool = True
    plans: list[FramePlan] = field(default_factory=list)
    earliest: list[int] = field(default_factory=list)
    ages_ms: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.lock = PhaseLock(TIMING, len(self.made))
        self._random = np.random.default_rng(self.seed)
        self._ready = [0] * len(self.made)
        self._queues: list[list[int]] = [[] for _ in self.made]
        self._earliest_ns = 0
        self.grants = self.grants or [ONE] * len(self.made)

    def run(self, seconds: float) -> None:
        """Run frames up to this time."""
        while self._earliest_ns < seconds * SECOND_NS:
            self._frame()

    def ages_after(self, seconds: float, until: float) -> list[float]:
        """Run frames up to the second time; return the ages of measurements received after the first, in ms."""
        self.run(seconds)
        self.ages_ms.clear()
        self.run(until)
        return self.ages_ms

    def _frame(self) -> None:
        grants = [TWO if queue else grant for queue, grant in zip(self._queues, self.grants, strict=True)]
        plan = self.lock.plan(self._earliest_ns, grants, BEACON_BYTES)
        if not self.follow:
            plan = FramePlan(self._earliest_ns, SlotOrder())
        self.earliest.append(self._earliest_ns)
        self.plans.append(plan)
        beacon_end_ns = plan.start_ns + TIMING.airtime_ns(BEACON_BYTES)
        spans = TIMING.slots(grants, plan.slot_order)
        end_ns = beacon_end_ns
        for index, span in enumerate(spans):
            assert span is not None
            end_ns = max(end_ns, beacon_end_ns + span.end_ns)
            self._make_ready(index, beacon_end_ns + span.start_ns - COMPOSE_LEAD_NS)
            if self._random.random() < self.loss:
                continue
            self.lock.reply_received(index)
            queue, fits = self._queues[index], 1 if span.max_reply_bytes < GRANT_BYTES[TWO] else 3
            for time_ns in queue[-fits:]:
                self.lock.add_measurement(index, time_ns // 1000)
                self.ages_ms.append((beacon_end_ns + span.end_ns + TIMING.reception_ns - time_ns) / MS)
            del queue[-fits:]
        self._earliest_ns = end_ns + TIMING.reception_ns + MASTER_NS

    def _make_ready(self, index: int, composed_ns: int) -> None:
        made = self.made[index]
        while self._ready[index] < len(made) and made[self._ready[index]] + self.latency_ns <= composed_ns:
            self._queues[index].append(made[self._ready[index]])
            self._ready[index] += 1


def periodic_measurements(
    phases_ms: list[float], *, seconds: float = 120, period_ns: float = PERIOD_NS, ppm: float = 0
) -> list[list[int]]:
    """Return periodic measurements with these phases; each clock is faster than the one before."""
    return [
        [
            round(phase_ms * MS + k * period_ns * (1 + number * ppm * 1e-6))
            for k in range(int(seconds * SECOND_NS / period_ns))
        ]
        for number, phase_ms in enumerate(phases_ms)
    ]


def min_wait_ms(phases_ms: list[float], slot_ms: float) -> float:
    """Return the least mean wait over all slot orders and starts, by brute force."""
    waits = []
    count = len(phases_ms)
    for order in itertools.permutations(range(count)):
        for start_ms in range(400):
            composed = {station: start_ms + place * slot_ms for place, station in enumerate(order)}
            waits.append(statistics.fmean((composed[i] - phases_ms[i]) % 400 for i in range(count)))
    return min(waits)


def frame_lengths_ns(plans: list[FramePlan]) -> list[int]:
    """Return the times from beacon to beacon."""
    return [after.start_ns - before.start_ns for before, after in itertools.pairwise(plans)]


def test_no_lock_without_measurements() -> None:
    """Frames start as early as possible."""
    world = Field([[], [], []])
    world.run(10)
    assert [plan.start_ns for plan in world.plans] == world.earliest
    assert not world.lock.locked


@pytest.mark.parametrize("seed", range(8))
def test_age_is_near_optimal(seed: int) -> None:
    """Within 5 ms of the optimum at random phases, and far below that of unlocked frames."""
    generator = np.random.default_rng(seed)
    phases_ms = list(generator.uniform(0, 400, 3))
    world, free = (
        Field(periodic_measurements(phases_ms)),
        Field(periodic_measurements(phases_ms), follow=False),
    )
    slot_ms = (TIMING.airtime_ns(17) + TIMING.guard_ns) / MS
    on_air_ms = (COMPOSE_LEAD_NS + TIMING.airtime_ns(17) + TIMING.reception_ns) / MS
    age_ms = statistics.fmean(world.ages_after(20, 60))
    assert age_ms < min_wait_ms(phases_ms, slot_ms) + on_air_ms + 5
    assert age_ms < statistics.fmean(free.ages_after(20, 60)) - 80
    assert set(frame_lengths_ns(world.plans[-60:])) <= {PERIOD_NS - 1, PERIOD_NS, PERIOD_NS + 1}


def test_frame_never_starts_early() -> None:
    """At any packet loss."""
    world = Field(periodic_measurements([0, 100, 300]), loss=0.2)
    world.run(60)
    assert all(plan.start_ns >= earliest for plan, earliest in zip(world.plans, world.earliest, strict=True))


def test_drifting_clocks_are_followed() -> None:
    """200 ppm between neighbours turn the phases by a third of a period in ten minutes."""
    phases_ms = [50.0, 150.0, 250.0]
    world = Field(periodic_measurements(phases_ms, seconds=600, ppm=200))
    ages = world.ages_after(20, 600)
    assert statistics.fmean(ages) < 180
    assert statistics.quantiles(ages, n=100)[98] < 350


def test_latency_is_learnt() -> None:
    """A latency of 25 ms makes measurements 25 ms older, not a frame."""
    phases_ms = [20.0, 130.0, 220.0]
    prompt = statistics.fmean(Field(periodic_measurements(phases_ms)).ages_after(40, 110))
    slow = statistics.fmean(Field(periodic_measurements(phases_ms), latency_ns=25 * MS).ages_after(40, 110))
    assert prompt + 25 < slow < prompt + 35


def test_jitter_is_absorbed_by_margin() -> None:
    """5 ms of jitter make measurements 15 ms older, not a frame."""
    generator = np.random.default_rng(4)
    exact = periodic_measurements([20.0, 130.0, 220.0])
    made = [[time + round(generator.normal(0, 5 * MS)) for time in times] for times in exact]
    ages = Field(made).ages_after(20, 110)
    assert statistics.quantiles(ages, n=50)[48] < statistics.median(Field(exact).ages_after(20, 110)) + 100


def test_no_lock_for_frames_longer_than_period() -> None:
    """Frames that need 420 ms would be 800 ms long."""
    world = Field(periodic_measurements([20.0, 130.0, 220.0]), grants=[TWO] * 3)
    world.run(60)
    assert not world.lock.locked
    assert [plan.start_ns for plan in world.plans] == world.earliest


def test_lock_to_two_periods() -> None:
    """Frames that need 700 ms are 800 ms long."""
    world = Field(periodic_measurements([0, 121, 242, 363, 84]), grants=[TWO] * 5)
    world.run(60)
    needed_ns = world.earliest[-1] - world.plans[-2].start_ns
    assert 650 * MS < needed_ns < 800 * MS
    assert world.lock.locked
    assert frame_lengths_ns(world.plans)[-1] == pytest.approx(800 * MS, abs=10)


def test_lag_is_recovered_without_skipping_a_period() -> None:
    """Frames start immediately until they are in phase again."""
    world = Field(periodic_measurements([20.0, 130.0, 220.0]))
    world.run(20)
    before_ns = world.plans[-1].start_ns
    world.grants = [TWO, TWO, ONE]  # 49 ms longer
    world.run(20.4)
    world.grants = [ONE] * 3
    world.run(30)
    apart = frame_lengths_ns([plan for plan in world.plans if plan.start_ns >= before_ns])
    assert max(apart) < 440 * MS
    assert apart[-1] == pytest.approx(PERIOD_NS, abs=10)
    assert statistics.fmean(apart) == pytest.approx(PERIOD_NS, abs=2 * MS)


def test_lock_is_released_when_frames_grow() -> None:
    """Meanwhile no frame is delayed by half a period or more."""
    world = Field(periodic_measurements([20.0, 130.0, 220.0]))
    world.run(20)
    assert world.lock.locked
    before = len(world.plans)
    world.grants = [TWO] * 3
    world.run(60)
    pauses = [plan.start_ns - earliest for plan, earliest in zip(world.plans, world.earliest, strict=True)]
    assert max(pauses[before:]) < PERIOD_NS / 2
    assert not world.lock.locked


def test_stopped_instrument_is_ignored() -> None:
    """Also when it was the reference."""
    made = periodic_measurements([20.0, 130.0, 220.0])
    for stopping in range(3):
        some = [times[:100] if index == stopping else times for index, times in enumerate(made)]
        world = Field(some)
        ages = world.ages_after(60, 100)
        assert world.lock.locked
        assert statistics.fmean(ages) < 160


def test_extra_frames_fit_between_measurements() -> None:
    """They repeat a lost reply; the measurement still meets its slot."""
    world = Field(periodic_measurements([70.0]))
    ages = world.ages_after(20, 60)
    assert max(ages) < 110
    assert len(world.plans) > 60 / 0.4 * 1.8


def test_forecast_equals_plan() -> None:
    """With unchanged grants."""
    world = Field(periodic_measurements([20.0, 130.0, 220.0]))
    world.run(30)
    earliest_ns = world.plans[-1].start_ns + 380 * MS
    forecast = world.lock.forecast(earliest_ns, BEACON_BYTES)
    assert forecast > earliest_ns
    assert world.lock.plan(earliest_ns, world.grants, BEACON_BYTES).start_ns == forecast
