"""A pose out of the transforms of ``/tf``: of one frame in another, along the tree."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from tsgt.analysis.formats.trajectories.raw import RawTrajectory, ordered
from tsgt.errors import InputFileError
from tsgt.geometry import (
    invert,
    quaternion_from_rotation,
    rotation_from_quaternion,
    transform_from,
)

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray

    Edges = Mapping[tuple[str, str], RawTrajectory]
    """Transforms by parent and child frame, in the order of recording; of one message at least."""

_DIGITS = 9  # Decimal places of a static transform, in m and of its matrix, below which it is the same


def pose_in_tree(edges: Edges, static: Edges, parent: str, child: str, path: Path) -> RawTrajectory:
    """Return ``T_parent_child`` at the times of the most frequent transform between them; the others are interpolated.

    Of a static transform the last value holds throughout, with a note if there are others.

    Where one of the others has no value before or after, there is no pose, as in tf2. Raises InputFileError if the frames
    are not connected, or nothing between them moves.
    """
    chain = _chain([*edges, *static], parent, child)
    if chain is None:
        pairs = ", ".join(f"{a}.{b}" for a, b in sorted({*edges, *static}))
        raise InputFileError(f"has no transforms between {parent} and {child}; there are {pairs}", path=path)
    moving = {pair: ordered(edges[pair], path) for pair, _ in chain if pair in edges}
    if not moving:
        raise InputFileError(f"has only static transforms between {parent} and {child}", path=path)
    if len(chain) == 1 and not chain[0][1]:
        return edges[chain[0][0]]
    main = max(moving, key=lambda pair: len(moving[pair].stamp_ns))
    stamp_ns = moving[main].stamp_ns
    known = np.ones(len(stamp_ns), dtype=np.bool_)
    notes: tuple[str, ...] = ()
    T = np.broadcast_to(np.eye(4), (len(stamp_ns), 4, 4))
    for pair, inverted in chain:
        if pair in moving:
            step, inside = _at(moving[pair], stamp_ns)
            known &= inside
        else:
            # A publisher that was restarted latches again; tf2 replaces the transform, whatever its stamp.
            fixed = _matrices(static[pair])
            step = fixed[-1:]
            different = len(np.unique(fixed.round(_DIGITS), axis=0))
            if different > 1:
                notes += (
                    f"{different} different static transforms from {pair[0]} to {pair[1]}; the last one is used, as in tf2",
                )
        T = T @ (invert(step) if inverted else step)
    raw = RawTrajectory(
        stamp_ns=stamp_ns,
        position_m=T[:, :3, 3],
        orientation_xyzw=quaternion_from_rotation(T[:, :3, :3]),
        notes=(*moving[main].notes, *notes),
    )
    if known.all():
        return raw
    left_out = int((~known).sum())
    return raw.select(known, f"{left_out} poses left out, at which not all transforms of the chain are known")


def _chain(
    pairs: list[tuple[str, str]], parent: str, child: str
) -> list[tuple[tuple[str, str], bool]] | None:
    """Return the shortest way through the tree: pairs, and whether each is inverted; None if there is none."""
    ways: dict[str, list[tuple[tuple[str, str], bool]]] = {parent: []}
    waiting = deque([parent])
    while waiting:
        frame = waiting.popleft()
        for a, b in pairs:
            for here, there, inverted in ((a, b, False), (b, a, True)):
                if here == frame and there not in ways:
                    ways[there] = [*ways[frame], ((a, b), inverted)]
                    waiting.append(there)
    return ways.get(child) if child != parent else None


def _matrices(raw: RawTrajectory) -> FloatArray:
    assert raw.orientation_xyzw is not None  # noqa: S101 (transforms have one)
    return transform_from(rotation_from_quaternion(raw.orientation_xyzw), raw.position_m)


def _at(raw: RawTrajectory, stamp_ns: NDArray[np.int64]) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return transforms interpolated at some times, (M, 4, 4), and whether each is inside, (M,)."""
    assert raw.orientation_xyzw is not None  # noqa: S101 (transforms have one)
    inside = (stamp_ns >= raw.stamp_ns[0]) & (stamp_ns <= raw.stamp_ns[-1])
    start_ns = raw.stamp_ns[0]
    own_s = (raw.stamp_ns - start_ns) / 1e9
    wanted_s = np.clip((stamp_ns - start_ns) / 1e9, 0.0, own_s[-1])
    rotation = Slerp(own_s, Rotation.from_quat(raw.orientation_xyzw))(wanted_s).as_matrix()
    position = np.column_stack([np.interp(wanted_s, own_s, axis) for axis in raw.position_m.T])
    return transform_from(rotation, position), inside
