"""From a trajectory to poses as they leave the program: numbers, and whether they may be used. Live and at the desk."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry import point_covariance, quaternion_from_rotation, ros_covariance
from tsgt.master.pose_batch import Kind, PoseBatch, Reason

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.geometry import Knots
    from tsgt.model import Parameters

NO_IDEA_RAD = 0.5
"""A pose whose rotation has a sigma beyond this is not given at all."""

_NEVER_NS = -(2**61)


@dataclass(frozen=True, slots=True)
class Seen:
    """The measurements that a trajectory rests on.

    Attributes
    ----------
    times_ns
        (M,) instants of the usable ones in their order, on the master's Unix clock.
    stations
        (M,) numbers of their stations.
    prisms
        (M,) their prisms as columns of the layout.
    residuals_m
        (M,) what they are off the trajectory by; NaN where that is not known.
    unusable_ns
        By column, the instants of those that were not usable, in their order.
    """

    times_ns: NDArray[np.int64]
    stations: NDArray[np.int64]
    prisms: NDArray[np.intp]
    residuals_m: NDArray[np.float64]
    unusable_ns: Sequence[NDArray[np.int64]]


def continuous_poses(
    parameters: Parameters,
    kind: Kind,
    stamp_ns: NDArray[np.int64],
    seen: Seen,
    states: Knots | None,
    covariance: NDArray[np.float64],
) -> PoseBatch:
    """Put poses together.

    Parameters
    ----------
    parameters
        Limits, stations, layout.
    kind
        ``PREDICTED`` from measurements before the epochs, or ``SMOOTHED`` with some on both sides.
    stamp_ns
        (N,) epochs.
    seen
        Measurements.
    states, covariance
        The trajectory at the epochs, and the covariance of the errors of its place and rotation, (N, 6, 6) or more of
        them; None where there is none.

    Returns
    -------
    PoseBatch
        A pose is valid while the sigma of its position at the prisms' centroid and that of its rotation, in the direction
        in which each is known worst, are within the limits, and its prisms are where the trajectory puts them. The reason of
        one that is too uncertain is that of the prism that is missing, or ``uncertain`` when none is.
    """
    batch = PoseBatch.blank(stamp_ns, tuple(prism.prism for prism in parameters.prisms), kind)
    for column in range(len(batch.prisms)):
        _describe(batch, column, parameters, seen)
    missing = batch.prism_reason.max(axis=1)
    batch.reason[:] = np.where(missing, missing, Reason.DEGENERATE_GEOMETRY)
    if states is not None:
        _fill(batch, states, covariance)
        _judge(batch, parameters, states, covariance)
    return batch


def _describe(batch: PoseBatch, column: int, parameters: Parameters, seen: Seen) -> None:
    """Fill in what is known of one prism: station, age of its last measurement, residual, what is amiss."""
    epochs_ns, unusable_ns = batch.stamp_ns, seen.unusable_ns[column]
    rows = np.flatnonzero(seen.prisms == column)
    times_ns = seen.times_ns[rows]
    latest = np.searchsorted(times_ns, epochs_ns, side="right") - 1
    known = latest >= 0
    since_ns = np.full(len(epochs_ns), _NEVER_NS)
    since_ns[known] = times_ns[latest[known]]
    batch.station[:, column] = next(
        (station.station for station in parameters.stations if station.prism == batch.prisms[column]), 0
    )
    batch.station[known, column] = seen.stations[rows][latest[known]]
    batch.age_s[known, column] = (epochs_ns[known] - since_ns[known]) / 1e9
    until_ns, three = epochs_ns, latest[:, None] + np.arange(-2, 1)
    if batch.kind[:1] == Kind.SMOOTHED:
        following = np.searchsorted(times_ns, epochs_ns)
        inside = following < len(rows)
        until_ns = np.full(len(epochs_ns), -_NEVER_NS)
        until_ns[inside] = times_ns[following[inside]]
        nearest = np.where(until_ns - epochs_ns < epochs_ns - since_ns, following, latest)
        three = nearest[:, None] + np.arange(-1, 2)
    out = until_ns - since_ns > parameters.pipeline.outage_limit_ns
    batch.prism_reason[out, column] = Reason.OUTAGE
    if len(unusable_ns):
        newest = np.searchsorted(unusable_ns, epochs_ns, side="right") - 1
        spoilt = out & (newest >= 0) & (unusable_ns[newest] > since_ns)
        batch.prism_reason[spoilt, column] = Reason.STATION_STATUS
    # One alone that does not fit is an outlier; two of three are the robot's, or the set-up is wrong.
    near = rows[np.clip(three[~out], 0, len(rows) - 1)]
    batch.prism_residual_m[~out, column] = np.median(seen.residuals_m[near], axis=1)


def _fill(batch: PoseBatch, states: Knots, covariance: NDArray[np.float64]) -> None:
    """Fill in the poses of which anything is known."""
    rows = np.flatnonzero(_worst_sigma(covariance[:, 3:6, 3:6]) < NO_IDEA_RAD)
    known = states.select(rows)
    batch.position_m[rows] = known.position
    batch.orientation_xyzw[rows] = quaternion_from_rotation(known.rotation)
    batch.covariance[rows] = ros_covariance(known.rotation, covariance[rows])
    batch.velocity_mps[rows] = known.velocity
    batch.angular_velocity_radps[rows] = known.angular_velocity
    told = np.isfinite(batch.prism_residual_m)
    some = rows[told[rows].any(axis=1)]
    squares = np.where(told, batch.prism_residual_m, 0.0)[some] ** 2
    batch.residual_m[some] = np.sqrt(squares.sum(axis=1) / told[some].sum(axis=1))


def _judge(batch: PoseBatch, parameters: Parameters, states: Knots, covariance: NDArray[np.float64]) -> None:
    """Say which poses may not be used, and why."""
    limits, missing = parameters.pipeline, batch.prism_reason.max(axis=1)
    centroid = np.mean([prism.position_m for prism in parameters.prisms], axis=0)
    at_centroid = point_covariance(states.rotation, covariance, centroid)
    uncertain = _worst_sigma(at_centroid) > limits.position_sigma_limit_m
    uncertain |= _worst_sigma(covariance[:, 3:6, 3:6]) > limits.rotation_sigma_limit_rad
    uncertain |= np.isnan(batch.position_m[:, 0])
    batch.reason[:] = Reason.VALID
    batch.reason[states.rotation[:, 2, 2] <= math.cos(limits.tilt_limit_rad)] = Reason.TILT
    batch.reason[batch.residual_m > limits.residual_limit_m] = Reason.RESIDUAL
    batch.reason[uncertain] = np.where(missing, missing, Reason.UNCERTAIN)[uncertain]


def _worst_sigma(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) one sigma in the direction in which it is largest."""
    sigma: NDArray[np.float64] = np.sqrt(np.linalg.eigvalsh(covariance)[:, -1])
    return sigma
