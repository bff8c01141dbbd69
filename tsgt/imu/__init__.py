"""The robot's inertial measurement unit (IMU): the program that reads it, and the times of its samples.

In: JSON lines of a supervised program (docs/reference/imu-program.md). Out: records of raw samples with times on the
master's Unix clock, a status and events. `lines` are the lines, `sample_times` and `device_clock` find durations and times,
`sampler` makes the records, `monitor` judges them; `session` and `program` run the program. Programs for two makes:
`vectornav` and `xsens` are their codecs, `serial_program` the rest.
"""

from tsgt.imu.lines import FORMAT_VERSION, HelloLine, SamplesLine, StatusLine, decode_program_line
from tsgt.imu.program import Imu

__all__ = [
    "FORMAT_VERSION",
    "HelloLine",
    "Imu",
    "SamplesLine",
    "StatusLine",
    "decode_program_line",
]
