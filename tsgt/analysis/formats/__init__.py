"""File formats of other programs and set-up files, read and written.

Read: samples of an IMU (CSV, ROS 2 bags), RTKLIB solutions, the authors' published tracks, polar tracks (CSV), target and prism files, odometry. Written: TUM,
CSV, MCAP with ROS 2 messages, set-up files (TOML). A file that cannot be used raises one line with path, line number, what
was expected and what was found.
"""

from tsgt.analysis.formats.export import measurement_csv, pose_csv, tum_lines, valid_records, valid_rows
from tsgt.analysis.formats.imu_files import imu_records, read_imu_files
from tsgt.analysis.formats.mcap import messages, write_mcap
from tsgt.analysis.formats.odometry import read_stationary_intervals
from tsgt.analysis.formats.polar_files import check_tracks, read_polar_tracks, tracked_prisms
from tsgt.analysis.formats.rtklib import QUALITIES, SECOND_NS, PosFile, TimeSystem, read_pos
from tsgt.analysis.formats.rts_files import PublishedTrack, read_prisms, read_tracks
from tsgt.analysis.formats.sample_runs import interval_ns
from tsgt.analysis.formats.setup_files import (
    InstrumentErrors,
    write_imu_mounting,
    write_prism_layout,
    write_sensor_mounting,
    write_station_frames,
)
from tsgt.analysis.formats.target_file import (
    PrismFile,
    TargetFile,
    TargetMeasurement,
    read_partial_target_file,
    read_prism_file,
    read_target_file,
)
from tsgt.analysis.formats.wheel_files import read_wheel_files, wheel_records

__all__ = [
    "QUALITIES",
    "SECOND_NS",
    "InstrumentErrors",
    "PosFile",
    "PrismFile",
    "PublishedTrack",
    "TargetFile",
    "TargetMeasurement",
    "TimeSystem",
    "check_tracks",
    "imu_records",
    "interval_ns",
    "measurement_csv",
    "messages",
    "pose_csv",
    "read_imu_files",
    "read_partial_target_file",
    "read_polar_tracks",
    "read_pos",
    "read_prism_file",
    "read_prisms",
    "read_stationary_intervals",
    "read_target_file",
    "read_tracks",
    "read_wheel_files",
    "tracked_prisms",
    "tum_lines",
    "valid_records",
    "valid_rows",
    "wheel_records",
    "write_imu_mounting",
    "write_mcap",
    "write_prism_layout",
    "write_sensor_mounting",
    "write_station_frames",
]
