"""Trajectories of other programs (TUM, KITTI, EuRoC, CSV, ROS bags) as estimates, and reference poses from files.

Comes in: files. Goes out: estimates and reference poses of :mod:`tsgt.analysis.compare`, with a note for each repair. A file
that cannot be used raises one line.
"""

from tsgt.analysis.formats.trajectories.columns import TextFormat
from tsgt.analysis.formats.trajectories.estimates import read_estimates

__all__ = ["TextFormat", "read_estimates"]
