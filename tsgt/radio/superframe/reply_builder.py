"""Builds a station's reply: pending control messages, then measurements, then what else fits. Sans-I/O."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING

from tsgt.radio.superframe.wire import (
    MAX_NARROW_AGE_NS,
    WIDE_TIME_BITS,
    EncodedMeasurement,
    JoinRequest,
    MeasurementBlock,
    Reply,
    distance_code,
    is_far,
    reply_bytes,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from tsgt.radio.superframe.command_exchange import InstrumentState
    from tsgt.radio.superframe.send_queue import QueuedMeasurement, SendQueue, StampedMeasurement
    from tsgt.radio.superframe.session import ReplySlot, StationSession
    from tsgt.radio.superframe.wire import StatusReport

MAX_BLOCK_MEASUREMENTS = 16
MAX_BLOCKS = 15

MIN_MEASUREMENT_BYTES = 6  # minimum length of a measurement that is not the first of its block
TYPICAL_MEASUREMENT_BYTES = 8  # usual length of one

_QUALITY_SPREAD = 2
_GOOD_QUALITY = 7
"""A block has the worst quality of its measurements. Measurements up to this quality, 2 ms, share a block; a worse one
that differs by more than the spread from the newest of the block gets a block of its own, which takes three times the
room."""

MAX_SHORT_QUEUE = 8  # a longer queue is a backlog, delivered newest first

MAX_SKIPPED_REPLIES, MAX_SKIPPED_REPLIES_OF_BACKLOG = 2, 8
"""After this many replies without the oldest of the queue it takes precedence for one reply: what the master has beyond it is
acknowledged with it, while grants that fit new measurements only would never come to it.
"""


class ReplyBuilder:
    """Builds the replies of one station."""

    def __init__(self, send_queue: SendQueue, stream_id: int) -> None:
        self._queue = send_queue
        self._stream_id = stream_id
        self._skipped_replies = 0

    def build(
        self, session: StationSession, slot: ReplySlot, state: InstrumentState, report: StatusReport
    ) -> tuple[Reply, tuple[int, ...]]:
        """Return the reply and its sequence numbers; a turnaround comes last, with a status report, unless overdue."""
        limit_bytes = slot.slot.max_reply_bytes
        parts = self._control_parts(session, state, report, limit_bytes)
        urgent = self._by_urgency(session, slot.start_ns, limit_bytes // MIN_MEASUREMENT_BYTES)
        prism = session.commands.known_prism(parts.status_report or report)
        narrow = session.delivery.may_be_narrow
        reply, packed = pack(parts, urgent, limit_bytes, prism=prism, is_narrow=narrow)
        turnaround_us = session.turnaround_us()
        if turnaround_us is not None:
            extended = replace(parts, status_report=report, turnaround_us=turnaround_us)
            longer, still = pack(extended, urgent, limit_bytes, prism=prism, is_narrow=narrow)
            fits = reply_bytes(longer) <= limit_bytes
            if fits and (len(still) == len(packed) or session.commands.turnaround_overdue):
                reply, packed = longer, still
        sequences = tuple(stamped.queued.sequence for stamped in packed)
        left_out = urgent and min(stamped.queued.sequence for stamped in urgent) not in sequences
        self._skipped_replies = self._skipped_replies + 1 if left_out else 0
        return reply, sequences

    def _control_parts(
        self, session: StationSession, state: InstrumentState, report: StatusReport, limit_bytes: int
    ) -> Reply:
        """Return join request, response, single measurement and status report, as far as pending and as they fit."""
        commands, delivery = session.commands, session.delivery
        if delivery.outdated and not delivery.join_pending:
            delivery.request_join()
        pending: list[dict[str, object]] = []
        if not session.confirmed or delivery.join_pending:
            pending.append({"join_request": self._join_request(session)})
        # The newest: a master waits for the response to its last command only.
        pending += [{"response": response} for response in list(commands.responses)[-1:]]
        pending += [{"single_measurement": single} for single in list(commands.single_measurements)[-1:]]
        if commands.needs_report(state):
            pending.append({"status_report": report})
        reply = Reply()
        for part in pending:
            longer = replace(reply, **part)  # type: ignore[arg-type]  # mypy cannot see that name and type agree
            if reply_bytes(longer) <= limit_bytes:
                reply = longer
        return reply

    def _join_request(self, session: StationSession) -> JoinRequest:
        return JoinRequest(
            nonce=session.nonce,
            stream_id=self._stream_id,
            first_sequence=self._queue.first_sequence,
            oldest=session.delivery.oldest,
        )

    def _by_urgency(
        self, session: StationSession, slot_ns: int, max_measurements: int
    ) -> list[StampedMeasurement]:
        """Return the timed measurements, the most urgent first.

        Of a short queue the newest, and then from the oldest on; of a backlog newest first. The oldest of the queue is always among them, and comes first if the last replies have left it out.
        """
        urgent: list[StampedMeasurement] = []

        def add(candidates: Iterable[QueuedMeasurement], count: int) -> None:
            for queued in islice(candidates, count):
                stamped = session.timestamped(queued, slot_ns, urgent[0] if urgent else None)
                if stamped is None:
                    session.untimed.append(queued)
                elif not urgent or queued.sequence < urgent[-1].queued.sequence:
                    urgent.append(stamped)

        session.untimed.clear()
        add(self._queue.newest_first(session.reach), max_measurements)
        add(self._queue.oldest_first(session.reach), 1)
        short = len(self._queue) <= MAX_SHORT_QUEUE
        limit = MAX_SKIPPED_REPLIES if short else MAX_SKIPPED_REPLIES_OF_BACKLOG
        if short:
            urgent[1:] = urgent[:0:-1]
        if len(urgent) > 1 and self._skipped_replies >= limit:
            urgent.insert(0, urgent.pop(1 if short else -1))
        return urgent


def pack(
    parts: Reply,
    by_urgency: Sequence[StampedMeasurement],
    limit_bytes: int,
    *,
    prism: int | None,
    is_narrow: Callable[[int, int], bool],
) -> tuple[Reply, tuple[StampedMeasurement, ...]]:
    """Fill a reply with measurements up to ``limit_bytes``; return it and the measurements in it, newest first.

    Parameters
    ----------
    parts
        The rest of the reply, which fits.
    prism
        The prism that the master assumes; None: each block names its own.
    is_narrow
        See :meth:`~tsgt.radio.superframe.send_queue.DeliveryProgress.may_be_narrow`.
    """

    def filled(count: int) -> tuple[Reply, tuple[StampedMeasurement, ...]]:
        newest_first = tuple(sorted(by_urgency[:count], key=_sequence, reverse=True))
        return replace(parts, blocks=_blocks(newest_first, prism, is_narrow)), newest_first

    fits, best = 0, filled(0)
    too_many = len(by_urgency) + 1
    count = min(len(by_urgency), limit_bytes // TYPICAL_MEASUREMENT_BYTES + 1)
    while fits < count < too_many:
        reply, newest_first = filled(count)
        length = reply_bytes(reply)
        if len(reply.blocks) <= MAX_BLOCKS and length <= limit_bytes:
            fits, best, count = count, (reply, newest_first), count + 1
        else:
            too_many, count = count, max(fits + 1, min(count - 1, count * limit_bytes // length + 1))
    return best


def _sequence(stamped: StampedMeasurement) -> int:
    return stamped.queued.sequence


def _blocks(
    newest_first: Sequence[StampedMeasurement], prism: int | None, is_narrow: Callable[[int, int], bool]
) -> tuple[MeasurementBlock, ...]:
    groups: list[list[StampedMeasurement]] = []
    for stamped in newest_first:
        if groups and _share_block(groups[-1], stamped):
            groups[-1].append(stamped)
        else:
            groups.append([stamped])
    return tuple(_block(group, prism, is_narrow, _sequence(newest_first[0])) for group in groups)


def _share_block(group: list[StampedMeasurement], stamped: StampedMeasurement) -> bool:
    newest = group[0]
    return (
        len(group) < MAX_BLOCK_MEASUREMENTS
        and stamped.queued.prism == newest.queued.prism
        and stamped.beacon_relative == newest.beacon_relative
        and is_far(stamped.queued.distance_m) == is_far(newest.queued.distance_m)
        and max(stamped.quality, newest.quality)
        <= max(min(stamped.quality, newest.quality) + _QUALITY_SPREAD, _GOOD_QUALITY)
        and abs(stamped.time - group[-1].time) < 1 << WIDE_TIME_BITS - 1
    )


def _block(
    group: list[StampedMeasurement],
    prism: int | None,
    is_narrow: Callable[[int, int], bool],
    highest: int,
) -> MeasurementBlock:
    newest = group[0]
    far = is_far(newest.queued.distance_m)
    narrow = (
        newest.age_ns is not None
        and newest.age_ns <= MAX_NARROW_AGE_NS
        and is_narrow(newest.queued.sequence, highest)
    )
    return MeasurementBlock(
        measurements=tuple(
            EncodedMeasurement(
                stamped.queued.sequence,
                stamped.time,
                stamped.queued.status,
                stamped.queued.horizontal,
                stamped.queued.zenith,
                distance_code(stamped.queued.distance_m, far=far),
            )
            for stamped in group
        ),
        beacon_relative=newest.beacon_relative,
        quality=max(stamped.quality for stamped in group),
        wide=not narrow,
        prism=None if newest.queued.prism == prism else newest.queued.prism,
        far=far,
    )
