"""Rest as a state of the motion: intervals in which the robot stands still, and the process factors there. Sans-I/O.

:func:`find_rest` finds them in raw measurements; ``geometry.batch`` uses them for whole recordings, ``geometry.trajectory`` for
smoothed poses online. docs/explanation/continuous-trajectory.md, "Rest".
"""

from tsgt.geometry.rest.detection import MARGIN_S, Series, find_rest, find_rest_in_series
from tsgt.geometry.rest.factors import (
    RestInterval,
    add_vibration,
    in_rest,
    rest_factors,
    steps_in_rest,
    with_vibration,
)

__all__ = [
    "MARGIN_S",
    "RestInterval",
    "Series",
    "add_vibration",
    "find_rest",
    "find_rest_in_series",
    "in_rest",
    "rest_factors",
    "steps_in_rest",
    "with_vibration",
]
