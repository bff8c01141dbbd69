"""Poses of an estimate and of the reference at the same instants, in one frame, of one point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.compare.interpolation import ReferenceTrajectory
from tsgt.errors import GeometryError
from tsgt.geometry import covariance_over_lever_arm, rotate, rotation_from_quaternion, transform_from

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.analysis.compare.relation import Relation
    from tsgt.analysis.compare.trajectories import Estimate, ReferencePoses
    from tsgt.geometry import FloatArray


@dataclass(frozen=True, slots=True)
class PairedPoses:
    """K poses of the sensor, by the estimate and by the reference, in frame ``station1``.

    Instants at which the reference is invalid, weak or missing are left out, and counted.
    """

    row: NDArray[np.intp]  # (K,) of the estimate
    stamp_ns: NDArray[np.int64]  # (K,) on the reference's clock
    estimated: FloatArray  # (K, 4, 4); of positions alone, the rotation is that of the reference
    reference: FloatArray  # (K, 4, 4)
    reference_covariance: FloatArray | None  # (K, 6, 6) as in PoseBatch
    estimate_covariance: FloatArray | None  # (K, 6, 6) likewise
    has_orientation: bool
    n_estimate: int  # Poses of the estimate
    n_outside: int  # of these before or after the reference
    n_reference_gap: int  # inside, but where the reference is invalid or missing
    n_reference_weak: int  # inside, but where its sigma is above the limit that was asked for
    reference_covariance_common: FloatArray | None = (
        None  # (K, 6, 6) part that all poses share; None: unknown
    )


@dataclass(frozen=True, slots=True)
class _Instants:
    """The reference at the poses of an estimate, by its clock alone."""

    inside: NDArray[np.bool_]  # (M,) not before or after the reference
    row: NDArray[np.intp]  # (K,) where the reference is known
    stamp_ns: NDArray[np.int64]  # (K,)
    point: FloatArray  # (K, 4, 4)
    covariance: FloatArray | None  # (K, 6, 6) of the point
    common: FloatArray | None


class Pairing:
    """Pairs an estimate with the reference under any relation; what follows from the clock alone is computed once for each clock.

    ``max_sigma_m``: of the sensor's position by the reference, along its least certain direction; above, the instant is left out.
    Raises GeometryError for a limit without a covariance of the reference.
    """

    def __init__(
        self, reference: ReferencePoses, estimate: Estimate, *, max_sigma_m: float | None = None
    ) -> None:
        if max_sigma_m is not None and reference.covariance is None:
            raise GeometryError("the reference has no covariance that could exceed the limit of its sigma")
        self.reference = reference
        self.estimate = estimate
        self._max_sigma_m = max_sigma_m
        self._trajectory = ReferenceTrajectory(reference)
        self._instants: dict[tuple[float, float], _Instants] = {}

    def under(self, relation: Relation) -> PairedPoses:
        """Pair each pose with the reference at its instant, both of the sensor and in ``station1``."""
        clock = (relation.offset_s, relation.skew)
        if clock not in self._instants:
            self._instants[clock] = self._at(relation)
        at, estimate = self._instants[clock], self.estimate
        row, stamp_ns, point, covariance, common = at.row, at.stamp_ns, at.point, at.covariance, at.common
        arm_m = rotate(point[:, :3, :3], relation.T_point_sensor[:3, 3])
        if arm_m.any():
            covariance, common = (
                None if each is None else covariance_over_lever_arm(each, arm_m)
                for each in (covariance, common)
            )
        n_weak = 0
        if self._max_sigma_m is not None and covariance is not None:
            good = np.linalg.eigvalsh(covariance[:, :3, :3])[:, -1] <= self._max_sigma_m**2
            n_weak = len(row) - int(np.count_nonzero(good))
            row, stamp_ns, point, covariance = row[good], stamp_ns[good], point[good], covariance[good]
            common = None if common is None else common[good]
        sensor = point @ relation.T_point_sensor
        return PairedPoses(
            row=row,
            stamp_ns=stamp_ns,
            estimated=_in_station1(estimate, relation, row, sensor),
            reference=sensor,
            reference_covariance=covariance,
            reference_covariance_common=common,
            estimate_covariance=_covariance_in_station1(estimate, relation, row),
            has_orientation=estimate.orientation_xyzw is not None,
            n_estimate=len(estimate.stamp_ns),
            n_outside=int(np.count_nonzero(~at.inside)),
            n_reference_gap=int(np.count_nonzero(at.inside)) - len(at.row),
            n_reference_weak=n_weak,
        )

    def _at(self, relation: Relation) -> _Instants:
        reference, trajectory = self.reference, self._trajectory
        stamp_ns = on_reference_clock(self.estimate, relation)
        inside = (stamp_ns >= trajectory.start_ns) & (stamp_ns <= trajectory.end_ns)
        row = np.flatnonzero(inside & trajectory.covers(stamp_ns))
        covariance, common = (
            None if each is None else trajectory.covariance_at(each, stamp_ns[row])
            for each in (reference.covariance, reference.covariance_common)
        )
        point = trajectory.motion_at(stamp_ns[row]).transform
        return _Instants(inside, row, stamp_ns[row], point, covariance, common)


def pair(
    reference: ReferencePoses,
    estimate: Estimate,
    relation: Relation,
    *,
    max_sigma_m: float | None = None,
) -> PairedPoses:
    """Pair as :class:`Pairing`, under one relation."""
    return Pairing(reference, estimate, max_sigma_m=max_sigma_m).under(relation)


def on_reference_clock(estimate: Estimate, relation: Relation) -> NDArray[np.int64]:
    """Return the instants of an estimate's poses on the reference's clock, (M,)."""
    since_first_ns = estimate.stamp_ns - estimate.stamp_ns[0]
    correction_ns = 1e9 * relation.offset_s + relation.skew * since_first_ns
    return np.asarray(estimate.stamp_ns + np.rint(correction_ns).astype(np.int64))


def _in_station1(
    estimate: Estimate, relation: Relation, row: NDArray[np.intp], sensor: FloatArray
) -> FloatArray:
    R, t = relation.T_station1_frame[:3, :3], relation.T_station1_frame[:3, 3]
    position = relation.scale * rotate(R, estimate.position_m[row]) + t
    if estimate.orientation_xyzw is None:
        return transform_from(sensor[:, :3, :3], position)
    return transform_from(R @ rotation_from_quaternion(estimate.orientation_xyzw[row]), position)


def _covariance_in_station1(
    estimate: Estimate, relation: Relation, row: NDArray[np.intp]
) -> FloatArray | None:
    if estimate.covariance is None:
        return None
    by_error = np.zeros((6, 6))
    by_error[:3, :3] = relation.scale * relation.T_station1_frame[:3, :3]
    by_error[3:, 3:] = relation.T_station1_frame[:3, :3]
    return np.asarray(by_error @ estimate.covariance[row] @ by_error.T)
