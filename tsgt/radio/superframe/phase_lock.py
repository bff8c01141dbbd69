"""Starts frames in phase with the instruments, which minimises the age of measurements on arrival. Sans-I/O.

In frames that follow each other at once a measurement waits half a frame on average. Frames as long as its period, or a
multiple, keep their phase: slot order and beacon start are chosen so that the measurement of one station, the reference, is
just ready for its slot. This pays off where frames have to be nearly as long anyway, and changes only for a gain. After a
frame that took too long, frames start at once until in phase again. A whole frame that fits in before is inserted.
"""

from __future__ import annotations

import math
from collections import deque
from statistics import fmean, median
from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.superframe.slots import COMPOSE_LEAD_NS
from tsgt.radio.superframe.wire import SlotOrder
from tsgt.timesync import Periodicity

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from tsgt.radio.superframe.slots import FrameTiming

MAX_SILENCE_NS = 5_000_000_000
"""An instrument that has not measured for longer is ignored; no frame is as long."""

MIN_MARGIN_NS = 2_000_000
MAX_MARGIN_NS = 150_000_000
MARGIN_INCREASE_NS = 3_000_000
MARGIN_DECREASE_NS = 30_000
"""The time that a measurement needs from its timestamp to the composed reply is learnt for each station: a measurement
that was made in time and missed its reply increases the margin, one that just made it decreases it; one in 100 misses."""

JITTER_SIGMAS = 3.0  # margin for the jitter of an instrument's period

PERIOD_TOLERANCE = 0.01  # instruments whose periods differ by a smaller part share a phase lock

MIN_GAIN = 0.02  # minimum gain of a change in mean age, as a part of the period

GRANT_WINDOW = 4  # number of frames whose median grants count

FRAME_WINDOW = 32
"""Number of frames that the usual frame length, and the usual lag behind the period, are taken from."""


class FramePlan(NamedTuple):
    """Start of a frame's beacon in session time, and its slot order."""

    start_ns: int
    slot_order: SlotOrder


class _ReadyTimes(NamedTuple):
    """Periodic instants at which a station has a new measurement ready for its reply."""

    period_ns: float
    ready_ns: float

    def until_ns(self, now_ns: int) -> int:
        """Return the time to the next of these instants, plus a microsecond."""
        return round((self.ready_ns - now_ns) % self.period_ns) + 1000


class _Alignment(NamedTuple):
    """Slot order, and the index of the station whose measurements are met as soon as they are ready."""

    slot_order: SlotOrder
    reference: int


class _Frame(NamedTuple):
    """A planned frame: when its replies are composed, by station index, and which of them have been received."""

    start_ns: int
    lasts_ns: int
    composed_ns: Mapping[int, int]
    replied: set[int]


