"""When a frame begins, so that the instruments' measurements wait as short as can be for their slots.

Frames that follow each other at once drift past the instruments' beat: a measurement waits half a frame on average.
Frames as long as the beat, or a few beats, meet each instrument at the same point every time. Then order of slots and
time of the beacon can be chosen so that one station's measurement is just ready when its slot comes, and the others'
are as near as their phases allow. It pays where the frames that are needed, grants and all, are not much shorter.

The lock is held to one station, the leader. Which one, and in which order the stations answer, changes only when that
gains something; the clocks' slow drift is followed from frame to frame. A frame that took too long is made good by
starting the next ones at once, until they are on the beat again. Where a whole frame fits in before the beat, it is run.
"""

from __future__ import annotations

import math
from collections import deque
from statistics import fmean, median
from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.superframe.wire import SlotOrder
from tsgt.timesync import Rhythm

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from tsgt.radio.superframe.slots import FrameTiming

COMPOSED_NS = 6_000_000
"""A station decides this long before its slot what it sends."""

STOPPED_NS = 5_000_000_000
"""Whoever has not measured for so long does not count; and a frame is never so long."""

LEAST_MARGIN_NS = 2_000_000
LARGEST_MARGIN_NS = 150_000_000
LONGER_NS = 3_000_000
SHORTER_NS = 30_000
"""How long before it is composed a reply's measurement has to be made is learnt for each station: one that was made
in time and missed its reply makes it longer, one that just made it shorter, so that one in a hundred misses."""

LATE_SIGMAS = 3.0
"""An instrument whose measurements come now a little sooner, now later is waited for so much of its spread."""

SAME_PERIOD = 0.01
"""Instruments whose periods agree to this part are met together; others pass each other too fast."""

WORTH = 0.02
"""A change must gain this part of a period in mean age."""

GRANTS_KEPT = 4
"""Of so many frames the grants are looked at for what is usual."""

USUAL_FRAMES = 32
"""What a frame needs is judged by so many: the usual one, and how long those take to be made good that need more."""


class Plan(NamedTuple):
    """How the next frame begins.

    Attributes
    ----------
    start_ns
        When the beacon begins, session time.
    order
        Of the slots.
    """

    start_ns: int
    order: SlotOrder


class _Beat(NamedTuple):
    """At which instants a station has a new measurement ready for its reply."""

    period_ns: float
    ready_ns: float

    def until_ns(self, now_ns: int) -> int:
        """How long it is from now to the next of these instants; a microsecond more, so that it is past for certain."""
        return round((self.ready_ns - now_ns) % self.period_ns) + 1000


class _Choice(NamedTuple):
    """Order of slots, and the station whose measurement is met as soon as it is ready."""

    order: SlotOrder
    leader: int


class _Frame(NamedTuple):
    """A frame as planned, when the stations decide what they send in it, and whose reply has come."""

    start_ns: int
    lasts_ns: int
    composed_ns: Mapping[int, int]
    heard: set[int]


