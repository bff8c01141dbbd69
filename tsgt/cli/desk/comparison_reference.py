"""Reference poses for ``tsgt compare``: of a recording, or of a file of poses."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from tsgt.analysis.compare import reference_at
from tsgt.analysis.formats.trajectories import (
    is_measured,
    is_recording,
    read_reference_poses,
    reference_of_poses,
)
from tsgt.analysis.smoothing import smooth_recording
from tsgt.cli.progress import TUNING, progress
from tsgt.cli.recordings import ImuOptions, load

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.analysis.compare import ReferencePoses
    from tsgt.model import ReferencePoint


def read_reference(path: Path, point: ReferencePoint | str | None) -> ReferencePoses:
    """Read reference poses of a point; a recording with measurements is processed with the estimator ``continuous``."""
    if is_recording(path) and is_measured(path):
        loaded = load(path, keep_going=False, point=point, imu=ImuOptions())
        with progress("fitting", first=TUNING) as on_progress:
            poses = smooth_recording(loaded, path=path, refine="auto", on_progress=on_progress).poses
        return reference_of_poses(poses)
    found = read_reference_poses(path)
    if point is None:
        return found
    if isinstance(point, str):
        raise click.UsageError(f"--point: {path} does not state where {point} is; give its coordinates")
    return reference_at(found, point)
