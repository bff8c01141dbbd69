"""The robot's inertial measurement unit (IMU) and wheel odometry: the programs that read them, and the times of their samples.

In: JSON lines of a supervised program (docs/reference/imu-program.md). Out: records of raw samples with times on the
master's Unix clock, a status and events. `lines` are the lines, `sample_times` and `device_clock` find durations and times,
`sampler` makes the records, `monitor` judges them; `session` and `program` run the program. `odometry_lines` and `odometry` are what
differs for the wheels. Programs for two makes:
`vectornav` and `xsens` are their codecs, `serial_program` the rest.
"""

from tsgt.imu.lines import HelloLine, SamplesLine, StatusLine, decode_program_line
from tsgt.imu.odometry import WheelOdometry
from tsgt.imu.odometry_lines import OdometryHelloLine, OdometryLine, decode_odometry_line
from tsgt.imu.program import Imu

__all__ = [
    "HelloLine",
    "Imu",
    "OdometryHelloLine",
    "OdometryLine",
    "SamplesLine",
    "StatusLine",
    "WheelOdometry",
    "decode_odometry_line",
    "decode_program_line",
]
