"""Relates the journals of one boot of a station to a session of the master by common measurements and times. Sans-I/O."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import defaultdict
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

from tsgt.analysis.merge.recording_index import identity
from tsgt.analysis.merge.timing import (
    BeaconReception,
    DeliveredTime,
    add_link_delay,
    link_delay,
    times_consistent,
    times_from_beacons,
    times_from_synchronisations,
)
from tsgt.recording.merged import same_content

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from tsgt.analysis.merge.recording_index import Session
    from tsgt.analysis.merge.timing import MasterTime
    from tsgt.model import ClockSample, PolarMeasurement
    from tsgt.recording.journal import Journal

_ROUGH_NS = 5_000_000_000  # Accuracy of a delivered measurement without a timestamp bound
_EARLY_NS = 1_000_000_000  # A response this long before the journal's start may belong to it
_DRIFT = 200e-6  # Upper limit of the frequency difference of two computers' clocks
_AFTER_NS = 10_000_000_000  # Until then a synchronisation belongs to a journal without successor


class IndexedJournal(NamedTuple):
    """A journal, which one run of the client wrote, and its position among the journals."""

    number: int
    journal: Journal

    @property
    def zero_ns(self) -> int:
        """Offset of its times from CLOCK_MONOTONIC of the station's computer."""
        return self.journal.head.unix_at_zero_ns

    @property
    def begin_ns(self) -> int:
        """Time of its creation on CLOCK_MONOTONIC."""
        return self.journal.created_ns - self.zero_ns


class JournalMeasurement(NamedTuple):
    """A measurement of a journal, with its time on CLOCK_MONOTONIC of the station's computer."""

    local_ns: int
    source: IndexedJournal
    measurement: PolarMeasurement


