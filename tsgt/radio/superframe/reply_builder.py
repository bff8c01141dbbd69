"""Which measurements go into a reply: as many as fit, in runs of what belongs together."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.superframe.wire import (
    WIDE_TIME_BITS,
    Reply,
    Run,
    Sighting,
    distance_code,
    is_far,
    quality_bound_us,
    reply_bytes,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.radio.superframe.send_queue import Queued

NARROW_AGE_NS = 2_000_000_000
"""A measurement that is older than this when the reply begins needs a wide run: narrow times repeat after 2.1 s."""

WORST_QUALITY = 15
LONGEST_RUN = 16
MOST_RUNS = 15

LEAST_SIGHTING_BYTES = 6
USUAL_SIGHTING_BYTES = 8
"""What a measurement takes at least, and as a rule, that is not the newest of its run."""

_QUALITY_SPREAD = 2
_GOOD_QUALITY = 7
"""A run tells its worst quality. A measurement that is better than this, 2 ms, may be told so; otherwise one that is
worse than the newest of its run by more than the spread gets another run, which takes three times the room."""


class Timed(NamedTuple):
    """A measurement with its time as it goes over the air.

    Attributes
    ----------
    queued
        The measurement.
    time
        In :data:`~tsgt.radio.superframe.wire.messages.TIME_UNIT_US`, in full: of the master's session, or from the beacon with ``direct``.
    quality
        How good it is, 0 to 15.
    direct
        See :class:`~tsgt.radio.superframe.wire.messages.Run`.
    age_ns
        How old it is when the reply begins; None where this computer's clock cannot tell.
    """

    queued: Queued
    time: int
    quality: int
    direct: bool
    age_ns: int | None


def quality_of(bound_us: float) -> int | None:
    """Return the best quality that claims no more than this bound; None where none does."""
    for quality in range(WORST_QUALITY + 1):
        if bound_us <= quality_bound_us(quality):
            return quality
    return None


def pack(
    parts: Reply,
    by_urgency: Sequence[Timed],
    limit_bytes: int,
    *,
    prism: int | None,
    is_narrow: Callable[[int, int], bool],
) -> tuple[Reply, tuple[Timed, ...]]:
    """Fill a reply with measurements.

    Parameters
    ----------
    parts
        What else it says; it fits.
    by_urgency
        The measurements, the one that is wanted most first.
    limit_bytes
        What the reply may take, code and all.
    prism
        The one that need not be named; None: each is.
    is_narrow
        Whether the master finds a sequence number again from its low bits; the second number is the newest in the reply.

    Returns
    -------
    Reply, tuple of Timed
        The reply, and the measurements in it in their order.
    """

    def filled(count: int) -> tuple[Reply, tuple[Timed, ...]]:
        newest_first = tuple(sorted(by_urgency[:count], key=_sequence, reverse=True))
        reply = Reply(
            runs=_runs(newest_first, prism, is_narrow),
            introduction=parts.introduction,
            state=parts.state,
            turn_round_us=parts.turn_round_us,
            answer=parts.answer,
            shot=parts.shot,
        )
        return reply, newest_first

    fits, best = 0, filled(0)
    too_many = len(by_urgency) + 1
    count = min(len(by_urgency), limit_bytes // USUAL_SIGHTING_BYTES + 1)
    while fits < count < too_many:
        reply, newest_first = filled(count)
        length = reply_bytes(reply)
        if len(reply.runs) <= MOST_RUNS and length <= limit_bytes:
            fits, best, count = count, (reply, newest_first), count + 1
        else:
            too_many, count = count, max(fits + 1, min(count - 1, count * limit_bytes // length + 1))
    return best


def _sequence(timed: Timed) -> int:
    return timed.queued.sequence


def _runs(
    newest_first: Sequence[Timed], prism: int | None, is_narrow: Callable[[int, int], bool]
) -> tuple[Run, ...]:
    groups: list[list[Timed]] = []
    for timed in newest_first:
        if groups and _belong_together(groups[-1], timed):
            groups[-1].append(timed)
        else:
            groups.append([timed])
    return tuple(_run(group, prism, is_narrow, _sequence(newest_first[0])) for group in groups)


def _belong_together(group: list[Timed], timed: Timed) -> bool:
    newest = group[0]
    return (
        len(group) < LONGEST_RUN
        and timed.queued.prism == newest.queued.prism
        and timed.direct == newest.direct
        and is_far(timed.queued.distance_m) == is_far(newest.queued.distance_m)
        and max(timed.quality, newest.quality)
        <= max(min(timed.quality, newest.quality) + _QUALITY_SPREAD, _GOOD_QUALITY)
        and abs(timed.time - group[-1].time) < 1 << WIDE_TIME_BITS - 1
    )


def _run(group: list[Timed], prism: int | None, is_narrow: Callable[[int, int], bool], highest: int) -> Run:
    newest = group[0]
    far = is_far(newest.queued.distance_m)
    narrow = (
        newest.age_ns is not None
        and newest.age_ns <= NARROW_AGE_NS
        and is_narrow(newest.queued.sequence, highest)
    )
    return Run(
        sightings=tuple(
            Sighting(
                timed.queued.sequence,
                timed.time,
                timed.queued.status,
                timed.queued.horizontal,
                timed.queued.zenith,
                distance_code(timed.queued.distance_m, far=far),
            )
            for timed in group
        ),
        direct=newest.direct,
        quality=max(timed.quality for timed in group),
        wide=not narrow,
        prism=None if newest.queued.prism == prism else newest.queued.prism,
        far=far,
    )
