"""What the operator's page shows: the state of the mission from the lines of the stream. Sans-I/O.

In: lines and the time. Out: views (`state`): figures of the pose, stations, histories, and a verdict on whether the poses can be
trusted (`verdict`) with what was found and what to do about it (`findings`).
"""

from tsgt.web.mission.state import MissionState

__all__ = ["MissionState"]
