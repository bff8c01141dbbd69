"""Trajectories of other programs (TUM, KITTI, EuRoC, CSV, ROS bags) as estimates, and reference poses from files.

Comes in: files. Goes out: estimates and reference poses of :mod:`tsgt.analysis.compare`, with a note for each repair. A file
that cannot be used raises one line.
"""

from tsgt.analysis.formats.trajectories.estimates import read_estimates
from tsgt.analysis.formats.trajectories.reference_files import (
    is_measured,
    is_recording,
    read_reference_poses,
    reference_of_poses,
)

__all__ = [
    "is_measured",
    "is_recording",
    "read_estimates",
    "read_reference_poses",
    "reference_of_poses",
]
