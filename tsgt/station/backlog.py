"""Recovers undelivered measurements and beacon receptions from the journals of earlier runs of a station's client."""

from __future__ import annotations

from dataclasses import dataclass, replace
from operator import attrgetter
from typing import TYPE_CHECKING, NamedTuple

import structlog

from tsgt.model import PolarMeasurement
from tsgt.radio.superframe import MAX_STREAMS, QUEUE_CAPACITY, BeaconReception, QueuedMeasurement
from tsgt.radio.superframe.wire import RESTART_SKIP, angle_code
from tsgt.recording import MAX_LINE_BYTES, Typed, decode
from tsgt.recording.journal import AcknowledgedRecord, JournalRecord, ReceptionRecord

if TYPE_CHECKING:
    from pathlib import Path

MAX_RECEPTIONS = 10_000  # more than an hour

STREAM_ID_BITS = 16

_TAIL_BYTES = 8_000_000
_TAIL_GROWTH = 4
"""The tail of a journal of more than an hour with the beacons between the measurements. Where it does not reach back to the oldest
measurement that is not acknowledged, a longer one is read; beacons alone fill it in six hours."""

log = structlog.get_logger()


@dataclass(frozen=True, slots=True, kw_only=True)
class Backlog:
    """State that a new run of the client continues from.

    Attributes
    ----------
    stream_id
        Identifies the sequence numbers that are continued; None to start new ones.
    first_sequence
        Sequence number of this run's first measurement.
    queued
        Unacknowledged measurements, oldest first.
    receptions
        Receptions of beacons; those on one clock in chronological order.
    """

    stream_id: int | None = None
    first_sequence: int = 0
    queued: tuple[QueuedMeasurement, ...] = ()
    receptions: tuple[BeaconReception, ...] = ()


def queued_measurement(measurement: PolarMeasurement, unix_at_zero_ns: int, boot: str) -> QueuedMeasurement:
    """Return a journalled measurement as it is delivered; see :class:`~tsgt.recording.journal.JournalRecord`."""
    return QueuedMeasurement(
        sequence=measurement.sequence,
        at_ns=measurement.stamp_ns - unix_at_zero_ns,
        boot=boot,
        prism=measurement.prism,
        status=measurement.status,
        horizontal=angle_code(measurement.horizontal_angle_rad),
        zenith=angle_code(measurement.zenith_angle_rad),
        distance_m=measurement.slope_distance_m,
    )


def read_backlog(directory: Path, station: int) -> Backlog:
    """Read the backlog from a folder of journals; unreadable lines and files are skipped."""
    journals = [
        (head, path)
        for path in sorted(directory.glob(f"station{station}-*.jsonl"))
        if (head := _head(path, station)) is not None
    ]
    if not journals:
        return Backlog()
    # A run that started while the disk was full has a stream of its own; the stream before it may still have a backlog.
    stream_ids = list(dict.fromkeys(head.stream_id for head, _ in reversed(journals)))[:MAX_STREAMS]
    stream = max(
        (_read_stream(journals, each) for each in stream_ids), key=lambda each: len(each.undelivered)
    )
    undelivered, receptions = stream.undelivered, stream.receptions
    if len(undelivered) > QUEUE_CAPACITY:
        log.warning("measurements_discarded", measurements=len(undelivered) - QUEUE_CAPACITY)
    # The times of a run that received no beacon rest on the receptions of earlier runs on the same clock.
    boots = {each.boot for each in undelivered}
    for head, path in reversed(journals):
        if path not in stream.paths and head.boot in boots and len(receptions) < MAX_RECEPTIONS:
            receptions = _tail(head, path).receptions + receptions
    return Backlog(
        stream_id=stream.stream_id,
        first_sequence=stream.last_sequence + 1 + RESTART_SKIP,
        queued=tuple(undelivered[-QUEUE_CAPACITY:]),
        receptions=tuple(sorted(receptions[-MAX_RECEPTIONS:], key=attrgetter("received_ns"))),
    )


