"""What a simulated run leaves behind for figures and checkers: what went in, and what came out."""

from __future__ import annotations

from array import array
from collections import Counter
from dataclasses import dataclass, field, fields
from itertools import combinations
from typing import TYPE_CHECKING, get_args

import numpy as np

from tsgt.model import PolarMeasurement
from tsgt.recording import BeaconRecord, ClockRecord, Kind, PoseRecord, StatusRecord, decode_line, read_lines
from tsgt.recording.journal import AcknowledgedRecord, load_journal
from tsgt.simulation.mission.disk import UNWRITTEN_NS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.model import Parameters
    from tsgt.radio import Direction
    from tsgt.recording.journal import InstrumentRecord
    from tsgt.simulation.faults.catalogue import FaultKind
    from tsgt.simulation.instrument.geocom import Offered
    from tsgt.simulation.options import Outage
    from tsgt.simulation.world import World
    from tsgt.station import Atmosphere, ClientStatus, Condition, Instrument, Reading

START_UNIX_NS = 1_800_000_000_000_000_000
"""Unix time at which each simulated mission starts, on the master's clock: 15 January 2027."""

_HEAD_LINES = 2
# What is left of a program that is killed lives on for an instant.
_LAST_NS = 5_000_000
# Two beacons agree to within this, whatever the clock of a station did in between.
_APART_US = 20_000
# A station that is started again believes what it knew before if it rests on five beacons; some may have been outliers.
_TELL = 8

_KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True, slots=True)
class ValidPoses:
    """The valid poses of a stream, in its order.

    Attributes
    ----------
    stamp_ns
        (N,) on the master's Unix clock.
    position_m
        (N, 3) in frame ``station1``.
    orientation_xyzw
        (N, 4).
    residual_m
        (N,) as stated.
    after
        (N,) how many measurements stood in the stream before each pose.
    kind
        (N,) how each came about, in the word of the stream.
    newest_s
        (N,) age of the newest measurement before each.
    covariance
        (N, 6, 6) as stated.
    """

    stamp_ns: NDArray[np.int64]
    position_m: NDArray[np.float64]
    orientation_xyzw: NDArray[np.float64]
    residual_m: NDArray[np.float64]
    after: NDArray[np.int64]
    kind: NDArray[np.str_]
    newest_s: NDArray[np.float64]
    covariance: NDArray[np.float64]

    def select(self, rows: NDArray[np.bool_]) -> ValidPoses:
        """Return some of them."""
        return ValidPoses(*(getattr(self, field.name)[rows] for field in fields(self)))


class Session:
    """What one run of the master sent out, from its start to its end. Its method :meth:`take` is the master's observer.

    Hours of poses are kept as numbers, and what the lines were as a hash.

    Parameters
    ----------
    folder
        Where the master keeps its recording, the only file there.
    now_ns
        Tells the true time, in ns from the start of the run.
    zero_ns
        What the master's Unix clock showed at the start of the run, in ns, as it stands now: somebody may have set it.

    Attributes
    ----------
    measurements, clocks, statuses
        The records of these types.
    arrived_ns
        When each of the measurements was handed out, true time in ns from the start.
    poses
        How many poses, valid or not, by kind.
    frames, framed_ns
        How many frames there have been from the first beacon to the last, and how long they took.
    lines
        Hash of each line.
    crashed
        Whether it was killed.
    number
        Of the session in its last beacon; None: there was none.
    """

    def __init__(self, folder: Path, now_ns: Callable[[], int], zero_ns: int) -> None:
        self._folder = folder
        self._now_ns = now_ns
        self.zero_ns = zero_ns
        self.crashed = False
        self.number: int | None = None
        self.measurements: list[PolarMeasurement] = []
        self.arrived_ns: list[int] = []
        self.clocks: list[ClockRecord] = []
        self.statuses: list[StatusRecord] = []
        self.poses: Counter[Kind] = Counter()
        self.frames = 0
        self.framed_ns = 0
        self._first_beacon: BeaconRecord | None = None
        self.lines = array("q")
        self._pose_stamps = array("q")
        self._pose_after = array("q")
        self._pose_kinds = array("b")
        self._pose_numbers = array("d")

    def take(self, record: object, line: bytes) -> None:
        """Take a record that goes out, and its line."""
        self.lines.append(hash(line))
        if isinstance(record, PolarMeasurement):
            self.measurements.append(record)
            self.arrived_ns.append(self._now_ns())
        elif isinstance(record, ClockRecord):
            self.clocks.append(record)
        elif isinstance(record, StatusRecord):
            self.statuses.append(record)
        elif isinstance(record, PoseRecord):
            self.poses[record.kind] += 1
            if record.valid:
                self._take_pose(record)
        elif isinstance(record, BeaconRecord):
            first = self._first_beacon = self._first_beacon or record
            self.number = record.session
            self.frames, self.framed_ns = record.counter - first.counter, record.stamp_ns - first.stamp_ns

    def _take_pose(self, pose: PoseRecord) -> None:
        self._pose_stamps.append(pose.stamp_ns)
        self._pose_after.append(len(self.measurements))
        self._pose_numbers.extend(pose.position_m or ())
        self._pose_numbers.extend(pose.orientation_xyzw or ())
        self._pose_numbers.append(np.nan if pose.residual_m is None else pose.residual_m)
        ages_s = (share.age_s for share in pose.stations if share.age_s is not None)
        self._pose_numbers.append(min(ages_s, default=np.nan))
        self._pose_numbers.extend(pose.covariance or ())
        self._pose_kinds.append(_KINDS.index(pose.kind))

    def valid_poses(self) -> ValidPoses:
        """Return the valid poses so far."""
        numbers = np.array(self._pose_numbers).reshape(-1, 45)
        return ValidPoses(
            stamp_ns=np.array(self._pose_stamps, dtype=np.int64),
            position_m=numbers[:, :3],
            orientation_xyzw=numbers[:, 3:7],
            residual_m=numbers[:, 7],
            after=np.array(self._pose_after, dtype=np.int64),
            kind=np.array(_KINDS)[np.array(self._pose_kinds, dtype=np.intp)],
            newest_s=numbers[:, 8],
            covariance=numbers[:, 9:].reshape(-1, 6, 6),
        )

    def recording(self) -> Path | None:
        """Return the recording; None when the master did not get as far as that."""
        return next(iter(sorted(self._folder.glob("*.jsonl"))), None)


