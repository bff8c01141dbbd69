"""The poses that a recording has as streamed, against a reference, else against the post-processed trajectory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tsgt.analysis.evaluation.live_poses import LivePoseErrors, LivePoses
from tsgt.analysis.evaluation.metrics import interior_mask
from tsgt.analysis.evaluation.reference import Reference
from tsgt.analysis.evaluation.streamed_poses import read_streamed_poses
from tsgt.estimation import centroid_at_point, sigma_limits_of
from tsgt.geometry import rotation_from_quaternion, transform_from

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.analysis.evaluation.streamed_poses import StreamedPoses
    from tsgt.estimation import PoseBatch
    from tsgt.model import Parameters
    from tsgt.recording import Recording


@dataclass(frozen=True, slots=True)
class LiveComparison:
    """The poses of a stream by series; ``against``: ``reference`` or ``post_processed``."""

    against: str
    series: dict[str, LivePoses]

    def keys(self) -> dict[str, Any]:
        """Return the figures for ``--json``."""
        return {"against": self.against, **{name: each.keys() for name, each in self.series.items()}}


def compare_live(
    loaded: Recording,
    path: Path,
    post_processed: PoseBatch,
    reference: Reference | None,
    *,
    keep_going: bool = False,
) -> LiveComparison | None:
    """Compare the poses that a recording has as streamed; None without any, or with nothing to compare them with."""
    parameters = loaded.parameters
    streamed = read_streamed_poses(path, parameters.reference_point, keep_going=keep_going)
    true = _as_reference(post_processed) if reference is None else reference
    if not streamed or true is None:
        return None
    true = true.of_point(parameters.reference_point)
    return LiveComparison(
        "post_processed" if reference is None else "reference",
        {name: _compare(poses, name, true, parameters) for name, poses in streamed.items()},
    )


def _compare(poses: StreamedPoses, series: str, true: Reference, parameters: Parameters) -> LivePoses:
    inner = interior_mask(poses.stamp_ns, int(true.stamp_ns[0]), int(true.stamp_ns[-1]))
    transforms, known = true.at(poses.stamp_ns)
    rows = inner & known
    estimated = transform_from(rotation_from_quaternion(poses.orientation_xyzw[rows]), poses.position_m[rows])
    errors = LivePoseErrors.of(
        estimated, poses.covariance[rows], poses.age_s[rows], transforms[rows], centroid_at_point(parameters)
    )
    limits = sigma_limits_of(series, parameters.pipeline)
    return LivePoses(poses.poses, len(poses.stamp_ns), poses.age_s, errors.statistics(*limits))


def _as_reference(poses: PoseBatch) -> Reference | None:
    valid = poses.valid
    if valid.sum() < 2:
        return None
    return Reference(
        poses.stamp_ns[valid], poses.position_m[valid], poses.orientation_xyzw[valid], poses.reference_point
    )
