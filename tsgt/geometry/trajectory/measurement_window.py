"""Measurements of a window that moves with time: outliers, ambiguity, initialisation and loss of the trajectory. Sans-I/O.

What fixed-lag smoothers share, with an IMU or without. A new measurement's initial weight follows from its normalised innovation
squared (NIS; Bar-Shalom), with the prediction's uncertainty: a large residual may also be a manoeuvre.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.trajectory.gauss_newton import OUTLIER_THRESHOLD, REJECTION_THRESHOLD
from tsgt.geometry.trajectory.innovation_monitor import AMBIGUITY_MARGIN_S, InnovationMonitor
from tsgt.geometry.trajectory.measurement_factors import merge_observations

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.measurement_factors import Observations
    from tsgt.geometry.trajectory.query import QueriedTrajectory
    from tsgt.geometry.trajectory.states import States

CONVERGED_SIGMA_RAD = 0.1  # Below, an initialised trajectory is tracked
LOST_SIGMA_RAD = 0.2
"""Rotation sigma above which the trajectory is reinitialised. The rotation that two prisms leave unobserved is about another
axis for each attitude: tracking beyond the range of the linearisation would create information from nothing.
"""

MIN_INLIER_SHARE = 0.5
MIN_INITIAL_INLIER_SHARE = 0.9
"""Share of inliers. A tracked trajectory tolerates a station on a wrong prism, an initialisation next to none: with some
measurements rejected, another pose metres away may fit the rest.
"""

COST_TOLERANCE = 0.01
"""Predicted gain, in squared sigmas of the whole window, below which a step is the last one. With an outlier, whose weight
changes with each step, a tolerance of 1 left predictions up to 0.6 sigmas from those of a full search.
"""

STEP_TOLERANCE_M = 0.05
STEP_TOLERANCE_RAD = 0.005
"""Steps below both need no relinearisation: at 20 m the line of sight changes by 0.06 mm over the one, and a prism at
1.5 m is 0.02 mm off the tangent of the other. The next measurement relinearises. With twice as much, predictions of a
robot rotating at 1 rad/s were up to 0.4 sigmas from those of a full search.
"""

MAX_STEPS = 5  # Without line search, which takes over then
PREDICTION_NIS_THRESHOLD = 4.0
"""NIS of the newest measurement above which the covariance of predictions is scaled up in proportion: a manoeuvre that has
begun goes on. A robot that moves as the prior says exceeds it once in four times.
"""


class MeasurementWindow(ABC):
    """The window's measurements, ``observations``, in the order of time, or None, and whether a trajectory explains them.

    ``residuals_m``: (M, 3) as in :class:`~tsgt.geometry.trajectory.measurement_factors.LinearisedMeasurements`; NaN without
    a trajectory.
    """

    def __init__(self, monitor: InnovationMonitor) -> None:
        self._horizon_s = -np.inf
        self._converged = False
        self._monitor = monitor
        self._reliable_from_s = np.inf
        self._newest_nis = 0.0
        self.observations: Observations | None = None
        self.residuals_m: FloatArray = np.empty((0, 3))

    @property
    def horizon_s(self) -> float:
        """Start of the window: earlier measurements are rejected."""
        return self._horizon_s

    @property
    @abstractmethod
    def initialised(self) -> bool:
        """Whether there is a trajectory."""

    @property
    def converged(self) -> bool:
        """Whether the trajectory is certain enough and explains the measurements."""
        return self._converged

    @property
    def reliable_from_s(self) -> float:
        """Time from which the trajectory since the last initialisation is reliable, infinite before the first one."""
        return self._reliable_from_s

    @property
    def ambiguous(self) -> bool:
        """Whether the newest measurements are inconsistent with each other or with the trajectory."""
        return bool(self._monitor.inconsistent_prisms)

    @property
    def ambiguous_from_s(self) -> float:
        """Start of the current ambiguity, infinite while the measurements are consistent."""
        return self._monitor.ambiguous_from_s

    def ambiguous_at(self, time_s: FloatArray) -> NDArray[np.bool_]:
        """Whether the state stays ambiguous at times (N,); see :class:`InnovationMonitor`."""
        return self._monitor.ambiguous_at(time_s)

    def recently_ambiguous_at(self, time_s: FloatArray) -> NDArray[np.bool_]:
        """Whether the state was ambiguous up to :data:`AMBIGUITY_MARGIN_S` before times (N,)."""
        return self._monitor.ambiguous_at(time_s, margin_s=AMBIGUITY_MARGIN_S)

    @property
    def followed_for_s(self) -> float:
        """Time over which the trajectory has followed inconsistent measurements, once they are consistent; see :class:`InnovationMonitor`."""
        return self._monitor.followed_for_s

    @property
    def lost_after_s(self) -> float:
        """Time over which measurements of one prism were inconsistent when the trajectory was lost, until there is a consistent one again."""
        return self._monitor.lost_after_s

    @property
    def beyond_chance(self) -> bool:
        """Whether a measurement in the current ambiguity is inconsistent beyond chance."""
        return self._monitor.beyond_chance

    @property
    def measured_prisms(self) -> int:
        """Number of prisms with measurements in the window."""
        return self._monitor.measured_prisms

    def update(self, new: Observations) -> None:
        """Process measurements, in the order of time, none before :attr:`horizon_s`."""
        held, self.observations = self.observations, merge_observations(self.observations, new)
        try:
            if not self._converged or held is None or not self._update_tracked(held, new):
                self._initialise(self.observations)
        except (GeometryError, np.linalg.LinAlgError):  # not determined, or not yet
            self._converged = False
            self._discard_trajectory()
            self.residuals_m = np.full((len(self.observations), 3), np.nan)
            self._monitor.reset(self.observations)

    def marginalise_before(self, before_s: float) -> None:
        """Marginalise the states before a time; states from then on can still be queried."""
        self._monitor.discard_before(before_s)
        if self.observations is None:
            return
        if self._converged:
            try:
                self._eliminate_before(before_s)
            except (GeometryError, np.linalg.LinAlgError):
                # By rounding alone; the window suffices to reinitialise.
                self._converged = False
        if not self._converged:
            self._horizon_s = max(self._horizon_s, before_s)
            self._select(self.observations.time_s >= before_s)

    @abstractmethod
    def predict(self, time_s: float, *, dim: int) -> tuple[States, FloatArray]:
        """Return the state at a time, given all so far, and the (1, dim, dim) covariance of its leading error components."""

    @abstractmethod
    def common_at(self, time_s: float, *, dim: int) -> FloatArray | None:
        """Return the (1, dim, dim) covariance that the set-up's uncertainty adds to :meth:`predict`; None: unknown."""

    @abstractmethod
    def trajectory(self) -> QueriedTrajectory:
        """Return the trajectory over the window and over what the last :meth:`marginalise_before` eliminated."""

    @abstractmethod
    def smoothed_trajectory(self) -> QueriedTrajectory:
        """Return the same for states between measurements, with rest as far as the window shows it."""

    @abstractmethod
    def _initialise(self, observations: Observations) -> None:
        """Find the trajectory of all measurements of the window without any prior knowledge. Raises GeometryError."""

    @abstractmethod
    def _update_tracked(self, held: Observations, new: Observations) -> bool:
        """Add measurements to the trajectory and return whether it can still be tracked. Raises GeometryError."""

    @abstractmethod
    def _discard_trajectory(self) -> None:
        """Forget the trajectory: there is none through the measurements."""

    @abstractmethod
    def _eliminate_before(self, before_s: float) -> None:
        """Marginalise the knots before the last one that is not after a time into an anchor prior on it."""

    def _select(self, rows: NDArray[np.bool_]) -> None:
        assert self.observations is not None  # noqa: S101 (only called with some)
        self.observations = self.observations.select(rows)
        self.residuals_m = self.residuals_m[rows]
        self._monitor.select(rows)

    def _weigh(self, nis: FloatArray, sequential_nis: FloatArray) -> FloatArray:
        """Return initial weights of new measurements by their NIS, which is kept to scale predictions."""
        # A rejected measurement says nothing about the motion, any other no more than an outlier.
        newest = [
            min(each, OUTLIER_THRESHOLD**2)
            for each in sequential_nis.tolist()
            if each < REJECTION_THRESHOLD**2
        ]
        self._newest_nis = (newest or [self._newest_nis])[-1]
        weights: FloatArray = 1.0 / np.maximum(nis / OUTLIER_THRESHOLD**2, 1.0)
        return weights

    def _prediction_scale(self) -> float:
        """Scale of the covariance of predictions by the newest NIS."""
        return max(1.0, self._newest_nis / PREDICTION_NIS_THRESHOLD)

    def _check(self, squared_distances: FloatArray, rotation_covariance: FloatArray) -> NDArray[np.bool_]:
        """Decide whether a solution has converged; return which measurements are outliers."""
        sigma_rad = float(np.sqrt(np.linalg.eigvalsh(rotation_covariance)[-1]))
        outliers: NDArray[np.bool_] = squared_distances >= OUTLIER_THRESHOLD**2
        enough_inliers = float(np.mean(~outliers)) > (
            MIN_INLIER_SHARE if self._converged else MIN_INITIAL_INLIER_SHARE
        )
        self._converged = enough_inliers and sigma_rad < (
            LOST_SIGMA_RAD if self._converged else CONVERGED_SIGMA_RAD
        )
        return outliers


