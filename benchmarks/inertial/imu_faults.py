"""Missions with faults of the robot's IMU at random instants: no valid pose may be wrong.

    python benchmarks/run.py imu_faults [--seeds N] [--first SEED] [--duration SECONDS] [--stations 1 2 3]

A mission is simulated once, with faults of radio, instruments and prisms in every other one; the IMU is simulated with faults of
its own, and the live estimator runs alone, ten poses a second: less than a whole mission (the benchmark soak), which replays it
too. The IMU is industrial or consumer, the protocol superframe or classic, and the number of stations one of those given, by the
seed. A valid pose is wrong as in `tsgt simulate`: NEES above 60, and 20 mm or 0.02 rad off. Adds up missions, hours and faults by
kind.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from harness.inertial.imu_faults import Drive

from tsgt.config import ClassicMasterConfig, SuperframeMasterConfig
from tsgt.log import configure_logging
from tsgt.simulation.faults import (
    FAST_SYNC_CYCLES,
    FAULT_FREE_TAIL_S,
    IMU_FAULTS,
    FaultKind,
    draw_faults,
    imu_conditions,
)

if TYPE_CHECKING:
    from tsgt.config import ImuModelName

OTHERS = frozenset(
    map(
        FaultKind,
        ("loss", "collisions", "unplug", "stall", "line", "power", "prism-loss", "wrong-prism", "drift"),
    )
)
END_S = 5.0  # Without new faults before the end


def drive(folder: Path, seed: int, duration_s: float) -> tuple[Drive, str]:
    """Simulate the mission of a seed; return what it was."""
    model: ImuModelName = "industrial" if seed // 2 % 2 == 0 else "consumer"
    classic = seed % 3 == 2
    faults = OTHERS if seed % 2 else frozenset()
    found = Drive.simulated(
        folder,
        seed=seed,
        duration_s=duration_s + (FAULT_FREE_TAIL_S if faults else 0.0),
        imu=model,
        faults=faults,
        protocol=ClassicMasterConfig(kind="classic", initial_cycles=FAST_SYNC_CYCLES)
        if classic
        else SuperframeMasterConfig(kind="superframe"),
    )
    count = sum(found.result.faults.values())
    return found, f"{model}, {'classic' if classic else 'superframe'}, {count} other faults"


def main() -> int:
    """Run the missions."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--duration", type=float, default=120.0)
    parser.add_argument("--stations", type=int, nargs="+", default=[3, 2, 3, 1])
    arguments = parser.parse_args()
    configure_logging("critical")
    counts: Counter[str] = Counter()
    uses: Counter[str] = Counter()
    simulated_s = wrong = poses = 0.0
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        began_s = time.process_time()
        stations = arguments.stations[seed % len(arguments.stations)]
        with tempfile.TemporaryDirectory() as folder:
            mission, what = drive(Path(folder), seed, arguments.duration)
            rng = np.random.default_rng([seed, 0x1F])
            ends_s = mission.result.duration_s
            faults = draw_faults(
                IMU_FAULTS, rng, duration_s=ends_s + FAULT_FREE_TAIL_S - END_S, stations=[], imu=True
            )
            found = mission.poses(mission.samples(imu_conditions(faults)), stations=stations)
        counts.update(str(fault.kind) for fault in faults)
        counts.update(str(kind) for kind, number in mission.result.faults.items() for _ in range(number))
        uses.update(found.imu[found.predicted].tolist())
        simulated_s += ends_s
        wrong += found.wrong.sum()
        poses += found.valid.sum()
        line = f"{seed:4d} {stations} stations, {what}, {len(faults)} of the IMU: {found.valid.sum()} valid, "
        print(f"{line}{found.wrong.sum()} wrong, {time.process_time() - began_s:.0f} s", flush=True)
        for row in np.flatnonzero(found.wrong)[:3]:
            print(
                f"     wrong at {found.time_s[row]:.2f} s: {1e3 * found.position_m[row]:.1f} mm, {found.rotation_rad[row]:.4f} rad, "
                f"NEES {found.nees[row]:.0f}, IMU {found.imu[row]}, {'predicted' if found.predicted[row] else 'smoothed'}; "
                + ", ".join(f"{fault.kind} {fault.at_s:.2f}+{fault.duration_s:.2f}" for fault in faults),
                flush=True,
            )
    print(
        f"{arguments.seeds} missions, {simulated_s / 3600:.2f} h, {poses:.0f} valid poses, {wrong:.0f} wrong; predicted poses by use of "
        f"the IMU: {', '.join(f'{use} {count}' for use, count in uses.most_common())}"
    )
    print(", ".join(f"{count} {kind}" for kind, count in sorted(counts.items())))
    return 3 if wrong else 0


if __name__ == "__main__":
    main()
