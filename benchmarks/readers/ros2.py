"""Time from the stream's socket to the callback of a ROS 2 subscriber: poses at 20 Hz through the node in real time.

    python benchmarks/run.py ros2 [--minutes 10]

`make ros2` installs what it needs. Each pose that is not stale must arrive once and with every digit.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from harness.readers.ros2 import DISTRIBUTIONS, RosSystem, drive, environment

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure each installed distribution; return 1 if a pose was lost, repeated or changed, or none is installed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=10.0, help="of poses, per distribution")
    options = parser.parse_args(arguments)
    good = True
    for distribution in DISTRIBUTIONS:
        folder = environment(distribution)
        if folder is None:
            sys.stdout.write(f"{distribution}: not installed, run `make ros2`\n")
            good = False
            continue
        with tempfile.TemporaryDirectory() as scratch, RosSystem(folder, Path(scratch)) as system:
            poses, sent = drive(system, options.minutes * 60)
            time.sleep(2.0)
            found = system.messages("/tsgt/pose")
            stale = system.stale_poses()
        arrived = {
            each.message["header"]["stamp"]["nanosec"]
            + 1_000_000_000 * each.message["header"]["stamp"]["sec"]: each
            for each in found
        }
        ages_ms = [
            (arrived[pose.stamp_ns].at_ns - at) / 1e6
            for pose, at in zip(poses, sent, strict=True)
            if pose.stamp_ns in arrived
        ]
        equal = all(
            list(arrived[pose.stamp_ns].message["pose"]["pose"]["position"].values())
            == list(pose.position_m or ())
            for pose in poses
            if pose.stamp_ns in arrived
        )
        complete = len(ages_ms) == len(found) == len(poses) - stale
        p50, p99, largest = np.percentile(ages_ms, [50, 99, 100])
        sys.stdout.write(
            f"{distribution}: {len(poses)} poses, {stale} too old when they came, {len(found)} received, "
            f"{'equal' if equal else 'DIFFERENT'}; "
            f"{p50:.2f} ms (median), {p99:.2f} ms (p99), {largest:.1f} ms (largest)\n"
        )
        sys.stdout.flush()
        good &= complete and equal
    return int(not good)


if __name__ == "__main__":
    sys.exit(main())
