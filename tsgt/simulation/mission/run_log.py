"""Logs of a simulated mission for figures and invariant checks: what the daemons read and published, with the ground truth."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from dataclasses import dataclass, field, fields, replace
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.estimation import transform_of
from tsgt.model import ImuSamples, OdometrySamples, PolarMeasurement
from tsgt.recording import (
    BeaconRecord,
    ClockRecord,
    EventRecord,
    PoseRecord,
    SetupRecord,
    StatusRecord,
    decode_line,
    read_lines,
)
from tsgt.recording.journal import AcknowledgedRecord, load_journal
from tsgt.simulation.mission.disk import UNWRITTEN_WINDOW_NS
from tsgt.station.leica import LeicaInstrument

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.clock import Clock
    from tsgt.config import LeicaInstrumentConfig
    from tsgt.model import Matrix4, Parameters
    from tsgt.simulation.faults.catalogue import FaultKind
    from tsgt.simulation.imu import SimulatedImuRun
    from tsgt.simulation.instrument import ReportedDistance
    from tsgt.simulation.mission.poll_replies import PollReply
    from tsgt.simulation.options import Outage
    from tsgt.simulation.wheel_odometry import OdometrySamples as SimulatedOdometry
    from tsgt.simulation.world import Rollover, World
    from tsgt.station import ClientStatus, Reading
    from tsgt.station.serial import OpenPort

START_UNIX_NS = 1_800_000_000_000_000_000
"""Unix time at the start of each simulated mission, on the master's clock: 15 January 2027."""

_HEAD_LINES = 2
_UNKNOWN = (np.nan, np.nan, np.nan)
# Tasks of a killed daemon may run a little longer.
_SHUTDOWN_NS = 5_000_000
# Clock offsets from two valid beacons agree to within this.
_MAX_DISAGREEMENT_US = 20_000
# A restarted station accepts a journalled clock offset based on five beacons; some may have been outliers.
_MIN_RECEPTIONS = 8


