"""How good poses are: against a reference, and without one by inter-prism distances, held-out prediction and residuals.

Comes in: poses, prism tracks, observations or a trajectory fit of a recording, perhaps a reference trajectory (TUM).
Goes out: error statistics. docs/reference/evaluate.md defines every figure.
"""

from tsgt.analysis.evaluation.ate_rpe import (
    ErrorSummary,
    TransformErrors,
    absolute_errors,
    pairs_by_path,
    pairs_by_time,
    relative_errors,
)
from tsgt.analysis.evaluation.bins import BINS, Bins, Grid, binned, gridded
from tsgt.analysis.evaluation.error_series import (
    COMPONENTS,
    PoseComponents,
    PoseErrorDetails,
    error_components,
    error_details,
    pose_components,
)
from tsgt.analysis.evaluation.held_out import (
    PREDICTOR_NAMES,
    Fold,
    HeldOutErrors,
    Predictor,
    cross_validate,
    folds,
    held_out_errors,
    held_out_keys,
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
from tsgt.analysis.evaluation.live_comparison import LiveComparison, compare_live
from tsgt.analysis.evaluation.live_poses import LivePoseErrors, LivePoses
from tsgt.analysis.evaluation.metrics import (
    Align,
    AlignedErrorStatistics,
    NeesStatistics,
    PoseErrors,
    PoseErrorStatistics,
    interior_mask,
    pose_errors,
)
from tsgt.analysis.evaluation.normalised_prediction import (
    NormalisedErrors,
    NormalisedErrorStatistics,
    normalised_prediction_errors,
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
    noise_scales_by_axis,
    normalised_residuals,
    outliers,
    residual_statistics,
)
from tsgt.analysis.evaluation.streamed_poses import newest_age_s, read_streamed_poses

__all__ = [
    "BINS",
    "COMPONENTS",
    "PREDICTOR_NAMES",
    "Align",
    "AlignedErrorStatistics",
    "Bins",
    "EpochDistances",
    "ErrorSummary",
    "Fold",
    "Grid",
    "HeldOutErrors",
    "InterPrismDistances",
    "LiveComparison",
    "LivePoseErrors",
    "LivePoses",
    "NeesStatistics",
    "NormalisedErrorStatistics",
    "NormalisedErrors",
    "Outlier",
    "PairDistances",
    "PoseComponents",
    "PoseErrorDetails",
    "PoseErrorStatistics",
    "PoseErrors",
    "Predictor",
    "Reference",
    "ResidualStatistics",
    "StationaryStatistics",
    "TransformErrors",
    "absolute_errors",
    "binned",
    "compare",
    "compare_aligned",
    "compare_live",
    "cross_validate",
    "distances_at_epochs",
    "error_components",
    "error_details",
    "folds",
    "gridded",
    "held_out_errors",
    "held_out_keys",
    "inter_prism",
    "interior_mask",
    "interpolation_errors",
    "newest_age_s",
    "noise_scales_by_axis",
    "normalised_prediction_errors",
    "normalised_residuals",
    "outliers",
    "pairs_by_path",
    "pairs_by_time",
    "pose_components",
    "pose_errors",
    "read_streamed_poses",
    "read_tum",
    "relative_errors",
    "residual_statistics",
    "stationary_errors",
    "training_rows",
    "trajectory_errors",
]
