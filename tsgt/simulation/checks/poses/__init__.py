"""Checks of streamed poses.

In: a :class:`MissionResult` and the log of one master. Out: descriptions of violations. Against the truth: `consistency` (each pose),
`covariance_scale`, `lateness`, `twists` (many); against the measurements: `ages`, `expected`; against the documentation: `rules`. Where
stations have moved, `apparent` gives the poses that they show, and `layout_events` expects the layout monitor to say so; `knocks` knows what a
knock of the IMU adds where nothing tells it.
"""

from tsgt.simulation.checks.poses.ages import age_failures
from tsgt.simulation.checks.poses.apparent import apparent_poses
from tsgt.simulation.checks.poses.consistency import pose_failures
from tsgt.simulation.checks.poses.covariance_scale import scale_failures
from tsgt.simulation.checks.poses.expected import missing_poses
from tsgt.simulation.checks.poses.lateness import lateness_failures
from tsgt.simulation.checks.poses.layout_events import layout_failures
from tsgt.simulation.checks.poses.rules import rule_failures
from tsgt.simulation.checks.poses.twists import twist_failures

__all__ = [
    "age_failures",
    "apparent_poses",
    "lateness_failures",
    "layout_failures",
    "missing_poses",
    "pose_failures",
    "rule_failures",
    "scale_failures",
    "twist_failures",
]
