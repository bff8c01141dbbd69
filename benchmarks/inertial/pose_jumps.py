"""By how much new measurements move predicted poses with an IMU, in mm, degrees and sigmas that the pose before stated.

    python benchmarks/run.py pose_jumps [--imu industrial|consumer] [--seed 6] [--duration 32] [--stations 3 1]

Of poses that rest on the IMU, before and after, from ten seconds on, 20 a second; the set-up of the IMU is taken as confirmed.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from harness.inertial.imu_faults import Drive, confirm_once

from tsgt.estimation.inertial import setup_monitor as imu_setup_monitor
from tsgt.log import configure_logging

START_S = 10.0
PERIOD_NS = 50_000_000


def main() -> None:
    """Print the quantiles."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--imu", choices=["industrial", "consumer"], default="industrial")
    parser.add_argument("--seed", type=int, default=6)
    parser.add_argument("--duration", type=float, default=32.0)
    parser.add_argument("--stations", type=int, nargs="+", default=[3, 1])
    arguments = parser.parse_args()
    configure_logging("critical")
    imu_setup_monitor.FIRST_NS, imu_setup_monitor.RESULT_NS = 3_000_000_000, 0
    with tempfile.TemporaryDirectory() as folder:
        drive = Drive.simulated(
            Path(folder), seed=arguments.seed, duration_s=arguments.duration, imu=arguments.imu
        )
    samples = drive.samples()
    for stations in arguments.stations:
        found = drive.poses(samples, stations=stations, start_check=confirm_once(), period_ns=PERIOD_NS)
        found = found.select(found.predicted & (found.time_s > START_S))
        good = found.valid & (found.imu == "used")
        rows = np.flatnonzero(good[1:] & good[:-1] & np.isfinite(found.jumps[1:, 0])) + 1
        share = found.jumps[rows] / found.sigmas[rows - 1]
        print(f"{stations} stations, {len(rows)} jumps: median, 99 % and largest")
        jumps = found.jumps[rows] * (1e3, 180 / np.pi)
        for name, values in zip(
            ("mm", "deg", "sigmas", "sigmas of rotation"), (*jumps.T, *share.T), strict=True
        ):
            print(f"  {np.median(values):.3g}, {np.quantile(values, 0.99):.3g}, {values.max():.3g} {name}")


if __name__ == "__main__":
    main()
