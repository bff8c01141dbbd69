"""What a station's client read in a simulated mission, and its journals: for invariant checks."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING

from tsgt.recording import decode, decode_line, read_lines
from tsgt.recording.journal import AcknowledgedRecord, load_journal
from tsgt.simulation.mission.daemon_configs import STATUS_SOCKET
from tsgt.simulation.mission.disk import UNWRITTEN_WINDOW_NS
from tsgt.station import ClientStatus

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tsgt.model import PolarMeasurement
    from tsgt.simulation.instrument import ReportedDistance

_HEAD_LINES = 2
# Tasks of a killed daemon may run a little longer.
_SHUTDOWN_NS = 5_000_000
# Clock offsets from two valid beacons agree to within this.
_MAX_DISAGREEMENT_US = 20_000
# A restarted station accepts a journalled clock offset based on five beacons; some may have been outliers.
_MIN_RECEPTIONS = 8


@dataclass(slots=True)
class StationLog:
    """What a station's client read from its instrument, delivered or not.

    Attributes
    ----------
    true_times_ns
        True time of each reading's timestamp, by its host time; both in ns.
    read_times_ns
        True time at which the client got each reading, by its host time; both in ns.
    crash_windows_ns
        Start and end of the true times in which readings may be unjournalled; the client was killed at the end.
    """

    station: int
    folder: Path | None  # folder of its journals; None: it keeps none
    reported_distances: Sequence[ReportedDistance] = ()  # every distance that its instrument reported
    true_times_ns: dict[int, int] = field(default_factory=dict)
    read_times_ns: dict[int, int] = field(default_factory=dict)
    crash_windows_ns: list[tuple[int, int]] = field(default_factory=list)
    statuses: list[ClientStatus] = field(default_factory=list)  # status of the client before each end
    reportable_status: ClientStatus | None = None  # so long before the end that the master must know it

    def may_be_unwritten(self, true_ns: int, before_ns: int = 0, *, write_errors_only: bool = False) -> bool:
        """Whether a client was killed before it must have journalled what it read at a true time in ns from the start.

        The reading may be up to ``before_ns`` later. ``write_errors_only`` accepts only kills during a write error of the disk.
        """
        return any(
            from_ns - before_ns <= true_ns <= to_ns + _SHUTDOWN_NS
            and not (write_errors_only and to_ns - from_ns == UNWRITTEN_WINDOW_NS)
            for from_ns, to_ns in self.crash_windows_ns
        )

    @property
    def journals(self) -> list[Path]:
        """Its journals, one per start."""
        return [] if self.folder is None else sorted(self.folder.glob("*.jsonl"))

    async def client_status(self) -> ClientStatus | None:
        """Return the status of the running client; None if it is not listening, and of the authors' node, which has none."""
        if self.folder is None:
            return None
        with suppress(OSError):
            reader, writer = await asyncio.open_unix_connection(self.folder / STATUS_SOCKET)
            status = decode(ClientStatus, await reader.readline())
            writer.close()
            return status
        return None


class JournalIndex:
    """Finds the journal entry and the true time of delivered measurements of a station.

    Over protocol ``classic`` a measurement is identified by its host time, over ``superframe`` by its sequence number.
    """

    def __init__(self, station_log: StationLog) -> None:
        self.station_log = station_log
        self._true_ns = station_log.true_times_ns
        journals = [load_journal(path) for path in station_log.journals if _has_header(path)]
        self.journalled_by_start = [journal.measurements for journal in journals]
        self.journalled = [m for journal in journals for m in journal.measurements]
        self._heads = {m.sequence: journal.head for journal in journals for m in journal.measurements}
        self.sent_us: dict[
            tuple[int, int], int
        ] = {}  # when a beacon was sent by the master's session time, by session and number
        self._offsets_us: dict[tuple[str, int], list[int]] = {}
        for journal in journals:
            for reception in journal.receptions:
                offsets_us = self._offsets_us.setdefault((journal.head.boot, reception.session), [])
                offsets_us.append(reception.sent_us - reception.stamp_ns // 1000)
                self.sent_us[reception.session, reception.counter] = reception.sent_us
        # By modification time, because Unix clock steps may reorder the names.
        last = max(station_log.journals, key=lambda path: path.stat().st_mtime_ns, default=None)
        self._last_journal = last if last is not None and _has_header(last) else None
        self._last = load_journal(self._last_journal).head if self._last_journal is not None else None
        self._by_sequence = {m.sequence: m for m in self.journalled}
        self._by_host_time = {m.host_time_ns: m for m in self.journalled}

    def find(self, measurement: PolarMeasurement) -> PolarMeasurement | None:
        """Return the journal entry of a measurement; None: there is none."""
        if measurement.host_time_ns is None:
            return self._by_sequence.get(measurement.sequence)
        return self._by_host_time.get(measurement.host_time_ns)

    def true_ns(self, measurement: PolarMeasurement) -> int | None:
        """Return the true time of the client's timestamp in ns from the start; None: the client never read it."""
        host_time_ns = measurement.host_time_ns
        if host_time_ns is None and (journalled := self.find(measurement)) is not None:
            host_time_ns = journalled.host_time_ns
        return None if host_time_ns is None else self._true_ns.get(host_time_ns)

    def oldest_queued(self) -> int | None:
        """Return the lowest unacknowledged sequence number by the last journal, which records it at most every 5 s.

        Without such a record: the first in that journal; None: there is neither.
        """
        if (path := self._last_journal) is None:
            return None
        acknowledged = [line for line in read_lines(path) if line.type == "acknowledged"]
        if not acknowledged:
            return min((m.sequence for m in load_journal(path).measurements), default=None)
        return decode_line(AcknowledgedRecord, acknowledged[-1], path).oldest

    def has_no_timestamp(self, sequence: int, session: int | None) -> bool:
        """Whether a measurement cannot be converted to the time of a master's session.

        Its computer was rebooted before it had synchronised in that session, or its client was restarted on a failing disk and
        has a new stream id.
        """
        head = self._heads[sequence]
        if self._last is None or head.stream_id != self._last.stream_id:
            return True
        if head.boot == self._last.boot:
            return False
        offsets_us = self._offsets_us.get((head.boot, session), []) if session is not None else []
        # The first beacons may have been delayed; with enough of them the station detects that.
        reception = len(offsets_us) >= _MIN_RECEPTIONS
        return not reception or all(abs(b - a) > _MAX_DISAGREEMENT_US for a, b in combinations(offsets_us, 2))


def _has_header(path: Path) -> bool:
    """Whether a journal has its header lines; a client that is killed at once leaves less."""
    with path.open("rb") as file:
        return [file.readline()[-1:] for _ in range(_HEAD_LINES)] == [b"\n"] * _HEAD_LINES
