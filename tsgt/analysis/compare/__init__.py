"""Somebody's estimate against the reference: what stands between them is fitted jointly, then the errors are stated.

Comes in: reference poses with covariance, estimates of other programs (poses or positions, on their own clock, in their own frame,
of their own point on the robot). Goes out: time offset, extrinsic and frame with uncertainties, and error statistics.
"""

from tsgt.analysis.compare.alignment import fit, nested_fits, overlap_s
from tsgt.analysis.compare.assessment import Assessment, assess
from tsgt.analysis.compare.checks import (
    InputFinding,
    input_findings,
    quaternion_finding,
    relative_offset_s,
)
from tsgt.analysis.compare.comparison import (
    Comparison,
    FitStep,
    compare_estimate,
    compare_estimates,
    reference_keys,
)
from tsgt.analysis.compare.completeness import Completeness
from tsgt.analysis.compare.error_table import error_csv
from tsgt.analysis.compare.errors import TRAVEL_COMPONENTS, ErrorSeries, JudgedErrors
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
    "Assessment",
    "Comparison",
    "Completeness",
    "ErrorSeries",
    "Estimate",
    "ExtrinsicPrior",
    "Fit",
    "FitSettings",
    "FitStep",
    "FittedPart",
    "InputFinding",
    "JudgedErrors",
    "PairedPoses",
    "ReferencePoses",
    "Relation",
    "assess",
    "compare_estimate",
    "compare_estimates",
    "error_csv",
    "fit",
    "initial_relation",
    "input_findings",
    "nested_fits",
    "overlap_s",
    "pair",
    "quaternion_finding",
    "reference_at",
    "reference_keys",
    "relative_offset_s",
]