class Boot:
    """Journals of one station that share a CLOCK_MONOTONIC, in the order of their creation, and their measurements by time."""

    def __init__(self, journals: Iterable[IndexedJournal]) -> None:
        self.journals = sorted(journals, key=lambda source: source.begin_ns)
        self.entries = sorted(
            (
                JournalMeasurement(measurement.stamp_ns - source.zero_ns, source, measurement)
                for source in self.journals
                for measurement in source.journal.measurements
            ),
            key=lambda entry: (entry.local_ns, entry.source.number),
        )
        self._stamps_ns = [entry.local_ns for entry in self.entries]
        self._by_identity: dict[object, list[int]] = defaultdict(list)  # several if a journal is given twice
        self._by_sequence: dict[int, list[int]] = defaultdict(list)
        for index, entry in enumerate(self.entries):
            if (
                entry.source.journal.head.stream_id is None
            ):  # superframe does not transmit the station's own time
                self._by_identity[identity(entry.measurement)].append(index)
            self._by_sequence[entry.measurement.sequence].append(index)

    def against(self, session: Session) -> Match:
        """Match the measurements with a session of the master, and compute their times."""
        match = Match([None] * len(self.entries))
        self._match_content(session, match)
        self._match_classic(session, match)
        for beacons in session.beacons:
            self._match_superframe(session, beacons, match)
        return match

    @property
    def station(self) -> int:
        """Number of the station."""
        return self.journals[0].journal.station

    @property
    def superframe(self) -> bool:
        """Whether any of the journals was written with the protocol superframe."""
        return any(source.journal.head.stream_id is not None for source in self.journals)

    # --- Classic --------------------------------------------------------------------------------------------------

    def _match_classic(self, session: Session, match: Match) -> None:
        anchors = []
        for delivered in session.delivered.get(self.station, ()):
            key = identity(delivered)
            indices = [] if key is None else self._by_identity.get(key, [])
            match.delivered.update(indices)
            for index in indices[:1]:
                # Without a bound the timestamp is unusable; the measurement arrived within seconds.
                at_ns = delivered.received_ns if delivered.stamp_bound_ns is None else delivered.stamp_ns
                anchors.append((at_ns, self._stamps_ns[index] - at_ns))
        if not anchors:
            return
        anchors.sort()
        synchronisations = [
            samples
            for clock in session.clocks.get(self.station, ())
            if (samples := self._of_this_boot(clock.samples, anchors))
        ]
        if synchronisations:
            synchronisations.sort(key=lambda samples: samples[-1].station_ns)
            match.update(times_from_synchronisations(synchronisations, self._stamps_ns))

    def _of_this_boot(
        self, samples: Sequence[ClockSample], anchors: Sequence[tuple[int, int]]
    ) -> list[ClockSample]:
        """Return the exchanges that this boot answered, with the station's time on CLOCK_MONOTONIC."""
        answered = []
        for sample in samples:
            after = bisect_left(anchors, (sample.sent_ns, 0))
            anchor_ns, offset_ns = min(
                anchors[max(after - 1, 0) : after + 1], key=lambda anchor: abs(anchor[0] - sample.sent_ns)
            )
            expected_ns = sample.sent_ns + offset_ns
            source = self._journal_at(expected_ns)
            allowed_ns = _ROUGH_NS + _DRIFT * abs(sample.sent_ns - anchor_ns)
            if source is not None and abs(sample.station_ns - source.zero_ns - expected_ns) <= allowed_ns:
                answered.append(replace(sample, station_ns=sample.station_ns - source.zero_ns))
        return answered

    def _journal_at(self, local_ns: int) -> IndexedJournal | None:
        """Return the journal that was being written at an instant on CLOCK_MONOTONIC; None if it is not available."""
        after = bisect_right([source.begin_ns - _EARLY_NS for source in self.journals], local_ns)
        if not after:
            return None
        source = self.journals[after - 1]
        stamps_ns = [measurement.stamp_ns for measurement in source.journal.measurements[-1:]]
        end_ns = max([source.journal.created_ns, *stamps_ns]) - source.zero_ns + _AFTER_NS
        return source if local_ns <= end_ns else None

    # --- Superframe -----------------------------------------------------------------------------------------------

    def _match_superframe(self, session: Session, session_number: int, match: Match) -> None:
        beacons = session.beacons[session_number]
        receptions = sorted(
            BeaconReception(reception.stamp_ns - source.zero_ns, reception.stamp_sigma_ns, beacon.stamp_ns)
            for source in self.journals
            for reception in source.journal.receptions
            if reception.session == session_number and (beacon := beacons.get(reception.counter)) is not None
        )
        if not receptions:
            return
        match.beacons_received = True
        times = times_from_beacons(receptions, self._stamps_ns)
        delivered_times = []
        for delivered in session.delivered.get(self.station, ()):
            for index in self._by_sequence.get(delivered.sequence, ()):
                time = times[index]
                if (
                    time is not None
                    and same_content(self.entries[index].measurement, delivered)
                    and times_consistent(delivered.stamp_ns, delivered.stamp_bound_ns or 0, time)
                ):
                    match.delivered.add(index)
                    delivered_times.append(
                        DeliveredTime(delivered.stamp_ns, delivered.stamp_bound_ns or 0, time)
                    )
        delay = link_delay(delivered_times)
        if delay is not None:
            match.update([None if time is None else add_link_delay(time, *delay) for time in times])

    def _match_content(self, session: Session, match: Match) -> None:
        """Match measurements by sequence number and content alone, independent of times."""
        match.same_content = {
            index
            for delivered in session.delivered.get(self.station, ())
            if delivered.host_time_ns is None
            for index in self._by_sequence.get(delivered.sequence, ())
            if same_content(self.entries[index].measurement, delivered)
        }


@dataclass(slots=True)
class Match:
    """Result of matching a boot with a session.

    Attributes
    ----------
    times : Time of each entry on the master's clock; None if unknown.
    delivered : Indices of entries that were delivered over the radio.
    same_content : Indices of entries whose content was delivered; their times may contradict that.
    clock_related : Synchronisations or beacons relate the station's clock to the master's.
    """

    times: list[MasterTime | None]
    delivered: set[int] = field(default_factory=set)
    same_content: set[int] = field(default_factory=set)
    clock_related: bool = False
    beacons_received: bool = False

    def update(self, times: Sequence[MasterTime | None]) -> None:
        """Replace times by those with smaller bounds."""
        self.clock_related = True
        self.times = [better(one, other) for one, other in zip(self.times, times, strict=True)]


def better(one: MasterTime | None, other: MasterTime | None) -> MasterTime | None:
    """Return the time with the smaller bound."""
    if one is None or other is None:
        return one or other
    return min(one, other, key=lambda time: time.bound_ns)
