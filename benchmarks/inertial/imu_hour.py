"""CPU time of `tsgt process` for an hour with an IMU at 200 Hz, and the errors of its poses.

    python benchmarks/run.py imu_hour [SECONDS] [RECORDING]

A robot that is shaken as it drives through the scenario `dynamic`, measured by three stations at 2.5 Hz, with an industrial IMU:
measurements and samples alone, without radio and clocks. `tsgt process` runs as a program of its own; its CPU time (user and
system, one thread) includes reading the recording and writing 20 poses a second. RECORDING: keep it there for other uses.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from harness.files.records import START
from harness.inertial.imu_recording import imu_recording, shaken_drive, write

from tsgt.analysis.evaluation import read_tum
from tsgt.geometry import log_so3, rotation_from_quaternion

MARGIN_S = 2.0


def main() -> None:
    """Simulate, process and compare."""
    duration_s = float(sys.argv[1]) if len(sys.argv) > 1 else 3600.0
    drive = shaken_drive(duration_s)
    with tempfile.TemporaryDirectory() as name:
        path = Path(sys.argv[2]) if len(sys.argv) > 2 else Path(name, "drive.jsonl")
        write(path, imu_recording(drive))
        output = Path(name, "poses.tum")
        command = [sys.executable, "-m", "tsgt", "process", str(path), "--output", str(output)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        found = read_tum(output)
    time_s = (found.stamp_ns - START) / 1e9
    rows = (time_s > MARGIN_S) & (time_s < duration_s - MARGIN_S)
    position_m, rotation = drive.pose_at(time_s[rows])
    error_m = np.linalg.norm(found.position_m[rows] - position_m, axis=1)
    found_rotation = rotation_from_quaternion(found.orientation_xyzw[rows])
    error_rad = np.linalg.norm(log_so3(np.swapaxes(rotation, 1, 2) @ found_rotation), axis=1)
    print(
        f"{duration_s:.0f} s: {used.ru_utime + used.ru_stime:.1f} s of CPU ({used.ru_stime:.1f} s system), "
        f"{np.count_nonzero(rows)} poses, {1e3 * np.sqrt(np.mean(error_m**2)):.2f} mm and "
        f"{np.degrees(np.sqrt(np.mean(error_rad**2))):.3f} deg rms at the robot's origin"
    )


if __name__ == "__main__":
    main()
