"""What one process of the master published in a simulated mission: for figures and invariant checks."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.model import ImuSamples, OdometrySamples, PolarMeasurement
from tsgt.recording import BeaconRecord, ClockRecord, EventRecord, PoseRecord, SetupRecord, StatusRecord

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.model import Parameters
    from tsgt.simulation.mission.observed import PollReply

_UNKNOWN = (np.nan, np.nan, np.nan)


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
    unconfirmed: NDArray[np.bool_]  # (N,) whether it rests on an IMU whose set-up is not confirmed
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
        self.measurement_lines = array("q")  # number of each measurement's line on the stream
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
        self._pose_unconfirmed = array("b")
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
            self.measurement_lines.append(len(self.line_hashes) - 1)
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
        self._pose_unconfirmed.append("imu_unconfirmed" in pose.degraded_by)
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
            unconfirmed=np.array(self._pose_unconfirmed, dtype=np.bool_),
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