@dataclass(slots=True)
class StationWitness:
    """What a station's client read from its instrument, whether it went any further or not.

    Attributes
    ----------
    station
        Its number.
    folder
        Of its journals; None: it keeps none.
    offered
        Every distance that its instrument has answered with.
    stamps_ns
        By the host time of each reading in ns: the true time of that instant, in ns from the start.
    read_ns
        By the same: the true time at which the client had it.
    crashed_ns
        True times between which a client has read what it may not have written, as it was killed at the later one.
    statuses
        What it said of itself each time before it ended.
    """

    station: int
    folder: Path | None
    offered: Sequence[Offered] = ()
    stamps_ns: dict[int, int] = field(default_factory=dict)
    read_ns: dict[int, int] = field(default_factory=dict)
    crashed_ns: list[tuple[int, int]] = field(default_factory=list)
    statuses: list[ClientStatus] = field(default_factory=list)

    def may_be_unwritten(self, true_ns: int, before_ns: int = 0, *, refused: bool = False) -> bool:
        """Whether a client was killed after that time, in ns from the start, before it can have written what it had read.

        Parameters
        ----------
        true_ns
            When it was read, in ns from the start; or at most ``before_ns`` before that.
        refused
            Only a disk that refused to be written to is an excuse.
        """
        return any(
            from_ns - before_ns <= true_ns <= to_ns + _LAST_NS
            and not (refused and to_ns - from_ns == UNWRITTEN_NS)
            for from_ns, to_ns in self.crashed_ns
        )

    @property
    def journals(self) -> list[Path]:
        """Its journals, one for each time that it was started."""
        return [] if self.folder is None else sorted(self.folder.glob("*.jsonl"))