class FrameLock:
    """Begins frames on the instruments' beat where that makes measurements arrive younger.

    Parameters
    ----------
    timing
        Of the frames.
    stations
        How many have a slot, from index 0.

    Attributes
    ----------
    locked
        Frames follow the beat; otherwise they begin as early as they can.
    """

    def __init__(self, timing: FrameTiming, stations: int) -> None:
        self._timing = timing
        self._rhythms = [Rhythm() for _ in range(stations)]
        self._margins_ns = [LEAST_MARGIN_NS] * stations
        self._orders = _orders(stations)
        self._choice = _Choice(SlotOrder(), 0)
        self._frames: list[_Frame] = []
        self._planned = 0
        self._grants: deque[tuple[int, ...]] = deque([(0,) * stations], maxlen=GRANTS_KEPT)
        self._needs_ns: deque[int] = deque(maxlen=USUAL_FRAMES)
        self._behind_ns: deque[float] = deque((0.0,), maxlen=USUAL_FRAMES)
        self._need_ns = 0.0
        self._overhead_ns = 0
        self.locked = False

    def answered(self, index: int) -> None:
        """Note that a station's reply in the present frame has come, with measurements or without.

        Parameters
        ----------
        index
            Of the station.
        """
        if self._frames:
            self._frames[-1].heard.add(index)

    def measured(self, index: int, time_us: int) -> None:
        """Take the time of a measurement that a reply in the present frame has brought.

        Parameters
        ----------
        index
            Of the station.
        time_us
            When it was made, session time.
        """
        newest_us = self._rhythms[index].newest_us
        self._rhythms[index].add(time_us)
        if self._frames and (newest_us is None or time_us > newest_us):
            self._learn_margin(index, 1000 * time_us)

    def plan(self, earliest_ns: int, grants: Sequence[int], beacon_bytes: int) -> Plan:
        """Plan the next frame.

        Parameters
        ----------
        earliest_ns
            Before this the beacon cannot begin, session time.
        grants
            By station index, as the beacon will say.
        beacon_bytes
            Length of the beacon, code and all.
        """
        self._note_need(earliest_ns)
        self._grants.append(tuple(grants))
        beats, measuring = self._beats(earliest_ns)
        # Orders, leaders and stations make many combinations, whose worth changes slowly.
        if self._planned % len(self._rhythms) == 0 or self._choice.leader not in beats:
            self._choose(earliest_ns, beacon_bytes, beats, measuring)
        self._planned += 1
        frame = self._frame(earliest_ns, grants, beacon_bytes, beats)
        self._frames = [*self._frames[-1:], frame]
        return Plan(frame.start_ns, self._choice.order)

    def forecast(self, earliest_ns: int, beacon_bytes: int) -> int:
        """Return when the next frame begins, in session time, if its grants are those of the last; as :meth:`plan`."""
        beats, _ = self._beats(earliest_ns)
        return self._frame(earliest_ns, self._grants[-1], beacon_bytes, beats).start_ns

    def _frame(
        self, earliest_ns: int, grants: Sequence[int], beacon_bytes: int, beats: Mapping[int, _Beat]
    ) -> _Frame:
        """Return the next frame as things are."""
        lasts_ns, composed_ns = self._layout(grants, self._choice.order, beacon_bytes)
        start_ns = earliest_ns
        beat, offset_ns = beats.get(self._choice.leader), composed_ns.get(self._choice.leader)
        if self.locked and beat is not None and offset_ns is not None:
            start_ns += self._pause_ns(beat, earliest_ns + offset_ns, lasts_ns)
        at_ns = {index: start_ns + offset_ns for index, offset_ns in composed_ns.items()}
        return _Frame(start_ns, lasts_ns, at_ns, set())

    def _layout(
        self, grants: Sequence[int], order: SlotOrder, beacon_bytes: int
    ) -> tuple[int, dict[int, int]]:
        """Return from the beginning of a beacon: the end of the last slot, and when each reply is composed, in ns."""
        beacon_ns = self._timing.airtime_ns(beacon_bytes)
        spans = self._timing.slots(grants, order)
        return (
            beacon_ns + max((span.end_ns for span in spans if span), default=0),
            {index: beacon_ns + span.start_ns - COMPOSED_NS for index, span in enumerate(spans) if span},
        )

    # --- What is known of frames and stations -----------------------------------------------------------------

    def _note_need(self, earliest_ns: int) -> None:
        """Note how long a frame really takes, and by how much frames on the beat would run behind."""
        if not self._frames or (need_ns := earliest_ns - self._frames[-1].start_ns) > STOPPED_NS:
            return
        self._needs_ns.append(need_ns)
        self._need_ns = median(self._needs_ns)
        self._overhead_ns = max(need_ns - self._frames[-1].lasts_ns, 0)
        beat = self._rhythms[self._choice.leader].beat
        period_ns = self._need_ns if beat is None else 1e3 * beat.period_us
        behind_ns = self._behind_ns[-1] + need_ns - _whole_ns(self._need_ns, period_ns)
        self._behind_ns.append(min(max(behind_ns, 0.0), period_ns / 2))

    def _learn_margin(self, index: int, time_ns: int) -> None:
        """Compare a new measurement with the reply that it came in and the one before that."""
        before, present = self._frames[0], self._frames[-1]
        missed_ns = before.composed_ns.get(index, time_ns) - time_ns
        made_ns = present.composed_ns.get(index, time_ns) - time_ns
        margin_ns = self._margins_ns[index]
        if index in before.heard and before is not present and 0 < missed_ns < LARGEST_MARGIN_NS:
            margin_ns += LONGER_NS
        elif made_ns < margin_ns + LONGER_NS:
            margin_ns -= SHORTER_NS
        self._margins_ns[index] = min(max(margin_ns, LEAST_MARGIN_NS), LARGEST_MARGIN_NS)

    def _beats(self, now_ns: int) -> tuple[dict[int, _Beat], int]:
        """Return the beats of those that have one, and how many measure at present, with or without."""
        beats: dict[int, _Beat] = {}
        measuring = 0
        for index, (rhythm, margin_ns) in enumerate(zip(self._rhythms, self._margins_ns, strict=True)):
            if rhythm.newest_us is None or now_ns - 1000 * rhythm.newest_us > STOPPED_NS:
                continue
            measuring += 1
            if (beat := rhythm.beat) is not None:
                late_us = LATE_SIGMAS * beat.spread_us
                beats[index] = _Beat(1e3 * beat.period_us, 1e3 * (beat.phase_us + late_us) + margin_ns)
        return beats, measuring

    # --- What is best -----------------------------------------------------------------------------------------

    def _choose(
        self, earliest_ns: int, beacon_bytes: int, beats: Mapping[int, _Beat], measuring: int
    ) -> None:
        """Choose order and leader, and whether it is worth while to follow them."""
        costs_ns = {leader: self._longer_ns(beat.period_ns) for leader, beat in beats.items()}
        leaders = {leader for leader, cost_ns in costs_ns.items() if cost_ns < beats[leader].period_ns / 2}
        gains_ns: dict[_Choice, float] = {}
        # One long reply now and then must not turn the order round for a frame.
        usual = [sorted(of_one)[len(of_one) // 2] for of_one in zip(*self._grants, strict=True)]
        for order in self._orders if leaders else ():
            _, composed_ns = self._layout(usual, order, beacon_bytes)
            for leader in leaders & composed_ns.keys():
                aligned_ns = self._aligned_ns(earliest_ns, composed_ns, leader, beats) / measuring
                gains_ns[_Choice(order, leader)] = aligned_ns - costs_ns[leader]
        if not gains_ns:
            self.locked = False
            return
        best = max(gains_ns, key=gains_ns.__getitem__)
        present_ns = gains_ns.get(self._choice, -math.inf) if self.locked else 0.0
        if gains_ns[best] > max(present_ns, 0.0) + WORTH * beats[best.leader].period_ns:
            self._choice, self.locked = best, True
        elif present_ns < 0:
            self.locked = False

    # Measurements wait N / 2 on average for the next of frames of length N, when they are as likely to be made at one
    # time of the frame as at any other. Where N is a whole number of their periods P, so that the newest is always
    # w old when its reply is composed, the mean is N / 2 - P / 2 + w.

    def _aligned_ns(
        self, earliest_ns: int, composed_ns: Mapping[int, int], leader: int, beats: Mapping[int, _Beat]
    ) -> float:
        """Return P / 2 - w of all stations that share the leader's beat, in sum."""
        led = beats[leader]
        start_ns = earliest_ns + led.until_ns(earliest_ns + composed_ns[leader])
        gain_ns = 0.0
        for index in beats.keys() & composed_ns.keys():
            beat = beats[index]
            times = round(led.period_ns / beat.period_ns)
            if abs(led.period_ns - times * beat.period_ns) <= SAME_PERIOD * led.period_ns:
                newest_ns = (start_ns + composed_ns[index] - beat.ready_ns) % beat.period_ns
                gain_ns += beat.period_ns / 2 - newest_ns
        return gain_ns

    def _longer_ns(self, period_ns: float) -> float:
        """Return what longer frames, and those that come too late for the beat, cost in mean age.

        A frame of several periods needs part of its time for the measurements that it is so long for; in shorter ones
        less would be needed. They are taken for twice as short.
        """
        frame_ns = _whole_ns(self._need_ns, period_ns)
        longer_ns = frame_ns - self._need_ns
        return (longer_ns if frame_ns > period_ns else longer_ns / 2) + fmean(self._behind_ns)

    def _pause_ns(self, beat: _Beat, composed_ns: int, lasts_ns: int) -> int:
        """Return how long to wait before the beacon, so that the leader's reply is composed on its beat."""
        pause_ns = beat.until_ns(composed_ns)
        if lasts_ns + self._overhead_ns <= pause_ns:
            return 0  # a whole frame fits in before
        usual_ns = _whole_ns(self._need_ns, beat.period_ns) - self._need_ns
        if self._need_ns > beat.period_ns and usual_ns > beat.period_ns / 2:
            return 0  # frames have become longer than the beat, which is about to be given up
        # Much more than usual means that the beat has just been missed: better late now than not until the next.
        return pause_ns if pause_ns <= usual_ns + beat.period_ns / 4 else 0


def _whole_ns(need_ns: float, period_ns: float) -> float:
    """Return the shortest whole number of periods that is long enough."""
    return max(math.ceil(need_ns / period_ns), 1) * period_ns


def _orders(stations: int) -> list[SlotOrder]:
    """Return the orders that differ."""
    directions = (False,) if stations <= 2 else (False, True)
    return [SlotOrder(first, reverse) for reverse in directions for first in range(stations)]
