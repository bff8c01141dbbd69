"""Distances between GNSS receivers on a robot, compared with the distances between its prisms.

Comes in: RTKLIB solutions, and prism tracks of a recording of the same drive. Goes out: distances over time with quality,
on Unix time, cut to the common interval, and their error statistics.
"""

from tsgt.analysis.gnss.baselines import (
    QUALITY_ORDER,
    DistanceErrorStatistics,
    DistanceSeries,
    Receiver,
    common_interval,
    prism_distances,
    quality_shares,
    receiver_distances,
    receivers,
    time_span,
)

__all__ = [
    "QUALITY_ORDER",
    "DistanceErrorStatistics",
    "DistanceSeries",
    "Receiver",
    "common_interval",
    "prism_distances",
    "quality_shares",
    "receiver_distances",
    "receivers",
    "time_span",
]
