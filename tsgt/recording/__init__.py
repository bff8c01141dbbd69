"""Recordings: JSON lines on disk in the order of arrival, with every parameter in force. What is recorded is what is streamed.

In: records and encoded lines. Out: files (`writer`, `recorder`), and their content again (`reader`, `journal`). One record
is one line is one write to the kernel, at the end of a locked file. A killed program leaves at most one torn line, which
readers skip and the next writer cuts off; only a power cut can lose more: the lines since the last sync. The format is
described in docs/reference/recording.md. Nothing exported here waits, reads a clock or logs; `recorder` does.
"""

from tsgt.recording.files import new_recording_path, sync_folder, write_atomically
from tsgt.recording.format import (
    FORMAT_VERSION,
    MAX_LINE_BYTES,
    Line,
    RecordingHeader,
    Typed,
    decode,
    decode_line,
    encode_line,
)
from tsgt.recording.imu_shocks import IMU_SHOCKS_FILE, read_imu_shocks, write_imu_shocks
from tsgt.recording.merged import MergedRecord
from tsgt.recording.reader import (
    Recording,
    load_recording,
    read_imu_samples,
    read_lines,
    read_odometry,
    replaced_line,
)
from tsgt.recording.setup_record import (
    SETUP_START,
    SetupGeofence,
    SetupPrism,
    SetupRecord,
    SetupStation,
)
from tsgt.recording.stream_records import (
    LOW_BATTERY_PERCENT,
    LOW_DISK_BYTES,
    PROTOCOL_VERSION,
    BeaconRecord,
    ClockRecord,
    DiskStatus,
    EventRecord,
    HelloRecord,
    ImuStatus,
    Kind,
    OdometryStatus,
    PoseRecord,
    RecordingStatus,
    StationShare,
    StationStatus,
    StatusRecord,
    ValidityLimits,
)
from tsgt.recording.target_checks import read_target_checks, write_target_checks
from tsgt.recording.writer import RecordingWriter

__all__ = [
    "FORMAT_VERSION",
    "IMU_SHOCKS_FILE",
    "LOW_BATTERY_PERCENT",
    "LOW_DISK_BYTES",
    "MAX_LINE_BYTES",
    "PROTOCOL_VERSION",
    "SETUP_START",
    "BeaconRecord",
    "ClockRecord",
    "DiskStatus",
    "EventRecord",
    "HelloRecord",
    "ImuStatus",
    "Kind",
    "Line",
    "MergedRecord",
    "OdometryStatus",
    "PoseRecord",
    "Recording",
    "RecordingHeader",
    "RecordingStatus",
    "RecordingWriter",
    "SetupGeofence",
    "SetupPrism",
    "SetupRecord",
    "SetupStation",
    "StationShare",
    "StationStatus",
    "StatusRecord",
    "Typed",
    "ValidityLimits",
    "decode",
    "decode_line",
    "encode_line",
    "load_recording",
    "new_recording_path",
    "read_imu_samples",
    "read_imu_shocks",
    "read_lines",
    "read_odometry",
    "read_target_checks",
    "replaced_line",
    "sync_folder",
    "write_atomically",
    "write_imu_shocks",
    "write_target_checks",
]
