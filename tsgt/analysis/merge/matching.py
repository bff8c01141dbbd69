"""The journals of one start of a station's computer, against one run of the master: what is in both, and when. Pure."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import defaultdict
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

from tsgt.analysis.merge.recording_index import identity
from tsgt.analysis.merge.timing import (
    Pair,
    Told,
    add_link_delay,
    link_constant,
    times_consistent,
    times_from_beacons,
    times_from_synchronisations,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from tsgt.analysis.merge.recording_index import Session
    from tsgt.analysis.merge.timing import MasterTime
    from tsgt.model import ClockSample, PolarMeasurement
    from tsgt.recording.journal import Journal

_ROUGH_NS = 5_000_000_000
"""A delivered measurement tells the station's clock to this, whatever its stamp is worth, unless it is far away."""

_EARLY_NS = 1_000_000_000
"""What answers so short before a run began, by that clock, may be this run."""

_DRIFT = 200e-6
"""No two computers' clocks run apart faster."""

_AFTER_NS = 10_000_000_000
"""A synchronisation so long after a journal's last line is still of this run, if no other has begun."""

# Half a unit on the air, and what is lost in the sums on either side; a distance from 1677.7 m on goes in whole mm.
_ANGLE_ROUNDING_RAD = math.tau / 2**25 * 1.001
_DISTANCE_ROUNDING_M = 0.501e-3


class Run(NamedTuple):
    """A journal: one run of the client.

    Attributes
    ----------
    number
        Which of the journals.
    journal
        What it holds.
    """

    number: int
    journal: Journal

    @property
    def zero_ns(self) -> int:
        """What its times are ahead of CLOCK_MONOTONIC of the station's computer."""
        return self.journal.head.unix_at_zero_ns

    @property
    def begin_ns(self) -> int:
        """When it was begun, on CLOCK_MONOTONIC."""
        return self.journal.created_ns - self.zero_ns


class Entry(NamedTuple):
    """A measurement of a journal.

    Attributes
    ----------
    local_ns
        When it was made, on CLOCK_MONOTONIC of the station's computer.
    run
        Whose it is.
    measurement
        As the journal has it.
    """

    local_ns: int
    run: Run
    measurement: PolarMeasurement