class Measured:
    """Finds for what the master has delivered when it was measured, and what the journals say of it.

    Over the protocol ``classic`` a measurement keeps its station's time; over ``superframe`` it is found by its number.

    Parameters
    ----------
    witness
        Of the station.

    Attributes
    ----------
    journalled
        What stands in the station's journals, in their order.
    """

    def __init__(self, witness: StationWitness) -> None:
        self.witness = witness
        self._true_ns = witness.stamps_ns
        journals = [load_journal(path) for path in witness.journals if _begun(path)]
        self.journalled = [m for journal in journals for m in journal.measurements]
        self._heads = {m.sequence: journal.head for journal in journals for m in journal.measurements}
        self._offsets_us: dict[tuple[str, int], list[int]] = {}
        for journal in journals:
            for told in journal.receptions:
                offsets_us = self._offsets_us.setdefault((journal.head.boot, told.session), [])
                offsets_us.append(told.sent_us - told.stamp_ns // 1000)
        # Their names tell the order as well as the stations' Unix clocks do.
        last = max(witness.journals, key=lambda path: path.stat().st_mtime_ns, default=None)
        self._last_journal = last if last is not None and _begun(last) else None
        self._last = load_journal(self._last_journal).head if self._last_journal is not None else None
        self._by_sequence = {m.sequence: m for m in self.journalled}
        self._by_host_time = {m.host_time_ns: m for m in self.journalled}

    def in_journal(self, measurement: PolarMeasurement) -> PolarMeasurement | None:
        """Return the measurement as the journal has it; None where it has not."""
        if measurement.host_time_ns is None:
            return self._by_sequence.get(measurement.sequence)
        return self._by_host_time.get(measurement.host_time_ns)

    def true_ns(self, measurement: PolarMeasurement) -> int | None:
        """Return the true time of the client's stamp in ns from the start; None: nobody has read it."""
        host_time_ns = measurement.host_time_ns
        if host_time_ns is None and (journalled := self.in_journal(measurement)) is not None:
            host_time_ns = journalled.host_time_ns
        return None if host_time_ns is None else self._true_ns.get(host_time_ns)

    def oldest_queued(self) -> int | None:
        """Return the lowest number that waits for an acknowledgement, as its last journal says; None: it does not say.

        A client says so every 5 s at most, if it is another one.
        """
        if (path := self._last_journal) is None:
            return None
        told = [line for line in read_lines(path) if line.type == "acknowledged"]
        return decode_line(AcknowledgedRecord, told[-1], path).oldest if told else None

    def timeless(self, sequence: int, session: int | None) -> bool:
        """Whether no time of a master's session can be told of a measurement.

        Its computer has been started again since, without having learnt the time of that session before; or its program was,
        on a disk that took nothing, and has begun to number anew.

        Parameters
        ----------
        sequence
            Number of a measurement that is in the journals.
        session
            Number of the master's session; None: of none.
        """
        head = self._heads[sequence]
        if self._last is None or head.lineage != self._last.lineage:
            return True
        if head.boot == self._last.boot:
            return False
        offsets_us = self._offsets_us.get((head.boot, session), []) if session is not None else []
        # The first ones may have been held back; of so many that is known.
        told = len(offsets_us) >= _TELL
        return not told or all(abs(b - a) > _APART_US for a, b in combinations(offsets_us, 2))


def _begun(path: Path) -> bool:
    """Whether there is more in a journal than what a client that is killed at once leaves."""
    with path.open("rb") as file:
        return [file.readline()[-1:] for _ in range(_HEAD_LINES)] == [b"\n"] * _HEAD_LINES


class WatchedInstrument:
    """An instrument that tells somebody else, too, what is read from it.

    Parameters
    ----------
    instrument
        The one that is watched.
    watch
        Gets each reading of the tracked prism.
    """

    def __init__(self, instrument: Instrument, watch: Callable[[Reading], None]) -> None:
        self._instrument = instrument
        self._watch = watch

    async def connect(self) -> str:
        """Find and identify the instrument."""
        return await self._instrument.connect()

    async def track(self, prism: int, towards: Direction | None = None) -> None:
        """Track a prism."""
        await self._instrument.track(prism, towards)

    async def read(self) -> Reading:
        """Return the next measurement, and tell."""
        reading = await self._instrument.read()
        self._watch(reading)
        return reading

    async def direct(self) -> None:
        """Get ready for single measurements."""
        await self._instrument.direct()

    async def measure(self) -> Reading:
        """Measure the target once."""
        return await self._instrument.measure()

    async def check(self) -> None:
        """See whether it is still there."""
        await self._instrument.check()

    async def set_atmosphere(self, atmosphere: Atmosphere) -> None:
        """Let the instrument correct for this air."""
        await self._instrument.set_atmosphere(atmosphere)

    @property
    def condition(self) -> Condition:
        """How it does."""
        return self._instrument.condition

    @property
    def record(self) -> InstrumentRecord | None:
        """What is known of it and of its settings."""
        return self._instrument.record

    async def close(self) -> None:
        """Let go of the instrument."""
        await self._instrument.close()


@dataclass(frozen=True, slots=True)
class Run:
    """A mission that is over.

    Attributes
    ----------
    parameters
        What the master knew of the set-up: the exact truth.
    world
        The truth; its instants count from the start of the run.
    duration_s
        How long it measured, without the drain.
    sessions
        What the master sent out, one entry for each time that it was started.
    witnesses
        What was read from the instruments, by station number.
    airtime_s
        How long there was a packet on the air, of whomever.
    superframe
        Whether that protocol was spoken.
    outages
        When who did not hear whom.
    faults
        How many of each kind there were.
    calm_s
        When they were over, in s from the start; None: there were none.
    rate_hz
        How often each instrument measures, by station number.
    overgrown
        What was longer in memory than it should be.
    start_ns
        Unix time of the start on the master's clock, in ns.
    """

    parameters: Parameters
    world: World
    duration_s: float
    sessions: list[Session]
    witnesses: dict[int, StationWitness]
    airtime_s: float
    superframe: bool
    outages: tuple[Outage, ...] = ()
    faults: Counter[FaultKind] = field(default_factory=Counter)
    calm_s: float | None = None
    rate_hz: dict[int, float] = field(default_factory=dict)
    overgrown: tuple[str, ...] = ()
    start_ns: int = START_UNIX_NS

    @property
    def end_ns(self) -> int:
        """Unix time of the end on the master's clock, in ns; the drain comes after it."""
        return self.start_ns + round(self.duration_s * 1e9)
