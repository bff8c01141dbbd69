"""TODO face."""

from tsgt.analysis.gnss.baselines import (
    QUALITY_ORDER,
    DistanceErrorStatistics,
    DistanceSeries,
    Receiver,
    quality_shares,
    receiver_distances,
    receivers,
)
from tsgt.analysis.gnss.prism_baselines import common_interval, prism_distances, span

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
    "span",
]
