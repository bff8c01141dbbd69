"""Whether valid poses are where the robot was, as well as they say, and rest on what was measured."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation import build_tracks, usable
from tsgt.geometry import log_so3, rotation_from_quaternion

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from tsgt.estimation import Track
    from tsgt.model import Parameters
    from tsgt.simulation.mission import Run, Session, ValidPoses

# More than any station's latency, which is taken off the stamps.
_LATENCY_NS = 5_000_000_000
_RESIDUAL_TOLERANCE_M = 1e-6
# Squared error of a pose in its sigmas, six degrees of freedom. A robot that does what its motion prior thinks unlikely is
# now and then off by more than honest sigmas would allow in a lifetime: in them, 60 has a chance of 5e-11.
_MOST_NEES = 60.0
# In m and rad. Times of an instrument's first seconds, and those of the authors' nodes, are off by milliseconds that no
# sigma states; of a moving robot that is millimetres.
_STATE_TOLERANCE = 0.02
# Of so many poses (half a minute) half have a squared error below this. What is honest has half of them below 5.3.
_FEWEST_POSES = 600
_MIDDLE_NEES = 12.0
# In m and rad: what they are off by in the middle of all, but for those that guess what comes; noise leaves a fifth of it.
_MIDDLE_ERROR = 0.005


def doubtful_poses(session: Session, run: Run) -> Iterator[str]:
    """Look at all valid poses of a session; yield what is wrong with them, one line each."""
    yield from wrong_poses(session, run.parameters)
    yield from wrong_states(session, run)
    yield from too_sure(session, run)


def wrong_poses(session: Session, parameters: Parameters) -> Iterator[str]:
    """Fit the prisms of each valid pose of the estimator ``linear`` again, from usable measurements alone."""
    poses = session.valid_poses()
    poses = poses.select(poses.kind == "interpolated")
    tracks = build_tracks(parameters, [m for m in session.measurements if usable(m)])
    missed = np.flatnonzero(~_explained(poses, slice(None), tracks, parameters))
    stamps_ns = np.array([m.stamp_ns for m in session.measurements], dtype=np.int64)
    around_ns = parameters.pipeline.outage_limit_ns + _LATENCY_NS
    for index in missed.tolist():
        # Later measurements may have come between those that the pose was made from: look at the past alone.
        before = stamps_ns[: poses.after[index]]
        near = np.flatnonzero(np.abs(before - poses.stamp_ns[index]) <= around_ns).tolist()
        tracks = build_tracks(parameters, [m for i in near if usable(m := session.measurements[i])])
        if not _explained(poses, [index], tracks, parameters)[0]:
            yield (
                f"the pose at {poses.stamp_ns[index]} ns is called valid, but no usable measurements explain it"
            )


def wrong_states(session: Session, run: Run) -> Iterator[str]:
    """Compare each valid pose of the estimator ``continuous`` with the truth and with the uncertainty that it states."""
    poses = session.valid_poses()
    poses = poses.select(poses.kind != "interpolated")
    errors, nees = _errors(poses, session, run)
    off = np.linalg.norm(errors.reshape(-1, 2, 3), axis=2)
    for index in np.flatnonzero((nees > _MOST_NEES) & (off.max(axis=1) > _STATE_TOLERANCE)).tolist():
        yield (
            f"the {poses.kind[index]} pose at {poses.stamp_ns[index]} ns is called valid and off by "
            f"{off[index, 0]:.4f} m and {off[index, 1]:.4f} rad; its squared error in sigmas is {nees[index]:.0f}"
        )


def too_sure(session: Session, run: Run) -> Iterator[str]:
    """Compare all valid poses of a kind with the truth, and with what they state.

    What chance excuses in a single pose it does not in half of them; and what noise leaves in the middle of half a minute,
    with a robot that turns this way and that, is a wrong set-up. The authors' nodes, which keep no journals, stamp what they
    read when it comes: their poses are late, and no sigma says so.
    """
    if any(witness.folder is None for witness in run.witnesses.values()):
        return
    every = session.valid_poses()
    for kind in ("interpolated", "predicted", "smoothed"):
        poses = every.select(every.kind == kind)
        if len(poses.stamp_ns) < _FEWEST_POSES:
            continue
        errors, nees = _errors(poses, session, run)
        middle = np.median(nees)
        beside_m, beside_rad = np.linalg.norm(np.median(errors, axis=0).reshape(2, 3), axis=1)
        if kind != "predicted" and max(beside_m, beside_rad) > _MIDDLE_ERROR:
            yield (
                f"the {len(nees)} {kind} poses are {beside_m:.4f} m and {beside_rad:.4f} rad beside the truth in the middle"
            )
        if middle > _MIDDLE_NEES:
            yield (
                f"half of {len(nees)} {kind} poses have a squared error in sigmas above {middle:.1f}: they "
                "are not where they should be, or state too little uncertainty"
            )


def _errors(poses: ValidPoses, session: Session, run: Run) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(N, 6) errors in place and rotation in m and rad, and (N,) their squares in the sigmas that the poses state."""
    truth = run.world.pose_at((poses.stamp_ns - session.zero_ns) / 1e9)
    turned = rotation_from_quaternion(poses.orientation_xyzw) @ np.swapaxes(truth[:, :3, :3], 1, 2)
    errors = np.concatenate([poses.position_m - truth[:, :3, 3], log_so3(turned)], axis=1)
    return errors, np.einsum("ni,ni->n", errors, np.linalg.solve(poses.covariance, errors[..., None])[..., 0])


def _explained(
    poses: ValidPoses,
    rows: slice | list[int],
    tracks: dict[int, Track],
    parameters: Parameters,
) -> NDArray[np.bool_]:
    """Tell, for the given poses, whether the prisms lie where measurements put them, to the residual stated."""
    stamps = poses.stamp_ns[rows]
    rotation = rotation_from_quaternion(poses.orientation_xyzw[rows])
    explained = np.ones(len(stamps), dtype=np.bool_)
    squares = np.zeros(len(stamps))
    for prism in parameters.prisms:
        track = tracks[prism.prism]
        if len(track) == 0:
            return np.zeros(len(stamps), dtype=np.bool_)
        after = np.searchsorted(track.times_ns, stamps).clip(1, max(1, len(track) - 1))
        before = after - 1
        after = np.minimum(after, len(track) - 1)
        from_ns, to_ns = track.times_ns[before], track.times_ns[after]
        explained &= (from_ns <= stamps) & (stamps <= to_ns)
        explained &= to_ns - from_ns <= parameters.pipeline.outage_limit_ns
        fraction = (stamps - from_ns) / np.maximum(to_ns - from_ns, 1)
        seen = track.points_m[before] + fraction[:, None] * (track.points_m[after] - track.points_m[before])
        placed = poses.position_m[rows] + rotation @ np.array(prism.position_m)
        squares += np.sum((placed - seen) ** 2, axis=1)
    residual_m = np.sqrt(squares / len(parameters.prisms))
    explained &= np.abs(residual_m - poses.residual_m[rows]) <= _RESIDUAL_TOLERANCE_M
    return explained
