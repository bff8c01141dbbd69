"""TODO face."""

from tsgt.analysis.design.layout_search import Criterion, Task, best_layout
from tsgt.analysis.design.layout_study import (
    HEADINGS,
    LayoutFigures,
    Stances,
    Station,
    pose_covariances,
    together_or_around,
)
from tsgt.analysis.design.perturbation import Perturbation, equivalent, first_order_sigmas, perturbation_study

__all__ = [
    "HEADINGS",
    "Criterion",
    "LayoutFigures",
    "Perturbation",
    "Stances",
    "Station",
    "Task",
    "best_layout",
    "equivalent",
    "first_order_sigmas",
    "perturbation_study",
    "pose_covariances",
    "together_or_around",
]
