"""NEES of predicted poses by the state of the robot and by the age of the newest measurement.

Replays a simulated recording through the live estimator and compares its valid predictions with the truth, from 10 s on.

    tsgt simulate dynamic --duration 400 --seed 11 --output dynamic.jsonl --truth dynamic.tum
    python benchmarks/run.py predictions dynamic.jsonl dynamic.tum
"""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import numpy as np
from measuring import normalised_squared

from tsgt.analysis.evaluation import newest_age_s, read_tum
from tsgt.geometry import log_so3, rotation_from_quaternion
from tsgt.master.replay import replayed
from tsgt.model import ROBOT_ORIGIN
from tsgt.recording import PoseRecord, decode

FROM_NS = 10_000_000_000
REST_MPS = 0.02
AGE_EDGES_S = (0.0, 0.2, 0.4, 0.6, 1.0, np.inf)
ABOVE = (22.46, 38.26)


def print_sigmas(kind: str, poses: list[PoseRecord]) -> None:
    """Print percentiles of the sigmas at the reference point, each in its least certain direction."""
    covariance = np.array([pose.covariance for pose in poses]).reshape(-1, 6, 6)
    for name, part, unit in (("mm", slice(0, 3), 1e3), ("degrees", slice(3, 6), np.degrees(1.0))):
        sigmas = unit * np.sqrt(np.linalg.eigvalsh(covariance[:, part, part])[:, -1])
        p50, p99 = np.percentile(sigmas, [50, 99])
        print(f"sigmas of {kind} poses, {name}: median {p50:.3g}, p99 {p99:.3g}, largest {sigmas.max():.3g}")


def main() -> None:
    """Print the figures of one recording."""
    recording, truth = Path(sys.argv[1]), Path(sys.argv[2])
    poses = [
        decode(PoseRecord, line)
        for _, lines in replayed(recording)
        for line in lines
        if line.startswith(b'{"type":"pose"')
    ]
    for kind in ("predicted", "smoothed"):
        print_sigmas(kind, [pose for pose in poses if pose.valid and pose.kind == kind])
    poses = [pose for pose in poses if pose.kind == "predicted"]
    valid = [pose for pose in poses if pose.valid]
    reference = read_tum(truth).of_point(ROBOT_ORIGIN)
    stamp_ns = np.array([pose.stamp_ns for pose in valid])
    true, known = reference.at(stamp_ns)
    known &= stamp_ns >= reference.stamp_ns[0] + FROM_NS
    rotation = rotation_from_quaternion(np.array([pose.orientation_xyzw for pose in valid]))
    position = np.array([pose.position_m for pose in valid])
    error = np.concatenate(
        [position - true[:, :3, 3], log_so3(rotation @ np.swapaxes(true[:, :3, :3], 1, 2))], axis=1
    )
    nees = normalised_squared(error, np.array([pose.covariance for pose in valid]).reshape(-1, 6, 6))
    later, _ = reference.at(stamp_ns + 50_000_000)
    driving = np.linalg.norm(later[:, :3, 3] - true[:, :3, 3], axis=1) > REST_MPS * 0.05
    age_s = np.array([newest_age_s(pose) for pose in valid])
    good = np.mean([pose.quality == "good" for pose in valid])
    print(f"{len(poses)} predictions, {len(valid) / len(poses):.1%} valid, {good:.1%} of them good")
    rows = {"all": known, "at rest": known & ~driving, "driving": known & driving}
    for low_s, high_s in itertools.pairwise(AGE_EDGES_S):
        rows[f"driving, {low_s:g} to {high_s:g} s"] = known & driving & (age_s >= low_s) & (age_s < high_s)
    for name, some in rows.items():
        if some.any():
            above = ", ".join(f"{1e3 * np.mean(nees[some] > limit):.2f} above {limit}" for limit in ABOVE)
            print(
                f"{name:>22}: {np.count_nonzero(some):6d}, mean NEES {nees[some].mean():.2f} (6); in 1000: {above}; "
                f"largest {nees[some].max():.0f}"
            )
