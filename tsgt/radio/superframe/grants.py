"""How long a reply each station is granted: what it will want to send, as far as the master can know. Pure.

A slot that is longer than its reply costs everybody time; one that is too short costs this station's measurement a
frame. The master knows the beat of each instrument, up to when it has its measurements and which are missing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

from tsgt.model import Status
from tsgt.radio.superframe.slots import LONGEST_FRAME_NS
from tsgt.radio.superframe.wire import (
    GRANT_BYTES,
    SINGLE_QUALITY,
    AnswerPart,
    Reply,
    Run,
    ShotPart,
    Sighting,
    StatePart,
    reply_bytes,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from tsgt.radio.superframe.slots import FrameTiming
    from tsgt.timesync import Beat

UNKNOWN_GRANT = GRANT_BYTES.index(44)
"""For a station of which nothing is known: introduction, state and a measurement, or five measurements."""

CAPS = (GRANT_BYTES.index(71), GRANT_BYTES.index(125))
"""The longest grant below :data:`MANY_STATIONS`, where a backlog of one would make the others wait, and from there."""

MANY_STATIONS = 8

ABSENT_FRAMES = 6
"""A station that was silent for so many frames gets no more than :data:`UNKNOWN_GRANT`."""

AGAIN_FRAMES = 4
"""A station that was silent for longer is not asked again before the others."""

MOST_MEASUREMENTS = 15

_NOISE = (31, -17, 54, -40, 8, -62, 25)
"""1 mm across the line of sight, in units of an angle at 75 m; of a distance it is twice as much as there is."""

_GAP = 3
"""Of a measurement that was lost the master learns from the next ones."""

COMPOSED_US = 6_000
"""A station decides this long before its slot what it sends."""

EARLY_US = 5_000
EARLY_SPREADS = 3
"""A measurement may be so much ahead of its beat, the latter in units of the usual spread."""


@dataclass(frozen=True, slots=True)
class Demand:
    """What a station is expected to want to send.

    Attributes
    ----------
    measurements
        How many.
    scattered
        There are gaps between them.
    plain
        They need no more than a reply of the form ``single`` offers: the station's clock has settled.
    extended
        Its state and when its last reply left, too.
    answer, shot
        The answer to an order, and the measurement of a target.
    """

    measurements: int
    scattered: bool = False
    plain: bool = True
    extended: bool = False
    answer: bool = False
    shot: bool = False


def grant(demand: Demand, *, cap: int, silent: int) -> int:
    """Return the grant, an index into :data:`GRANT_BYTES`.

    Parameters
    ----------
    demand
        What the station will want to send.
    cap
        The longest grant; see :func:`longest_grant`.
    silent
        For how many frames it has not been heard.
    """
    needed_bytes = demand_bytes(demand)
    if silent >= ABSENT_FRAMES:
        cap = min(cap, UNKNOWN_GRANT)
    fitting = (index for index, longest in enumerate(GRANT_BYTES) if longest >= needed_bytes)
    return min(next(fitting, cap), cap)


def longest_grant(timing: FrameTiming, stations: int) -> int:
    """Return the longest grant where so many stations share the channel: all of them together fit into a frame."""
    slot_ns = LONGEST_FRAME_NS // stations - timing.guard_ns
    most = CAPS[stations >= MANY_STATIONS]
    fitting = [index for index in range(most + 1) if timing.airtime_ns(GRANT_BYTES[index]) <= slot_ns]
    return max(fitting[-1] if fitting else 0, UNKNOWN_GRANT)


def asked_again(silent: Mapping[int, int], granted: Sequence[int]) -> set[int]:
    """Return which stations the next frame is for alone; none where it is for all.

    Where many share the channel, a station whose packet was lost would wait long for its next slot. Those of a whole
    frame that were not heard, though they usually are, get a short one of their own; but one alone that was missed once
    can wait.

    Parameters
    ----------
    silent
        By index of the station: for how many frames it has not been heard.
    granted
        By index: the grants of the frame before; empty where there was none.
    """
    present = {index for index, frames in silent.items() if frames <= AGAIN_FRAMES}
    if len(present) < MANY_STATIONS or not granted or not all(granted[index] for index in present):
        return set()
    missed = {index for index in present if silent[index]}
    worth_it = sum(silent[index] for index in missed) > 1
    return missed if worth_it and 2 * len(missed) <= len(present) else set()


def expected(beat: Beat, *, newest_us: int, heard_us: int, slot_us: int, ready_us: int = 0) -> int:
    """Return how many measurements a station has made at its slot that it could not have sent before; at least one.

    Parameters
    ----------
    beat
        Of its measurements.
    newest_us
        Time of its newest measurement that has come.
    heard_us
        When its last reply that came began.
    slot_us
        When its slot begins.
    ready_us
        How long a measurement needs from its instant until a reply can carry it.
    """
    if newest_us <= heard_us - 1.5 * beat.period_us:  # it did not measure, and may have begun again
        return max(math.ceil((slot_us - heard_us) / beat.period_us), 1)
    made_us = slot_us - max(COMPOSED_US, ready_us) + EARLY_US + EARLY_SPREADS * beat.spread_us
    return max(int((made_us - newest_us) / beat.period_us), 1)


@lru_cache
def demand_bytes(demand: Demand) -> int:
    """Return how long a reply is that carries this, code and all, for an instrument in motion."""
    count = min(demand.measurements, MOST_MEASUREMENTS)
    numbers = [count + _GAP * demand.scattered, *range(count - 1, 0, -1)] if count else []
    sightings = tuple(_sighting(number) for number in numbers)
    run = Run(sightings=sightings)
    state = StatePart(prism=1, direct=False, connected=True, late=0, doubted=0, rssi_dbm=-100)
    return reply_bytes(
        Reply(
            runs=(run if demand.plain else replace(run, quality=SINGLE_QUALITY + 1, prism=1),)
            if sightings
            else (),
            state=state if demand.extended else None,
            turn_round_us=0 if demand.extended else None,
            answer=AnswerPart(0, ok=True) if demand.answer else None,
            shot=ShotPart(0, Status.OK, 0, 0, 1) if demand.shot else None,
        )
    )


def _sighting(number: int) -> Sighting:
    """Make one of a robot at 1.5 m/s, 75 m away and turning, with the noise of an instrument, every 0.4 s."""
    noise = _NOISE[number % len(_NOISE)]
    return Sighting(
        sequence=number,
        time=25_000 * number,
        status=Status.OK,
        horizontal=21_000 * number + 40 * number * number + noise,
        zenith=4_000_000 + noise,
        distance=750_000 + 4_000 * number + 30 * number * number - noise,
    )
