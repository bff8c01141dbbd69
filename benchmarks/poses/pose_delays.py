"""Errors and NEES of live poses by the delay at which they are sent: predicted at once, smoothed at delays, and final.

Runs the live estimator over the measurements of simulated recordings and compares its valid poses with the truth, from 10 s
after the start to 5 s before the end.

    tsgt simulate dynamic --duration 300 --seed 31 --output dynamic.jsonl --truth dynamic.tum
    python benchmarks/run.py pose_delays [--no-rest] dynamic.jsonl dynamic.tum [ANOTHER.jsonl ANOTHER.tum ...]

Each is split into poses at rest, moving ones, and those of the first second after driving off. With ``--no-rest`` smoothed poses are
those of the motion prior alone.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.evaluation import LivePoseErrors, read_tum
from tsgt.estimation import LiveEstimator, centroid_at_point
from tsgt.geometry import rotation_from_quaternion, transform_from
from tsgt.geometry.trajectory import FixedLagSmoother
from tsgt.recording import PoseRecord, load_recording

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.analysis.evaluation import Reference

DELAYS_S = (0.2, 0.4, 0.6, 0.8, 1.0, 1.5, 2.0)
FROM_NS, BEFORE_NS = 10_000_000_000, 5_000_000_000
SPEED_NS, REST_MPS, AFTER_NS = 50_000_000, 0.002, 1_000_000_000


def live_poses(recording: Path) -> dict[str, list[PoseRecord]]:
    """Return the poses of the live estimator by series."""
    loaded = load_recording(recording)
    delays_ns = tuple(round(1e9 * delay_s) for delay_s in DELAYS_S)
    pipeline = replace(loaded.parameters.pipeline, smoothed_delays_ns=delays_ns)
    estimator = LiveEstimator(replace(loaded.parameters, pipeline=pipeline))
    found: defaultdict[str, list[PoseRecord]] = defaultdict(list)
    for measurement in loaded.measurements:
        for record in estimator.measurement(measurement):
            if isinstance(record, PoseRecord):
                found[record.series].append(record)
    return found


def parts(stamp_ns: NDArray[np.int64], reference: Reference) -> dict[str, NDArray[np.bool_]]:
    """Return masks of poses by the true motion at their stamps."""
    before, after = (reference.at(stamp_ns + each)[0] for each in (-SPEED_NS, SPEED_NS))
    at_rest = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1) < REST_MPS * 2e-9 * SPEED_NS
    driving_off_ns = stamp_ns[:-1][at_rest[:-1] & ~at_rest[1:]]
    since_ns = stamp_ns[:, None] - driving_off_ns
    return {
        "all": np.ones_like(at_rest),
        "at rest": at_rest,
        "moving": ~at_rest,
        "1 s after driving off": ~at_rest & ((since_ns > 0) & (since_ns <= AFTER_NS)).any(axis=1),
    }


def print_errors(recording: Path, truth: Path) -> None:
    """Print a table of one recording."""
    parameters = load_recording(recording).parameters
    reference = read_tum(truth).of_point(parameters.reference_point)
    from_ns, until_ns = int(reference.stamp_ns[0]) + FROM_NS, int(reference.stamp_ns[-1]) - BEFORE_NS
    print(recording.name)
    for series, every in sorted(live_poses(recording).items()):
        poses = [pose for pose in every if from_ns <= pose.stamp_ns <= until_ns]
        valid = [pose for pose in poses if pose.valid]
        if not valid:
            print(f"{series:>14}: none of {len(poses)} valid")
            continue
        stamp_ns = np.array([pose.stamp_ns for pose in valid])
        rotation = rotation_from_quaternion(np.array([pose.orientation_xyzw for pose in valid]))
        errors = LivePoseErrors.of(
            transform_from(rotation, np.array([pose.position_m for pose in valid])),
            np.array([pose.covariance for pose in valid]).reshape(-1, 6, 6),
            np.zeros(len(valid)),
            reference.at(stamp_ns)[0],
            centroid_at_point(parameters),
        )
        print(f"{series}: {len(valid) / len(poses):.1%} valid")
        for part, rows in parts(stamp_ns, reference).items():
            if not rows.any():
                continue
            some = errors.select(rows)
            found = some.statistics(None, None)
            print(
                f"{part:>22}: {len(some.nees):5}, origin {found.position_rms_mm:5.2f} mm rms "
                f"(p95 {found.position_p95_mm:5.2f}), centroid {found.centroid.position_rms_mm:5.2f} mm, "
                f"{found.orientation_rms_deg:.3f} deg, NEES {found.nees.mean:.2f} (6), above 22.5 in 1000: "
                f"{1e3 * np.mean(some.nees > 22.46):.2f}, largest {some.nees.max():.0f}"
            )


def main() -> None:
    """Print the tables of all recordings."""
    if "--no-rest" in sys.argv:
        FixedLagSmoother.smoothed_trajectory = FixedLagSmoother.trajectory  # type: ignore[method-assign]
    files = [each for each in sys.argv[1:] if each != "--no-rest"]
    for recording, truth in zip(files[::2], files[1::2], strict=True):
        print_errors(Path(recording), Path(truth))


if __name__ == "__main__":
    main()