class PhaseLock:
    """Plans the start and slot order of frames; unless ``locked`` they start as early as possible."""

    def __init__(self, timing: FrameTiming, stations: int) -> None:
        self._timing = timing
        self._periodicities = [Periodicity() for _ in range(stations)]
        self._margins_ns = [MIN_MARGIN_NS] * stations
        self._slot_orders = _slot_orders(stations)
        self._alignment = _Alignment(SlotOrder(), 0)
        self._frames: list[_Frame] = []
        self._planned = 0
        self._grants: deque[tuple[int, ...]] = deque([(0,) * stations], maxlen=GRANT_WINDOW)
        self._needs_ns: deque[int] = deque(maxlen=FRAME_WINDOW)
        self._behind_ns: deque[float] = deque((0.0,), maxlen=FRAME_WINDOW)
        self._need_ns = 0.0
        self._overhead_ns = 0
        self.locked = False

    def reply_received(self, index: int) -> None:
        """Take that the station with this index has replied in the present frame."""
        if self._frames:
            self._frames[-1].replied.add(index)

    def add_measurement(self, index: int, time_us: int) -> None:
        """Take the session time of a measurement from a reply of the station with this index in the present frame."""
        newest_us = self._periodicities[index].newest_us
        self._periodicities[index].add(time_us)
        if self._frames and (newest_us is None or time_us > newest_us):
            self._learn_margin(index, 1000 * time_us)

    def plan(self, earliest_ns: int, grants: Sequence[int], beacon_bytes: int) -> FramePlan:
        """Plan the next frame, at or after ``earliest_ns`` session time; ``beacon_bytes`` include the code."""
        self._update_frame_length(earliest_ns)
        self._grants.append(tuple(grants))
        ready, active = self._ready_times(earliest_ns)
        # There are many combinations of slot order and reference, and their gains change slowly.
        if self._planned % len(self._periodicities) == 0 or self._alignment.reference not in ready:
            self._align(earliest_ns, beacon_bytes, ready, active)
        self._planned += 1
        frame = self._frame(earliest_ns, grants, beacon_bytes, ready)
        self._frames = [*self._frames[-1:], frame]
        return FramePlan(frame.start_ns, self._alignment.slot_order)

    def forecast(self, earliest_ns: int, beacon_bytes: int) -> int:
        """Return the start that :meth:`plan` would choose with the grants of the last frame."""
        ready, _ = self._ready_times(earliest_ns)
        return self._frame(earliest_ns, self._grants[-1], beacon_bytes, ready).start_ns

    def _frame(
        self, earliest_ns: int, grants: Sequence[int], beacon_bytes: int, ready: Mapping[int, _ReadyTimes]
    ) -> _Frame:
        lasts_ns, composed_ns = self._layout(grants, self._alignment.slot_order, beacon_bytes)
        start_ns = earliest_ns
        reference = self._alignment.reference
        times, offset_ns = ready.get(reference), composed_ns.get(reference)
        if self.locked and times is not None and offset_ns is not None:
            start_ns += self._wait_ns(times, earliest_ns + offset_ns, lasts_ns)
        at_ns = {index: start_ns + offset_ns for index, offset_ns in composed_ns.items()}
        return _Frame(start_ns, lasts_ns, at_ns, set())

    def _layout(
        self, grants: Sequence[int], order: SlotOrder, beacon_bytes: int
    ) -> tuple[int, dict[int, int]]:
        """Return, in ns from the start of the beacon, the end of the last slot and when each reply is composed."""
        beacon_ns = self._timing.airtime_ns(beacon_bytes)
        slots = self._timing.slots(grants, order)
        return (
            beacon_ns + max((slot.end_ns for slot in slots if slot), default=0),
            {index: beacon_ns + slot.start_ns - COMPOSE_LEAD_NS for index, slot in enumerate(slots) if slot},
        )

    def _update_frame_length(self, earliest_ns: int) -> None:
        """Update the real frame length, and by how much frames in phase would lag behind."""
        if not self._frames or (need_ns := earliest_ns - self._frames[-1].start_ns) > MAX_SILENCE_NS:
            return
        self._needs_ns.append(need_ns)
        self._need_ns = median(self._needs_ns)
        self._overhead_ns = max(need_ns - self._frames[-1].lasts_ns, 0)
        period = self._periodicities[self._alignment.reference].period
        period_ns = self._need_ns if period is None else 1e3 * period.period_us
        behind_ns = self._behind_ns[-1] + need_ns - _whole_periods_ns(self._need_ns, period_ns)
        self._behind_ns.append(min(max(behind_ns, 0.0), period_ns / 2))

    def _learn_margin(self, index: int, time_ns: int) -> None:
        """Compare a new measurement with its own reply and the reply before."""
        before, present = self._frames[0], self._frames[-1]
        missed_ns = before.composed_ns.get(index, time_ns) - time_ns
        made_ns = present.composed_ns.get(index, time_ns) - time_ns
        margin_ns = self._margins_ns[index]
        if index in before.replied and before is not present and 0 < missed_ns < MAX_MARGIN_NS:
            margin_ns += MARGIN_INCREASE_NS
        elif made_ns < margin_ns + MARGIN_INCREASE_NS:
            margin_ns -= MARGIN_DECREASE_NS
        self._margins_ns[index] = min(max(margin_ns, MIN_MARGIN_NS), MAX_MARGIN_NS)

    def _ready_times(self, now_ns: int) -> tuple[dict[int, _ReadyTimes], int]:
        """Return the ready times of the periodic instruments by index, and the number of active ones, periodic or not."""
        ready: dict[int, _ReadyTimes] = {}
        active = 0
        for index, (periodicity, margin_ns) in enumerate(
            zip(self._periodicities, self._margins_ns, strict=True)
        ):
            if periodicity.newest_us is None or now_ns - 1000 * periodicity.newest_us > MAX_SILENCE_NS:
                continue
            active += 1
            if (period := periodicity.period) is not None:
                late_us = JITTER_SIGMAS * period.jitter_us
                ready[index] = _ReadyTimes(
                    1e3 * period.period_us, 1e3 * (period.phase_us + late_us) + margin_ns
                )
        return ready, active

    def _align(
        self, earliest_ns: int, beacon_bytes: int, ready: Mapping[int, _ReadyTimes], active: int
    ) -> None:
        """Choose the alignment with the largest gain in mean age, and lock to it if the gain is positive."""
        costs_ns = {index: self._cost_ns(times.period_ns) for index, times in ready.items()}
        references = {index for index, cost_ns in costs_ns.items() if cost_ns < ready[index].period_ns / 2}
        gains_ns: dict[_Alignment, float] = {}
        # Median grants: a single long reply must not change the slot order for one frame.
        usual = [sorted(of_one)[len(of_one) // 2] for of_one in zip(*self._grants, strict=True)]
        for order in self._slot_orders if references else ():
            _, composed_ns = self._layout(usual, order, beacon_bytes)
            for reference in references & composed_ns.keys():
                gain_ns = self._gain_ns(earliest_ns, composed_ns, reference, ready) / active
                gains_ns[_Alignment(order, reference)] = gain_ns - costs_ns[reference]
        if not gains_ns:
            self.locked = False
            return
        best = max(gains_ns, key=gains_ns.__getitem__)
        present_ns = gains_ns.get(self._alignment, -math.inf) if self.locked else 0.0
        if gains_ns[best] > max(present_ns, 0.0) + MIN_GAIN * ready[best.reference].period_ns:
            self._alignment, self.locked = best, True
        elif present_ns < 0:
            self.locked = False

    # Without a lock, measurements are uniformly distributed over a frame of length N and wait N / 2 on average. With N a
    # multiple of the period P, and the newest measurement of age w when its reply is composed, the mean is
    # N / 2 - P / 2 + w.

    def _gain_ns(
        self,
        earliest_ns: int,
        composed_ns: Mapping[int, int],
        reference: int,
        ready: Mapping[int, _ReadyTimes],
    ) -> float:
        """Return the sum of P / 2 - w over the stations that share the reference's period."""
        locked_to = ready[reference]
        start_ns = earliest_ns + locked_to.until_ns(earliest_ns + composed_ns[reference])
        gain_ns = 0.0
        for index in ready.keys() & composed_ns.keys():
            times = ready[index]
            multiple = round(locked_to.period_ns / times.period_ns)
            if (
                abs(locked_to.period_ns - multiple * times.period_ns)
                <= PERIOD_TOLERANCE * locked_to.period_ns
            ):
                newest_ns = (start_ns + composed_ns[index] - times.ready_ns) % times.period_ns
                gain_ns += times.period_ns / 2 - newest_ns
        return gain_ns

    def _cost_ns(self, period_ns: float) -> float:
        """Return the cost in mean age of longer frames (one period: half, as it carries no more) and of lagging ones."""
        frame_ns = _whole_periods_ns(self._need_ns, period_ns)
        longer_ns = frame_ns - self._need_ns
        return (longer_ns if frame_ns > period_ns else longer_ns / 2) + fmean(self._behind_ns)

    def _wait_ns(self, times: _ReadyTimes, composed_ns: int, lasts_ns: int) -> int:
        """Return how long to delay the beacon so that the reference's reply is composed at a ready time."""
        wait_ns = times.until_ns(composed_ns)
        if lasts_ns + self._overhead_ns <= wait_ns:
            return 0  # a whole frame fits in before
        usual_ns = _whole_periods_ns(self._need_ns, times.period_ns) - self._need_ns
        if self._need_ns > times.period_ns and usual_ns > times.period_ns / 2:
            return 0  # frames have become longer than the period: the lock is about to be released
        # A much longer wait than usual means that the ready time was just missed: start late instead of waiting a period.
        return wait_ns if wait_ns <= usual_ns + times.period_ns / 4 else 0


def _whole_periods_ns(need_ns: float, period_ns: float) -> float:
    """Return the smallest multiple of the period that is at least ``need_ns``, and at least one period."""
    return max(math.ceil(need_ns / period_ns), 1) * period_ns


def _slot_orders(stations: int) -> list[SlotOrder]:
    """Return all distinct slot orders."""
    directions = (False,) if stations <= 2 else (False, True)
    return [SlotOrder(first, reverse) for reverse in directions for first in range(stations)]
