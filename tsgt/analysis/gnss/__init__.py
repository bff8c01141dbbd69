"""TODO face."""

from tsgt.analysis.gnss.baselines import (
    BEST_FIRST,
    DistanceErrors,
    Distances,
    Receiver,
    quality_shares,
    receiver_pairs,
    receivers,
)
from tsgt.analysis.gnss.prism_baselines import common_part, prism_pairs, span

__all__ = [
    "BEST_FIRST",
    "DistanceErrors",
    "Distances",
    "Receiver",
    "common_part",
    "prism_pairs",
    "quality_shares",
    "receiver_pairs",
    "receivers",
    "span",
]
