"""TODO face."""

from tsgt.analysis.evaluation.held_out import (
    Fold,
    HeldOut,
    folds,
    held_out,
    hold_out,
    missed_by_lines,
    missed_by_trajectory,
    never_out,
)
from tsgt.analysis.evaluation.inter_prism import Epochs, InterPrism, PairDistances, at_epochs, inter_prism
from tsgt.analysis.evaluation.metrics import (
    Align,
    AlignedFigures,
    PoseErrors,
    PoseFigures,
    inner_part,
    pose_errors,
)
from tsgt.analysis.evaluation.reference import Reference, compare, compare_aligned, read_tum
from tsgt.analysis.evaluation.residuals import (
    AxisFigures,
    Outlier,
    normalised_residuals,
    outliers,
    residual_figures,
)
from tsgt.analysis.evaluation.stationary import StandingFigures, standing_errors

__all__ = [
    "Align",
    "AlignedFigures",
    "AxisFigures",
    "Epochs",
    "Fold",
    "HeldOut",
    "InterPrism",
    "Outlier",
    "PairDistances",
    "PoseErrors",
    "PoseFigures",
    "Reference",
    "StandingFigures",
    "at_epochs",
    "compare",
    "compare_aligned",
    "folds",
    "held_out",
    "hold_out",
    "inner_part",
    "inter_prism",
    "missed_by_lines",
    "missed_by_trajectory",
    "never_out",
    "normalised_residuals",
    "outliers",
    "pose_errors",
    "read_tum",
    "residual_figures",
    "standing_errors",
]
