"""The condition of stations, IMU, wheels, recording and disk that a status tells, for all who show it. Sans-I/O."""

from __future__ import annotations

from enum import Enum, auto
from typing import TYPE_CHECKING

from tsgt.recording.stream_records import LOW_DISK_BYTES

if TYPE_CHECKING:
    from tsgt.recording.stream_records import (
        DiskStatus,
        ImuStatus,
        OdometryStatus,
        RecordingStatus,
        StationStatus,
    )

MAX_AGE_S = 3.0
"""A station whose last packet or measurement is older needs the operator."""

MAX_UNASKED_S = 60.0
"""With ``classic`` the master asks no other station while it synchronises one; a radio that fails longer asks none."""

MAX_SAMPLE_AGE_S = 1.0
"""Of the newest sample of IMU or wheels."""

MAX_WRITE_AGE_S = 5.0
"""Lines that wait for longer are not written because the disk is full or fails."""

MAX_WAITING_LINES = 600
"""The master records some lines a second at least, and some sixty with poses: these are ten seconds of them."""

FULL_DISK_BYTES = 50_000_000


class StationCondition(Enum):
    """What the master receives from a station."""

    NOT_RECEIVED = auto()
    SILENT = auto()
    NO_MEASUREMENT = auto()
    UNUSABLE = auto()
    """The status of its last measurement tells why."""
    NO_NEW_MEASUREMENT = auto()
    """It responds, but always with the same measurement."""
    TRACKING = auto()


def station_condition(station: StationStatus) -> StationCondition:
    """Return the condition of a station."""
    heard_s = station.last_heard_s
    if heard_s is None:
        return StationCondition.NOT_RECEIVED
    if heard_s > MAX_AGE_S and (not station.answering or heard_s > MAX_UNASKED_S):
        return StationCondition.SILENT
    if station.status is None or station.age_s is None:
        return StationCondition.NO_MEASUREMENT
    if not station.status.usable:
        return StationCondition.UNUSABLE
    if station.age_s - heard_s > MAX_AGE_S:
        return StationCondition.NO_NEW_MEASUREMENT
    return StationCondition.TRACKING


class SensorCondition(Enum):
    """Whether samples of IMU or wheels come, and whether poses rest on them."""

    NO_SAMPLES = auto()
    SILENT = auto()
    FAULTY = auto()
    """The device or its program: the status tells the problem."""
    WRONG_SETUP = auto()
    DISAGREES = auto()
    UNCONFIRMED = auto()
    """Its set-up, until the robot has driven curves."""
    STARTING = auto()
    WITHOUT_IMU = auto()
    """Wheels are used beside an IMU alone."""
    USED = auto()

    @property
    def ok(self) -> bool:
        """Whether no action is required."""
        return self in {SensorCondition.STARTING, SensorCondition.WITHOUT_IMU, SensorCondition.USED}


def imu_condition(imu: ImuStatus) -> SensorCondition:
    """Return the condition of the IMU."""
    if (found := _sample_condition(imu)) is not None:
        return found
    match imu.use:
        case "wrong_setup":
            return SensorCondition.WRONG_SETUP
        case "unconfirmed":
            return SensorCondition.UNCONFIRMED
        case "disagrees":
            return SensorCondition.DISAGREES
    if imu.disagreement:
        return SensorCondition.DISAGREES
    return SensorCondition.STARTING if imu.use == "starting" else SensorCondition.USED


def odometry_condition(odometry: OdometryStatus) -> SensorCondition:
    """Return the condition of the wheel odometry."""
    if (found := _sample_condition(odometry)) is not None:
        return found
    match odometry.use:
        case "disagrees":
            return SensorCondition.DISAGREES
        case "without_imu":
            return SensorCondition.WITHOUT_IMU
    return SensorCondition.USED


def _sample_condition(sensor: ImuStatus | OdometryStatus) -> SensorCondition | None:
    """Return why a sensor gives no samples, or none to be trusted; None: it gives some."""
    if sensor.age_s is None:
        return SensorCondition.NO_SAMPLES
    if sensor.age_s > MAX_SAMPLE_AGE_S:
        return SensorCondition.SILENT
    return SensorCondition.FAULTY if sensor.problem else None


class RecordingCondition(Enum):
    """Whether lines reach the disk."""

    NOT_WRITTEN = auto()
    SLOW = auto()
    WRITTEN = auto()


def recording_condition(recording: RecordingStatus, now_ns: int) -> RecordingCondition:
    """Return the condition of the recording at a time on the master's Unix clock."""
    written_ns, waiting = recording.last_write_ns, recording.waiting_lines
    if waiting and written_ns is not None and now_ns - written_ns > MAX_WRITE_AGE_S * 1e9:
        return RecordingCondition.NOT_WRITTEN
    if waiting > MAX_WAITING_LINES:
        return RecordingCondition.NOT_WRITTEN if written_ns is None else RecordingCondition.SLOW
    return RecordingCondition.WRITTEN


class DiskCondition(Enum):
    """Whether there is space on the disk of the recording."""

    FULL = auto()
    NEARLY_FULL = auto()
    OK = auto()


def disk_condition(disk: DiskStatus | None) -> DiskCondition:
    """Return the condition of the disk; one that is not known is taken as good."""
    if disk is None or disk.free_bytes >= LOW_DISK_BYTES:
        return DiskCondition.OK
    return DiskCondition.FULL if disk.free_bytes < FULL_DISK_BYTES else DiskCondition.NEARLY_FULL
