"""How good poses are: against a reference, and without one by inter-prism distances, held-out prediction and residuals.

Comes in: poses, prism tracks, observations or a trajectory fit of a recording, perhaps a reference trajectory (TUM).
Goes out: error statistics. docs/reference/evaluate.md defines every figure.
"""

from tsgt.analysis.evaluation.held_out import (
    Fold,
    HeldOutErrors,
    cross_validate,
    folds,
    held_out_errors,
    interpolation_errors,
    training_rows,
    trajectory_errors,
)
from tsgt.analysis.evaluation.inter_prism import (
    EpochDistances,
    InterPrismDistances,
    PairDistances,
    distances_at_epochs,
    inter_prism,
)
from tsgt.analysis.evaluation.metrics import (
    Align,
    AlignedErrorStatistics,
    PoseErrors,
    PoseErrorStatistics,
    interior_mask,
    pose_errors,
)
from tsgt.analysis.evaluation.reference import (
    Reference,
    StationaryStatistics,
    compare,
    compare_aligned,
    read_tum,
    stationary_errors,
)
from tsgt.analysis.evaluation.residuals import (
    Outlier,
    ResidualStatistics,
    normalised_residuals,
    outliers,
    residual_statistics,
)

__all__ = [
    "Align",
    "AlignedErrorStatistics",
    "EpochDistances",
    "Fold",
    "HeldOutErrors",
    "InterPrismDistances",
    "Outlier",
    "PairDistances",
    "PoseErrorStatistics",
    "PoseErrors",
    "Reference",
    "ResidualStatistics",
    "StationaryStatistics",
    "compare",
    "compare_aligned",
    "cross_validate",
    "distances_at_epochs",
    "folds",
    "held_out_errors",
    "inter_prism",
    "interior_mask",
    "interpolation_errors",
    "normalised_residuals",
    "outliers",
    "pose_errors",
    "read_tum",
    "residual_statistics",
    "stationary_errors",
    "training_rows",
    "trajectory_errors",
]
