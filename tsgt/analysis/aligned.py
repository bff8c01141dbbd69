"""What aligning poses with a reference would hide: errors before and after it. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from tsgt.analysis.metrics import pose_errors
from tsgt.geometry import align, log_so3, transform_from, transform_points

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

Align = Literal["translation", "rigid"]


@dataclass(frozen=True, slots=True)
class AlignedFigures:
    """How far poses are from a reference when they have been brought as close to it as one transform can.

    Attributes
    ----------
    translation_mm
        By how much the middle of the compared positions was shifted.
    rotation_deg
        By how much all of it was turned; 0 where only a shift was allowed.
    position_rms_mm, orientation_rms_deg
        Root mean squares of what is left.
    hidden_position_mm, hidden_orientation_deg
        Root mean squares before less those after: what an aligned figure does not show. The orientation may be worse
        after, since only positions are aligned.
    """

    translation_mm: float
    rotation_deg: float
    position_rms_mm: float
    orientation_rms_deg: float
    hidden_position_mm: float
    hidden_orientation_deg: float


def aligned_figures(
    estimated: FloatArray, true: FloatArray, point_m: FloatArray, mode: Align
) -> AlignedFigures:
    """Align poses with the truth at the same instants, and compare.

    Parameters
    ----------
    estimated, true
        ``T_station1_robot``, (N, 4, 4) each.
    point_m
        The point of the robot whose positions are aligned and compared, in the frame ``robot``, (3,).
    mode
        ``translation``: one shift for all poses. ``rigid``: a shift and a rotation, never a scale; what evo's ``-a`` does
        with the trajectories of this point (Umeyama 1991).

    Raises
    ------
    DegenerateGeometryError
        ``rigid``, and the positions lie in a line or at one place, or there are fewer than three.
    """
    before = pose_errors(estimated, true, point_m)
    found, wanted = transform_points(estimated, point_m), transform_points(true, point_m)
    if not len(estimated):
        return AlignedFigures(*(math.nan,) * 6)
    rotation = align(found, wanted).rotation if mode == "rigid" else np.eye(3)
    shift = wanted.mean(axis=0) - found.mean(axis=0)
    moved = transform_from(rotation, wanted.mean(axis=0) - rotation @ found.mean(axis=0)) @ estimated
    after = pose_errors(moved, true, point_m)
    return AlignedFigures(
        translation_mm=1e3 * float(np.linalg.norm(shift)),
        rotation_deg=math.degrees(float(np.linalg.norm(log_so3(rotation)))),
        position_rms_mm=after.position_rms_mm,
        orientation_rms_deg=after.orientation_rms_deg,
        hidden_position_mm=before.position_rms_mm - after.position_rms_mm,
        hidden_orientation_deg=before.orientation_rms_deg - after.orientation_rms_deg,
    )