class Boot:
    """What the journals of one start of a computer hold together.

    Parameters
    ----------
    runs
        Of one station, on one CLOCK_MONOTONIC.

    Attributes
    ----------
    runs
        In the order in which they began.
    entries
        All measurements, in the order of time.
    """

    def __init__(self, runs: Iterable[Run]) -> None:
        self.runs = sorted(runs, key=lambda run: run.begin_ns)
        self.entries = sorted(
            (
                Entry(measurement.stamp_ns - run.zero_ns, run, measurement)
                for run in self.runs
                for measurement in run.journal.measurements
            ),
            key=lambda entry: (entry.local_ns, entry.run.number),
        )
        self._stamps_ns = [entry.local_ns for entry in self.entries]
        self._by_identity: dict[object, list[int]] = defaultdict(list)  # several in copies of a journal
        self._by_sequence: dict[int, list[int]] = defaultdict(list)
        for place, entry in enumerate(self.entries):
            if entry.run.journal.head.lineage is None:  # over superframe the station's own time is not sent
                self._by_identity[identity(entry.measurement)].append(place)
            self._by_sequence[entry.measurement.sequence].append(place)

    def against(self, session: Session) -> Found:
        """Compare with a run of the master."""
        found = Found([None] * len(self.entries))
        self._find_alike(session, found)
        self._over_classic(session, found)
        for beacons in session.beacons:
            self._over_superframe(session, beacons, found)
        return found

    @property
    def station(self) -> int:
        """Number of the station."""
        return self.runs[0].journal.station

    @property
    def superframe(self) -> bool:
        """Whether any of the runs spoke this protocol."""
        return any(run.journal.head.lineage is not None for run in self.runs)

    # --- Classic --------------------------------------------------------------------------------------------------

    def _over_classic(self, session: Session, found: Found) -> None:
        anchors = []
        for delivered in session.delivered.get(self.station, ()):
            key = identity(delivered)
            places = [] if key is None else self._by_identity.get(key, [])
            found.delivered.update(places)
            for place in places[:1]:
                # A stamp without a bound is worth nothing; the measurement came within seconds then.
                at_ns = delivered.received_ns if delivered.stamp_bound_ns is None else delivered.stamp_ns
                anchors.append((at_ns, self._stamps_ns[place] - at_ns))
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
            found.take(times_from_synchronisations(synchronisations, self._stamps_ns))

    def _of_this_boot(
        self, samples: Sequence[ClockSample], anchors: Sequence[tuple[int, int]]
    ) -> list[ClockSample]:
        """Return those exchanges that this boot has answered, with the station's time on CLOCK_MONOTONIC."""
        answered = []
        for sample in samples:
            after = bisect_left(anchors, (sample.sent_ns, 0))
            near_ns, ahead_ns = min(
                anchors[max(after - 1, 0) : after + 1], key=lambda anchor: abs(anchor[0] - sample.sent_ns)
            )
            about_ns = sample.sent_ns + ahead_ns
            run = self._run_at(about_ns)
            allowed_ns = _ROUGH_NS + _DRIFT * abs(sample.sent_ns - near_ns)
            if run is not None and abs(sample.station_ns - run.zero_ns - about_ns) <= allowed_ns:
                answered.append(replace(sample, station_ns=sample.station_ns - run.zero_ns))
        return answered

    def _run_at(self, local_ns: int) -> Run | None:
        """Return which run answered at an instant on CLOCK_MONOTONIC; None where its journal is not here."""
        after = bisect_right([run.begin_ns - _EARLY_NS for run in self.runs], local_ns)
        if not after:
            return None
        run = self.runs[after - 1]
        stamps_ns = [measurement.stamp_ns for measurement in run.journal.measurements[-1:]]
        end_ns = max([run.journal.created_ns, *stamps_ns]) - run.zero_ns + _AFTER_NS
        return run if local_ns <= end_ns else None

    # --- Superframe -----------------------------------------------------------------------------------------------

    def _over_superframe(self, session: Session, on_air: int, found: Found) -> None:
        beacons = session.beacons[on_air]
        pairs = sorted(
            Pair(reception.stamp_ns - run.zero_ns, reception.stamp_sigma_ns, beacon.stamp_ns)
            for run in self.runs
            for reception in run.journal.receptions
            if reception.session == on_air and (beacon := beacons.get(reception.counter)) is not None
        )
        if not pairs:
            return
        found.heard = True
        times = times_from_beacons(pairs, self._stamps_ns)
        told = []
        for delivered in session.delivered.get(self.station, ()):
            for place in self._by_sequence.get(delivered.sequence, ()):
                time = times[place]
                if (
                    time is not None
                    and same_content(self.entries[place].measurement, delivered)
                    and times_consistent(delivered.stamp_ns, delivered.stamp_bound_ns or 0, time)
                ):
                    found.delivered.add(place)
                    told.append(Told(delivered.stamp_ns, delivered.stamp_bound_ns or 0, time))
        way = link_constant(told)
        if way is not None:
            found.take([None if time is None else add_link_delay(time, *way) for time in times])

    def _find_alike(self, session: Session, found: Found) -> None:
        """Find what is in both by number and content alone, for want of times."""
        found.alike = {
            place
            for delivered in session.delivered.get(self.station, ())
            if delivered.host_time_ns is None
            for place in self._by_sequence.get(delivered.sequence, ())
            if same_content(self.entries[place].measurement, delivered)
        }


@dataclass(slots=True)
class Found:
    """What a comparison has found.

    Attributes
    ----------
    times
        When each of the entries was made, on the master's clock; None where nobody can say.
    delivered
        Indices of those that came over the radio.
    alike
        Indices of those that came by what they look like; their times may say otherwise.
    tied
        Synchronisations or beacons tie the station's clock to the master's.
    heard
        The station has heard beacons of this run.
    """

    times: list[MasterTime | None]
    delivered: set[int] = field(default_factory=set)
    alike: set[int] = field(default_factory=set)
    tied: bool = False
    heard: bool = False

    def take(self, times: Sequence[MasterTime | None]) -> None:
        """Take times where they are better than those that there are."""
        self.tied = True
        self.times = [better(one, other) for one, other in zip(self.times, times, strict=True)]


def better(one: MasterTime | None, other: MasterTime | None) -> MasterTime | None:
    """Return the time with the smaller bound."""
    if one is None or other is None:
        return one or other
    return min(one, other, key=lambda time: time.bound_ns)


def same_content(journalled: PolarMeasurement, delivered: PolarMeasurement) -> bool:
    """Whether a measurement has come as it stands in the journal, but for what the protocol superframe rounds."""
    if (journalled.status, journalled.prism) != (delivered.status, delivered.prism):
        return False
    turned_rad = (
        journalled.horizontal_angle_rad - delivered.horizontal_angle_rad,
        journalled.zenith_angle_rad - delivered.zenith_angle_rad,
    )
    if any(abs(math.remainder(turn, math.tau)) > _ANGLE_ROUNDING_RAD for turn in turned_rad):
        return False
    here_m, there_m = journalled.slope_distance_m, delivered.slope_distance_m
    if here_m is None or there_m is None:
        return here_m is there_m
    return abs(here_m - there_m) <= _DISTANCE_ROUNDING_M