def normalised_innovations(
    whitened: FloatArray,
    knot_index: NDArray[np.intp],
    gradient: FloatArray,
    solve: Callable[[FloatArray], FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """NIS of N new measurements: each one's own, and conditioned on those before it that are inliers.

    Parameters
    ----------
    whitened : (N, 3, B + 1) of the new measurements, inactive in the system that ``solve`` solves.
    knot_index : (N,) of the new measurements.
    gradient : (K, B) of that system.
    solve : Solves the system for (K, B, 3 N + 1) right-hand sides, the last of which is minus its gradient.
    """
    count, size = len(whitened), whitened.shape[2] - 1
    rhs = np.zeros((*gradient.shape, 3 * count + 1))
    rhs[:, :, -1] = -gradient
    for i, knot in enumerate(knot_index):
        rhs[knot, :, 3 * i : 3 * i + 3] = whitened[i, :, :size].T
    projected = whitened[:, :, :size] @ solve(rhs)[knot_index]
    innovations = whitened[:, :, size] + projected[:, :, -1]
    covariance = np.eye(3 * count) + projected[:, :, :-1].reshape(3 * count, 3 * count)
    nis = np.empty(count)
    for i in range(count):
        block = slice(3 * i, 3 * i + 3)
        nis[i] = innovations[i] @ np.linalg.solve(covariance[block, block], innovations[i])
    if count == 1:
        return nis, nis
    sequential_nis, inliers = nis.copy(), np.flatnonzero(nis < OUTLIER_THRESHOLD**2)
    components = (3 * inliers[:, None] + np.arange(3)).ravel()
    try:
        root = np.linalg.cholesky(covariance[np.ix_(components, components)])
    except np.linalg.LinAlgError:  # by rounding alone
        raise GeometryError("the measurements do not determine the trajectory") from None
    sequential_nis[inliers] = (np.linalg.solve(root, innovations[inliers].ravel()).reshape(-1, 3) ** 2).sum(
        axis=1
    )
    return nis, sequential_nis


def is_below_step_tolerance(step: FloatArray) -> bool:
    """Whether Jacobians stay the same over a step, (K, B), position and rotation first."""
    return bool(
        np.abs(step[:, :3]).max() < STEP_TOLERANCE_M and np.abs(step[:, 3:6]).max() < STEP_TOLERANCE_RAD
    )