class _Stream(NamedTuple):
    """The backlog of the runs that share a stream id, in the order of the runs, and the journals read for it."""

    stream_id: int | None
    last_sequence: int
    undelivered: list[QueuedMeasurement]
    receptions: list[BeaconReception]
    paths: set[Path]


def _read_stream(journals: list[tuple[JournalRecord, Path]], stream_id: int | None) -> _Stream:
    # File names are in the order of the computer's Unix clock, which may be wrong; sequence numbers are reliable.
    runs = sorted(
        (journal for journal in journals if journal[0].stream_id == stream_id),
        key=lambda journal: journal[0].first_sequence,
        reverse=True,
    )
    oldest, last_sequence = 0, runs[0][0].first_sequence - 1
    measurements: list[QueuedMeasurement] = []
    receptions: list[BeaconReception] = []
    paths: set[Path] = set()
    for head, path in runs:
        tail = _tail(head, path)
        paths.add(path)
        measurements = tail.measurements + measurements
        receptions = tail.receptions + receptions
        last_sequence = max((last_sequence, *(each.sequence for each in tail.measurements[-1:])))
        oldest = max(oldest, tail.oldest)
        if oldest >= head.first_sequence or len(measurements) > QUEUE_CAPACITY:
            break
    undelivered = [each for each in measurements if each.sequence >= oldest]
    return _Stream(stream_id, last_sequence, undelivered, receptions, paths)


def _head(path: Path, station: int) -> JournalRecord | None:
    """Return a journal's second line; None for another station's journal, or one without a stream id."""
    try:
        with path.open("rb") as file:
            file.readline(MAX_LINE_BYTES)
            head = decode(JournalRecord, file.readline(MAX_LINE_BYTES))
    except (OSError, ValueError):
        return None
    if not head.boot:  # then no two runs are known to share a clock
        head = replace(head, boot=path.name)
    return head if head.station == station and head.stream_id is not None else None


class _Tail(NamedTuple):
    """The content of a journal's end, in the order of the file; measurements before ``oldest`` are acknowledged."""

    measurements: list[QueuedMeasurement]
    receptions: list[BeaconReception]
    oldest: int


def _tail(head: JournalRecord, path: Path) -> _Tail:
    """Read as much of a journal's end as needed for its last sequence number and the last acknowledgement."""
    size = _TAIL_BYTES
    while True:
        tail, complete = _read_last(size, head, path)
        if complete:
            return tail
        size *= _TAIL_GROWTH


def _read_last(size: int, head: JournalRecord, path: Path) -> tuple[_Tail, bool]:
    """Return the content of the last ``size`` bytes of a journal, and whether it is sufficient."""
    tail, acknowledged = _Tail([], [], 0), False
    zero_ns = head.unix_at_zero_ns
    try:
        with path.open("rb") as file:
            start = max(0, path.stat().st_size - size)
            file.seek(start)
            for line in file:
                try:
                    match decode(Typed, line).type:
                        case "measurement":
                            measurement = decode(PolarMeasurement, line)
                            tail.measurements.append(queued_measurement(measurement, zero_ns, head.boot))
                        case "reception":
                            tail.receptions.append(
                                _reception(decode(ReceptionRecord, line), zero_ns, head.boot)
                            )
                        case "acknowledged":
                            tail = tail._replace(oldest=decode(AcknowledgedRecord, line).oldest)
                            acknowledged = True
                except ValueError:
                    continue  # torn, or the end of a line that begins before the tail
    except OSError as error:
        log.warning("journal_unreadable", path=str(path), error=error.strerror or str(error))
        return tail, True
    sufficient = acknowledged and bool(tail.measurements) and tail.measurements[0].sequence <= tail.oldest
    return tail, sufficient or start == 0 or len(tail.measurements) > QUEUE_CAPACITY


def _reception(record: ReceptionRecord, zero_ns: int, boot: str) -> BeaconReception:
    return BeaconReception(
        session=record.session,
        counter=record.counter,
        received_ns=record.stamp_ns - zero_ns,
        sigma_ns=record.stamp_sigma_ns,
        sent_us=record.sent_us,
        boot=boot,
    )