@dataclass(frozen=True, slots=True)
class ValidPoses:
    """The valid poses of a stream, in its order."""

    stamp_ns: NDArray[np.int64]  # (N,) on the master's Unix clock
    position_m: NDArray[np.float64]  # (N, 3) in frame ``station1``
    orientation_xyzw: NDArray[np.float64]  # (N, 4)
    residual_m: NDArray[np.float64]  # (N,) as published
    measurements_before: NDArray[np.int64]  # (N,) number of measurements published before each pose
    series: NDArray[np.str_]  # (N,) name of the series, as published: kind, with the delay if there is one
    newest_age_s: NDArray[np.float64]  # (N,) age of the newest measurement
    sent_age_s: NDArray[np.float64]  # (N,) age of the pose when it was published
    with_imu: NDArray[np.bool_]  # (N,) whether it rests on the IMU
    covariance: NDArray[np.float64]  # (N, 6, 6) as published
    velocity_mps: NDArray[np.float64]  # (N, 3) as published
    angular_velocity_radps: NDArray[np.float64]  # (N, 3) as published
    station_residual_m: NDArray[np.float64]  # (N,) root mean square of the stations' residuals, as published
    good: NDArray[np.bool_]  # (N,) whether the published quality is ``good``
    station_age_s: NDArray[np.float64]  # (N, M) age of each prism's last measurement, as published; NaN: none

    def select(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> ValidPoses:
        """Return the poses of these rows."""
        return ValidPoses(*(getattr(self, field.name)[rows] for field in fields(self)))


class PublishedCounts(NamedTuple):
    """How much a master had published before a status record."""

    measurements: int
    poses: int  # smoothed ones excluded, which are the same epochs again
    valid_poses: int


class MasterLog:
    """What one process of the master published, from start to end. Poses are kept as numbers, lines as hashes.

    Parameters
    ----------
    folder
        Contains the recording and nothing else.
    now_ns
        Returns the true time in ns from the start.
    unix_at_zero_ns
        The master's Unix clock at true time zero, in ns, as set when the master started.
    parameters
        The set-up that it was started with; None: that of the whole mission.

    Attributes
    ----------
    measurements, clocks, statuses, setups, events
        Published records.
    counts_at_status
        What had been published by each status: before the poses that directly precede it, and with them.
    frame_count, frames_duration_ns
        Number of frames from the first to the last beacon, and their total duration.
    """

    def __init__(
        self,
        folder: Path,
        now_ns: Callable[[], int],
        unix_at_zero_ns: int,
        parameters: Parameters | None = None,
    ) -> None:
        self.folder = folder
        self.parameters = parameters
        self._now_ns = now_ns
        self.unix_at_zero_ns = unix_at_zero_ns
        self.crashed = False  # whether it was killed
        self.session_number: int | None = None  # session number of its last beacon
        self.measurements: list[PolarMeasurement] = []
        self.arrived_ns: list[int] = []  # True time of each measurement's publication, in ns from the start
        self.clocks: list[ClockRecord] = []
        self.statuses: list[StatusRecord] = []
        self.setups: list[SetupRecord] = []
        self.setup_hashes: set[int] = set()  # of their lines
        self.beacons_ns: dict[tuple[int, int], int] = {}  # end of transmission, by session and number
        self.imu_uses_at_status: list[str | None] = []  # of the newest predicted pose
        self.jumps_m = array("d")  # of the predicted poses that state one
        self.trackers: set[tuple[int, int]] = set()  # stations and prisms that poses name together
        self._predicted_imu: str | None = None
        self.counts_at_status: list[tuple[PublishedCounts, PublishedCounts]] = []
        self.events: list[EventRecord] = []
        self.poll_replies: list[PollReply] = []  # received over protocol classic
        self.pose_counts: Counter[str] = Counter()  # number of poses, valid or not, by series
        self.epochs_ns: dict[
            str, array[int]
        ] = {}  # epochs of all poses, valid or not, by series in their order
        self.predicted_with_imu = 0  # number of predicted poses, valid or not, that rest on the IMU
        self.frame_count = 0
        self.frames_duration_ns = 0
        self._first_beacon: BeaconRecord | None = None
        self.line_hashes = array("q")
        self.heard: list[array[int]] = []  # hashes of the lines that a reader got, by connection
        self._pose_stamps = array("q")
        self._pose_measurements_before = array("q")
        self._series: dict[str, int] = {}
        self._pose_series = array("b")
        self._pose_numbers = array("d")
        self._pose_sent_ages_s = array("d")
        self._pose_station_ages_s = array("d")
        self._counts = self._counts_before_poses = PublishedCounts(0, 0, 0)
        self._pose_with_imu = array("b")
        self._pose_good = array("b")

    def observe(self, record: object, line: bytes) -> None:
        """Log a published record and its line."""
        if isinstance(record, ImuSamples | OdometrySamples):
            return  # recorded, not on the stream
        self.line_hashes.append(hash(line))
        if isinstance(record, PoseRecord):  # most records are poses
            self._observe_epoch(record)
            return
        if isinstance(record, PolarMeasurement):
            self.measurements.append(record)
            self.arrived_ns.append(self._now_ns())
        elif isinstance(record, ClockRecord):
            self.clocks.append(record)
        elif isinstance(record, StatusRecord):
            self.statuses.append(record)
            self.counts_at_status.append((self._counts_before_poses, self._counts))
            self.imu_uses_at_status.append(self._predicted_imu)
        elif isinstance(record, SetupRecord):
            self.setups.append(record)
            self.setup_hashes.add(hash(line))
        elif isinstance(record, EventRecord):
            self.events.append(record)
        elif isinstance(record, BeaconRecord):
            first = self._first_beacon = self._first_beacon or record
            self.beacons_ns[record.session, record.counter] = record.stamp_ns
            self.session_number = record.session
            self.frame_count, self.frames_duration_ns = (
                record.counter - first.counter,
                record.stamp_ns - first.stamp_ns,
            )
        self._counts = self._counts._replace(measurements=len(self.measurements))
        self._counts_before_poses = self._counts

    def observe_reply(self, reply: PollReply, true_ns: Callable[[int], int]) -> None:
        """Log a reply over protocol classic with its true time; ``true_ns`` converts that of the master's clock."""
        self.poll_replies.append(reply._replace(received_at_ns=true_ns(reply.received_at_ns)))

    def _observe_epoch(self, pose: PoseRecord) -> None:
        self.pose_counts[pose.series] += 1
        self.epochs_ns.setdefault(pose.series, array("q")).append(pose.stamp_ns)
        if pose.kind != "smoothed":
            counts = self._counts
            self._counts = PublishedCounts(
                counts.measurements, counts.poses + 1, counts.valid_poses + pose.valid
            )
        if pose.kind == "predicted":
            self._predicted_imu = pose.imu
            if pose.jump_m is not None:
                self.jumps_m.append(pose.jump_m)
            self.predicted_with_imu += pose.imu == "used"
        if pose.valid:
            self._observe_pose(pose)

    def _observe_pose(self, pose: PoseRecord) -> None:
        self._pose_stamps.append(pose.stamp_ns)
        self._pose_measurements_before.append(len(self.measurements))
        self._pose_numbers.extend(pose.position_m or ())
        self._pose_numbers.extend(pose.orientation_xyzw or ())
        self._pose_numbers.append(np.nan if pose.residual_m is None else pose.residual_m)
        ages_s = [np.nan if share.age_s is None else share.age_s for share in pose.stations]
        self.trackers.update((share.id, share.prism) for share in pose.stations)
        self._pose_station_ages_s.extend(ages_s)
        self._pose_numbers.append(min((age_s for age_s in ages_s if age_s == age_s), default=np.nan))
        self._pose_sent_ages_s.append((self._now_ns() + self.unix_at_zero_ns - pose.stamp_ns) / 1e9)
        self._pose_numbers.extend(pose.covariance or ())
        self._pose_numbers.extend(pose.velocity_mps or _UNKNOWN)
        self._pose_numbers.extend(pose.angular_velocity_radps or _UNKNOWN)
        squares = [share.residual_m**2 for share in pose.stations if share.residual_m is not None]
        self._pose_numbers.append(math.sqrt(sum(squares) / len(squares)) if squares else np.nan)
        self._pose_good.append(pose.quality == "good")
        self._pose_with_imu.append(pose.imu == "used")
        self._pose_series.append(self._series.setdefault(pose.series, len(self._series)))

    def valid_poses(self) -> ValidPoses:
        """Return the valid poses published so far."""
        numbers = np.array(self._pose_numbers).reshape(-1, 52)
        return ValidPoses(
            stamp_ns=np.array(self._pose_stamps, dtype=np.int64),
            position_m=numbers[:, :3],
            orientation_xyzw=numbers[:, 3:7],
            residual_m=numbers[:, 7],
            measurements_before=np.array(self._pose_measurements_before, dtype=np.int64),
            series=np.array([*self._series], dtype=np.str_)[np.array(self._pose_series, dtype=np.intp)],
            newest_age_s=numbers[:, 8],
            sent_age_s=np.array(self._pose_sent_ages_s),
            with_imu=np.array(self._pose_with_imu, dtype=np.bool_),
            covariance=numbers[:, 9:45].reshape(-1, 6, 6),
            velocity_mps=numbers[:, 45:48],
            angular_velocity_radps=numbers[:, 48:51],
            station_residual_m=numbers[:, 51],
            good=np.array(self._pose_good, dtype=np.bool_),
            station_age_s=np.array(self._pose_station_ages_s).reshape(
                len(numbers), -1 if len(numbers) else 0
            ),
        )

    def recording(self) -> Path | None:
        """Return the recording; None: the master ended before it had one with a whole header."""
        return next((path for path in sorted(self.folder.glob("*.jsonl")) if _has_first_line(path)), None)


def _has_first_line(path: Path) -> bool:
    with path.open("rb") as file:
        return file.readline().endswith(b"\n")


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


class ObservedInstrument(LeicaInstrument):
    """A Leica instrument that passes each reading of the tracked prism to a callback as well."""

    def __init__(
        self,
        config: LeicaInstrumentConfig,
        open_port: OpenPort,
        clock: Clock,
        on_reading: Callable[[Reading], None],
    ) -> None:
        super().__init__(config, open_port, clock)
        self._on_reading = on_reading

    async def read(self) -> Reading:
        """Return the next measurement."""
        reading = await super().read()
        self._on_reading(reading)
        return reading


class StationMove(NamedTuple):
    """From an instant on, in s from the start, a station has another true frame."""

    station: int
    from_s: float
    T_station1_station: Matrix4


class Slew(NamedTuple):
    """NTP has changed the frequency of a station's clock for some time; times in s from the start."""

    station: int
    from_s: float
    to_s: float


@dataclass(frozen=True, slots=True)
class MissionResult:
    """A completed mission."""

    parameters: Parameters  # setup as known to the first master: the exact truth at the start
    world: World  # ground truth; times count from the start of the mission
    duration_s: float  # duration of the measurements, drain excluded
    master_logs: list[MasterLog]  # one per start of the master
    station_logs: dict[int, StationLog]
    airtime_s: float  # total airtime of all radios
    superframe: bool
    outages: tuple[Outage, ...] = ()
    faults: Counter[FaultKind] = field(default_factory=Counter)  # number of faults by kind
    slews: tuple[Slew, ...] = ()  # of the stations' clocks by NTP
    moves: tuple[StationMove, ...] = ()  # of the stations, in their order
    rollovers: tuple[Rollover, ...] = ()  # of the robot
    knocks_s: tuple[float, ...] = ()  # when the IMU was knocked, in s from the start
    faults_end_s: float | None = None  # end of the faults in s from the start; None: no faults
    rate_hz: dict[int, float] = field(default_factory=dict)  # measurement rate by station number
    oversized_collections: tuple[str, ...] = ()  # collections of the daemons that exceeded their bounds
    imu: SimulatedImuRun | None = None  # samples and truth of the robot's IMU
    odometry: SimulatedOdometry | None = None  # samples of its wheel odometry
    start_ns: int = START_UNIX_NS  # unix time of the start on the master's clock, in ns

    @property
    def end_ns(self) -> int:
        """Unix time of the end on the master's clock, in ns; the drain follows."""
        return self.start_ns + round(self.duration_s * 1e9)

    def in_force(self, master_log: MasterLog) -> MissionResult:
        """Return the mission with the parameters with which a master was started."""
        return replace(self, parameters=master_log.parameters or self.parameters)

    def true_poses(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the true poses of the reference point, (N, 4, 4), at N instants in s from the start."""
        return self.world.pose_at(times_s) @ transform_of(self.parameters.reference_point)
