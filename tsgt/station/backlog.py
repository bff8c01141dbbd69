"""What earlier runs of a station's client have left behind: read from their journals at the start."""

from __future__ import annotations

from dataclasses import dataclass, replace
from operator import attrgetter
from typing import TYPE_CHECKING, NamedTuple

import structlog

from tsgt.model import PolarMeasurement
from tsgt.radio.superframe import KNOWN_LINEAGES, Queued, Reception
from tsgt.radio.superframe.wire import RESTART_SKIP, angle_code
from tsgt.recording import MAX_LINE_BYTES, Typed, decode
from tsgt.recording.journal import AcknowledgedRecord, JournalRecord, ReceptionRecord

if TYPE_CHECKING:
    from pathlib import Path

MOST_MEASUREMENTS = 10_000
"""More than an hour; what is older stays in the journals."""

LINEAGE_BITS = 16

_TAIL_BYTES = 8_000_000
_MORE = 4
"""So many measurements take at most so much of a journal, with the beacons between them. Where there are fewer it is read
from further back: beacons alone fill so much in six hours."""

_HEAD_LINES = 2

log = structlog.get_logger()


@dataclass(frozen=True, slots=True, kw_only=True)
class Backlog:
    """What a new run of the client goes on from.

    Attributes
    ----------
    lineage
        Of the sequence numbers that go on; None where there are none.
    run_start
        Number of the first measurement of this run.
    queued
        What has not been acknowledged, oldest first.
    receptions
        Of beacons; those by one clock in the order in which they were made.
    """

    lineage: int | None = None
    run_start: int = 0
    queued: tuple[Queued, ...] = ()
    receptions: tuple[Reception, ...] = ()


def queued(measurement: PolarMeasurement, unix_at_zero_ns: int, boot: str) -> Queued:
    """Return a measurement of a journal as it is delivered.

    Parameters
    ----------
    measurement
        Its ``stamp_ns`` is on the Unix clock of the run that made it.
    unix_at_zero_ns, boot
        See :class:`~tsgt.recording.journal.JournalRecord`.
    """
    return Queued(
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
    """Read what is left from a folder of journals; lines and files that cannot be read are passed over.

    Parameters
    ----------
    directory
        The folder.
    station
        Number of the station.
    """
    journals = [
        (head, path)
        for path in sorted(directory.glob(f"station{station}-*.jsonl"))
        if (head := _head(path, station)) is not None
    ]
    if not journals:
        return Backlog()
    # A run that began while the disk took nothing has a lineage of its own, and what was left before is still left.
    lineages = list(dict.fromkeys(head.lineage for head, _ in reversed(journals)))[:KNOWN_LINEAGES]
    left = max((_left(journals, lineage) for lineage in lineages), key=lambda each: len(each.undelivered))
    undelivered, receptions = left.undelivered, left.receptions
    if len(undelivered) > MOST_MEASUREMENTS:
        log.warning("measurements_discarded", measurements=len(undelivered) - MOST_MEASUREMENTS)
    # A run that has heard no master leaves measurements whose time rests on what the runs before it have heard.
    boots = {each.boot for each in undelivered}
    for head, path in reversed(journals):
        if path not in left.read and head.boot in boots and len(receptions) < MOST_MEASUREMENTS:
            receptions = _tail(head, path).receptions + receptions
    return Backlog(
        lineage=left.lineage,
        run_start=left.last + 1 + RESTART_SKIP,
        queued=tuple(undelivered[-MOST_MEASUREMENTS:]),
        receptions=tuple(sorted(receptions[-MOST_MEASUREMENTS:], key=attrgetter("received_ns"))),
    )


class _Left(NamedTuple):
    """What the runs of one lineage have left.

    Attributes
    ----------
    lineage
        Of the sequence numbers.
    last
        The highest of them.
    undelivered, receptions
        In the order of the runs.
    read
        The journals that had to be read for that.
    """

    lineage: int | None
    last: int
    undelivered: list[Queued]
    receptions: list[Reception]
    read: set[Path]


def _left(journals: list[tuple[JournalRecord, Path]], lineage: int | None) -> _Left:
    # The names tell the order only as well as the computer's Unix clock; the numbers do, within a lineage.
    runs = sorted(
        (journal for journal in journals if journal[0].lineage == lineage),
        key=lambda journal: journal[0].run_start,
        reverse=True,
    )
    oldest, last = 0, runs[0][0].run_start - 1
    measurements: list[Queued] = []
    receptions: list[Reception] = []
    read: set[Path] = set()
    for head, path in runs:
        tail = _tail(head, path)
        read.add(path)
        measurements = tail.measurements + measurements
        receptions = tail.receptions + receptions
        last = max((last, *(each.sequence for each in tail.measurements[-1:])))
        oldest = max(oldest, tail.oldest)
        if oldest >= head.run_start or len(measurements) > MOST_MEASUREMENTS:
            break
    undelivered = [each for each in measurements if each.sequence >= oldest]
    return _Left(lineage, last, undelivered, receptions, read)


def _head(path: Path, station: int) -> JournalRecord | None:
    """Return whose journal this is; None for one of another station or without a lineage."""
    try:
        with path.open("rb") as file:
            lines = [file.readline(MAX_LINE_BYTES) for _ in range(_HEAD_LINES)]
        head = decode(JournalRecord, lines[-1])
    except (OSError, ValueError):
        return None
    if not head.boot:  # then no two runs are known to share a clock
        head = replace(head, boot=path.name)
    return head if head.station == station and head.lineage is not None else None


class _Tail(NamedTuple):
    """What the end of a journal holds, in the order of the file.

    Attributes
    ----------
    measurements, receptions
        Those.
    oldest
        All measurements below it are acknowledged, or were given up.
    """

    measurements: list[Queued]
    receptions: list[Reception]
    oldest: int


def _tail(head: JournalRecord, path: Path) -> _Tail:
    """Read a journal from as far back as it takes to know its last number and what is acknowledged."""
    back = _TAIL_BYTES
    while True:
        tail, enough = _read_last(back, head, path)
        if enough:
            return tail
        back *= _MORE


def _read_last(back: int, head: JournalRecord, path: Path) -> tuple[_Tail, bool]:
    """Return what so many bytes at the end of a journal hold, and whether there is no use in reading more of it."""
    tail, acknowledged = _Tail([], [], 0), False
    zero_ns = head.unix_at_zero_ns
    try:
        with path.open("rb") as file:
            place = max(0, path.stat().st_size - back)
            file.seek(place)
            for line in file:
                try:
                    match decode(Typed, line).type:
                        case "measurement":
                            measurement = decode(PolarMeasurement, line)
                            tail.measurements.append(queued(measurement, zero_ns, head.boot))
                        case "reception":
                            tail.receptions.append(
                                _reception(decode(ReceptionRecord, line), zero_ns, head.boot)
                            )
                        case "acknowledged":
                            tail = tail._replace(oldest=decode(AcknowledgedRecord, line).oldest)
                            acknowledged = True
                except ValueError:
                    continue  # torn, or the rest of a line that begins before the tail
    except OSError as error:
        log.warning("journal_unreadable", path=str(path), error=error.strerror or str(error))
        return tail, True
    told = acknowledged and len(tail.measurements) > 0
    return tail, told or place == 0 or len(tail.measurements) > MOST_MEASUREMENTS


def _reception(record: ReceptionRecord, zero_ns: int, boot: str) -> Reception:
    return Reception(
        session=record.session,
        counter=record.counter,
        received_ns=record.stamp_ns - zero_ns,
        sigma_ns=record.stamp_sigma_ns,
        sent_us=record.sent_us,
        boot=boot,
    )
