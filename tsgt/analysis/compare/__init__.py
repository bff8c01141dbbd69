"""Somebody's estimate against the reference: the relation between them is fitted jointly, then the errors are stated.

Comes in: reference poses with covariance, estimates of other programs (poses or positions, on their own clock, in their own frame,
of their own point on the robot). Goes out: time offset, extrinsic and frame with uncertainties, and error statistics.
"""

from tsgt.analysis.compare.alignment import fit, nested_fits, overlap_s
from tsgt.analysis.compare.comparison import (
    Comparison,
    compare_estimate,
    compare_estimates,
    reference_keys,
)
from tsgt.analysis.compare.error_table import error_csv
from tsgt.analysis.compare.errors import TRAVEL_COMPONENTS, JudgedErrors
from tsgt.analysis.compare.pairing import PairedPoses, pair
from tsgt.analysis.compare.relation import (
    Alignment,
    ExtrinsicPrior,
    Fit,
    FitSettings,
    FittedPart,
    Relation,
    initial_relation,
)
from tsgt.analysis.compare.trajectories import Estimate, ReferencePoses, reference_at

__all__ = [
    "TRAVEL_COMPONENTS",
    "Alignment",
    "Comparison",
    "Estimate",
    "ExtrinsicPrior",
    "Fit",
    "FitSettings",
    "FittedPart",
    "JudgedErrors",
    "PairedPoses",
    "ReferencePoses",
    "Relation",
    "compare_estimate",
    "compare_estimates",
    "error_csv",
    "fit",
    "initial_relation",
    "nested_fits",
    "overlap_s",
    "pair",
    "reference_at",
    "reference_keys",
]
