"""The relation between an estimate and the reference: clock, extrinsic, frame and scale; and which of these are fitted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray

FittedPart = Literal["offset", "skew", "extrinsic", "frame", "scale"]
Alignment = Literal["none", "start", "yaw", "rigid"]


@dataclass(frozen=True, slots=True)
class Relation:
    """Takes an estimate's pose E at its stamp τ to the pose ``T_station1_frame · scale(E)`` of the sensor.

    The reference has the same sensor at ``T_station1_point(t) · T_point_sensor``, with ``t = τ + offset_s + skew (τ - τ_0)``,
    where τ_0 is the estimate's first stamp. ``scale`` multiplies the positions of the estimate.
    """

    offset_s: float
    skew: float
    T_point_sensor: FloatArray  # (4, 4) extrinsic
    T_station1_frame: FloatArray  # (4, 4)
    scale: float


@dataclass(frozen=True, slots=True)
class ExtrinsicPrior:
    """Where the sensor is by CAD or by an earlier calibration."""

    T_point_sensor: FloatArray  # (4, 4)
    sigma: FloatArray
    """(6,) in m along, and in rad about, the axes of the reference's point; 0: known exactly."""


@dataclass(frozen=True, slots=True)
class FitSettings:
    """What is fitted, and how the frame is aligned."""

    parts: frozenset[FittedPart] = frozenset({"offset", "frame"})
    align: Alignment = "start"
    extrinsic_prior: ExtrinsicPrior | None = None
    max_offset_s: float = 60.0


@dataclass(frozen=True, slots=True)
class Fit:
    """A fitted relation.

    ``names`` of the P fitted unknowns: offset_s, skew, scale; extrinsic_{x,y,z}_m and _{roll,pitch,yaw}_rad (translation of the sensor in
    the axes of the reference's point; small rotation about these axes); frame_{x,y,z}_m and _{roll,pitch,yaw}_rad (about the axes of
    ``station1``, at the centroid of the estimate's positions).
    """

    relation: Relation
    names: tuple[str, ...]
    covariance: FloatArray  # (P, P) with the estimate's correlated errors allowed for
    unobservable: tuple[
        str, ...
    ]  # What the motion does not determine, named likewise; not fitted, left at its prior
    used: NDArray[np.bool_]  # (M,) poses of the estimate that were used: paired, and not outliers of the fit
    ate_sigma_m: float  # of the position ATE, by the uncertainty of clock, scale and extrinsic; NaN without a fitted frame


def initial_relation() -> Relation:
    """Return that of an estimate on the reference's clock, in its frame, of its point."""
    return Relation(offset_s=0.0, skew=0.0, T_point_sensor=np.eye(4), T_station1_frame=np.eye(4), scale=1.0)
