"""Fixed-lag smoother with an IMU: the trajectory online, in a window of knots that moves with time. Sans-I/O.

As without an IMU: knots older than a few seconds are marginalised into an anchor prior, here on the oldest knot, the tilt of
gravity and the accelerometer's matrix, and new measurements are weighed by their normalised innovation squared. The samples between two knots are integrated
once, and again where a measurement divides them, where samples arrive late, or where the bias of the gyro moves. The start needs
no pose: docs/explanation/imu.md.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.inertial.anchor import InertialAnchor
from tsgt.geometry.inertial.live.health import HealthMonitor
from tsgt.geometry.inertial.live.held_samples import HeldSamples
from tsgt.geometry.inertial.live.known_rotation import KnownRotation
from tsgt.geometry.inertial.live.prediction import StrapdownPredictor
from tsgt.geometry.inertial.live.rate_prediction import RotationPredictor
from tsgt.geometry.inertial.live.start_search import DIFFUSE_SIGMAS, StartSearch
from tsgt.geometry.inertial.live.window import KnotWindow, SolvedWindow, divided, propagate
from tsgt.geometry.inertial.live.window_trajectory import WindowTrajectory
from tsgt.geometry.inertial.odometry import Odometry, WheelSamples, WheelsEstimate
from tsgt.geometry.inertial.query import InertialTrajectory
from tsgt.geometry.inertial.sensitivity import InertialSensitivity, Linearised, by_mounting, of_gyro_alone
from tsgt.geometry.inertial.smoother import estimation_noise
from tsgt.geometry.inertial.solver import (
    MAX_KNOT_SPACING_S,
    InertialSetup,
    InertialSolution,
    apply_linear_step,
    diffuse_inertial_prior,
    factorise,
    solve_inertial,
)
from tsgt.geometry.inertial.states import INERTIAL_STATE_DIM, Gravity, Mounting
from tsgt.geometry.rigid import log_so3
from tsgt.geometry.trajectory.gauss_newton import (
    MAX_ITERATIONS,
    MIN_KNOT_SPACING_S,
    add_measurements,
    nearest_knots,
)
from tsgt.geometry.trajectory.innovation_monitor import NOT_BY_CHANCE_NIS, InnovationMonitor
from tsgt.geometry.trajectory.measurement_factors import merge_observations, time_order
from tsgt.geometry.trajectory.measurement_window import (
    COST_TOLERANCE,
    LOST_SIGMA_RAD,
    MAX_STEPS,
    MeasurementWindow,
    is_below_step_tolerance,
    normalised_innovations,
)
from tsgt.geometry.trajectory.states import POSE_DIM

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.inertial.bordered import BorderedCholesky
    from tsgt.geometry.inertial.factors import InertialEquations
    from tsgt.geometry.inertial.live.saturation import SaturationMonitor
    from tsgt.geometry.inertial.samples import InertialSamples
    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.measurement_factors import Observations
    from tsgt.geometry.trajectory.sensitivity import SetupJacobian
    from tsgt.geometry.trajectory.states import States
    from tsgt.model import ImuParameters, MotionPrior, OdometryParameters

SEARCH_S = 40.0  # Longest stretch of measurements that the search over headings takes
CONSISTENT_ALONE = 5
"""Measurements in succession that resolve an ambiguity, also of one prism: the samples, not the measurements before, predict
each of them. A chance agreement of wrong ones within the gate, five times, is none.
"""
UNPROVEN_GAP_S, UNPROVEN_SIGMA_M = 1.0, 0.05
"""Time without measurements, and sigma of the position after it, from which on a wrong prism, some decimetres away, may agree."""
MAX_ROTATION_SQUARES = 20.0
"""Of the rotation of a start against that from before, normalised, three components; 2 in 10,000 exceed it."""
WHEELS_SPAN_S = 4.0  # Over which rejected odometry counts
MAX_SECOND_ORDER_M = 0.01
"""Sigma of the position times that of the rotation up to which a linear prediction tells what chance gives. After 10 s without
measurements, at 0.04 m, measurements of right stations that came together had NIS up to 62.
"""
MAX_OUTAGE_S = 120.0  # Without measurements, after which the position is lost


class InertialFixedLagSmoother(MeasurementWindow):
    """Estimates the trajectory of a robot online, from measurements of any number of prisms and the samples of its IMU.

    ``observations`` have the layout in the axes of the robot from a reference point, whose states it gives.
    ``reliable_from_s``: each prism must have been measured twice; the first measurement, with nothing to contradict it, may be
    of a wrong prism. ``min_prisms``: how many prisms a start needs.
    """

    def __init__(
        self,
        imu: ImuParameters,
        prior: MotionPrior,
        *,
        reference_m: FloatArray,
        setup_jacobian: SetupJacobian | None = None,
        mounting_factor: FloatArray | None = None,
        gyro_only: bool = False,
        odometry: OdometryParameters | None = None,
        saturation: SaturationMonitor | None = None,
        min_prisms: int = 1,
    ) -> None:
        super().__init__(InnovationMonitor(CONSISTENT_ALONE))
        self._noise = estimation_noise(imu.noise)
        mounting = Mounting.of(imu, reference_m)
        self._mounting = replace(mounting, position=np.zeros(3)) if gyro_only else mounting
        wheels = (
            None
            if odometry is None
            else Odometry.of(WheelSamples.none(), odometry, self._mounting, reference_m)
        )
        self._held = HeldSamples(self._noise, wheels)
        self._prior, self._gyro_only = prior, prior if gyro_only else None
        gravity = Gravity.of(imu)
        if not gyro_only:
            gravity = gravity.with_matrix(imu.noise.accelerometer_scale_misalignment, mounting.rotation[2])
        self._gravity = gravity
        self._search = StartSearch(self._noise, self._gyro_only, gravity, min_prisms)
        self._health = HealthMonitor(imu, saturation)
        self._rotation_predictor = RotationPredictor()
        self._window: KnotWindow | None = None
        self._solved: SolvedWindow | None = None
        self._sensitivity: InertialSensitivity | None = None
        if gyro_only and mounting_factor is not None:
            mounting_factor = of_gyro_alone(mounting_factor)
        if setup_jacobian is not None:
            self._sensitivity = InertialSensitivity(
                setup_jacobian, self._mounting, gyro_only=gyro_only, mounting_factor=mounting_factor
            )
        self._mounting_factor = mounting_factor
        self._anchor_displacement: FloatArray | None = None
        self._displacement: tuple[FloatArray, FloatArray] | None = None
        self._trajectory: WindowTrajectory | None = None
        self._predictor: StrapdownPredictor | None = None
        self._searched: Observations | None = None  # Also those before the horizon, while there is no start
        self._known: KnownRotation | None = None

    @property
    def initialised(self) -> bool:
        """Whether there is a trajectory."""
        return self._predictor is not None

    @property
    def biases(self) -> tuple[FloatArray, FloatArray | None] | None:
        """Biases of gyro and accelerometer at the newest knot, (3,) in rad/s and m/s^2, in the axes of the IMU.

        None without a trajectory; None for the accelerometer with the gyro alone.
        """
        if self._window is None or not self.initialised:
            return None
        knots = self._window.knots
        return knots.gyro_bias[-1], None if self._gyro_only is not None else knots.bias_or_acceleration[-1]

    @property
    def wheels(self) -> WheelsEstimate | None:
        """Newest scale, slip and direction of the wheel odometry, and how much of it is rejected; None without it or without a trajectory."""
        if self._held.odometry is None or self._solved is None or self._predictor is None:
            return None
        window = self._solved.window
        steps = window.factors.odometry
        assert steps is not None  # noqa: S101 (there is odometry)
        return self._predictor.wheels(window.knots, steps, WHEELS_SPAN_S)

    @property
    def health(self) -> str | None:
        """Why the samples of the IMU are rejected now, for people; None: they are used.

        A reason is given while values are stuck, beyond any range, or at the limit of an axis; where the newest sample
        is older than 0.4 s at the time of a prediction; and when two prisms disagree with the samples within 1.2 s (one, three times
        in succession, where none other is measured). Stuck values and values beyond any range are left out. When prisms
        disagree, the trajectory is initialised again from what comes after. Save for old samples, the reason stays for 2 s after its last cause; then, and
        once there is a trajectory again, the samples are used. :class:`~tsgt.geometry.inertial.live.health.HealthMonitor` gives the
        grounds of the thresholds.
        """
        return self._health.reason

    @property
    def setup_doubt(self) -> str:
        """Why the mounting of the IMU may have changed: a shock, or whatever made the samples disagree with the prisms; else empty."""
        return self._health.setup_doubt

    def add_samples(self, new: InertialSamples) -> None:
        """Add samples, in the order of time; they may precede others that were added before."""
        if not len(new):
            return
        new = new.select(self._health.samples(new))
        self._rotation_predictor.learn(new)
        self._discard_predicted(self._held.add(new, self._health.stuck_from_s))

    def add_odometry(self, new: WheelSamples) -> None:
        """Add samples of the wheel odometry, in the order of time; they may precede others that were added before."""
        if self._held.odometry is not None and len(new):
            self._discard_predicted(self._held.add_odometry(new))

    def _discard_predicted(self, after_s: float) -> None:
        if self._predictor is not None:
            self._predictor.discard_after(after_s)

    def marginalise_before(self, before_s: float) -> None:
        """Marginalise the states before a time; states from then on can still be queried."""
        tracked = self._converged
        super().marginalise_before(before_s)
        if tracked and not self._converged:  # It has just been lost, by rounding
            self._searched = self.observations
        if self._predictor is not None and before_s - self._predictor.time_s > MAX_OUTAGE_S:
            self._converged = False
            if len(self._held.imu):
                self._keep_rotation(before_s)
            self._discard_trajectory()
        elif self._converged:
            assert self._window is not None  # noqa: S101 (converged)
            before_s = float(self._window.knots.time_s[0])
        elif self._searched is not None:
            before_s -= SEARCH_S
            self._searched = self._searched.select(self._searched.time_s >= before_s)
        known = self._known
        if known is not None and self._predictor is None and before_s > known.time_s and len(self._held.imu):
            self._keep_rotation(before_s)  # Before the samples are forgotten
        # A trajectory that is lost still predicts.
        self._held.discard_before(
            before_s if self._predictor is None else min(before_s, self._predictor.time_s)
        )

    def predict(self, time_s: float, *, dim: int = POSE_DIM) -> tuple[States, FloatArray]:
        """Return the state at a time, given all so far, and the (1, 6, 6) covariance of its pose.

        Beyond the newest knot the samples are integrated, and beyond the last one the motion prior goes on; the newest NIS
        scales the covariance.
        """
        assert self._predictor is not None  # noqa: S101 (only called while initialised)
        self._health.advance(time_s)
        if time_s >= self._predictor.time_s:
            return self._predict(time_s, dim)
        return self.trajectory().at(np.array([time_s]), dim=dim)

    def _predict(self, time_s: float, dim: int) -> tuple[States, FloatArray]:
        assert self._predictor is not None  # noqa: S101 (only called while initialised)
        state, covariance = self._predictor.at(time_s, self._held.imu, self._held.odometry)
        return state, covariance[:, :dim, :dim] * self._prediction_scale()

    def trajectory(self) -> WindowTrajectory:
        """Return the trajectory over the window and over what the last :meth:`marginalise_before` eliminated."""
        if self._trajectory is None:
            assert self._solved is not None  # noqa: S101 (only called while initialised)
            window, gravity, factor, _ = self._solved
            displacement = self._window_displacement()
            covariance, cross_covariance = factor.marginals()
            motion = slice(INERTIAL_STATE_DIM)
            self._trajectory = WindowTrajectory(
                InertialTrajectory(
                    window.knots,
                    gravity,
                    window.samples,
                    self._mounting,
                    covariance[:, motion, motion],
                    cross_covariance[:, motion, motion],
                    self._gyro_only,
                    None if displacement is None else displacement[0][:, motion],
                    self._mounting_factor,
                ),
                self._predict,
                self._predicted_common,
            )
        return self._trajectory

    def smoothed_trajectory(self) -> WindowTrajectory:
        """Return :meth:`trajectory`: the samples say themselves whether the robot stands."""
        return self.trajectory()

    def common_at(self, time_s: float, *, dim: int = POSE_DIM) -> FloatArray | None:
        """Return the (1, 6, 6) covariance that the set-up's uncertainty adds to :meth:`predict`; None: unknown."""
        if self._sensitivity is None:
            return None
        assert self._predictor is not None  # noqa: S101 (only called while initialised)
        if time_s < self._predictor.time_s:
            return self.trajectory().common_at(np.array([time_s]), dim=dim)
        return self._predicted_common(time_s, dim)

    def _predicted_common(self, time_s: float, dim: int) -> FloatArray:
        assert self._predictor is not None  # noqa: S101 (only called while initialised)
        displacement = self._window_displacement()
        assert displacement is not None  # noqa: S101 (only called where the set-up is uncertain)
        newest = np.concatenate([displacement[0][-1], displacement[1]])
        displaced = self._predictor.by_start(time_s, self._held.imu, self._held.odometry) @ newest
        if self._mounting_factor is not None:
            state, _ = self._predictor.at(time_s, self._held.imu, self._held.odometry)
            displaced += by_mounting(state, self._mounting)[0] @ self._mounting_factor
        displaced = displaced[:dim]
        covariance: FloatArray = (displaced @ displaced.T)[None]
        return covariance

    def _window_displacement(self) -> tuple[FloatArray, FloatArray] | None:
        """Displacement of the knots and of what they share by the set-up, computed once per solution; None: unknown."""
        if self._sensitivity is not None and self._displacement is None:
            assert self._solved is not None  # noqa: S101 (only called while initialised)
            self._displacement = self._sensitivity.displacement(self._solved.linearised, self._solved.factor)
        return self._displacement

    def _discard_trajectory(self) -> None:
        self._window, self._solved, self._predictor, self._trajectory = None, None, None, None

    def _mounted(self, observations: Observations) -> Observations:
        return replace(observations, layout=self._mounting.in_imu(observations.layout))

    def update(self, new: Observations) -> None:
        """Process measurements, in the order of time, none before :attr:`horizon_s`."""
        self._health.advance(float(new.time_s[-1]))
        while self._converged and (row := self._first_after_outage(new)):
            super().update(new.select(slice(row)))
            new = new.select(slice(row, None))
        if not self._converged:
            searched = self.observations if self._searched is None else self._searched
            self._searched = merge_observations(searched, new)
        super().update(new)
        if self._converged:
            self._searched = None
        elif self._searched is None:
            self._searched = self.observations

    def _first_after_outage(self, new: Observations) -> int:
        """Return the first new measurement after an outage of all prisms that others precede, which arrived with it; 0 without one."""
        assert self._predictor is not None  # noqa: S101 (converged)
        before_s = np.maximum(new.time_s[:-1], self._predictor.time_s)
        rows = np.flatnonzero(new.time_s[1:] - before_s >= UNPROVEN_GAP_S)
        return int(rows[0]) + 1 if len(rows) else 0

    def _initialise(self, observations: Observations) -> None:
        self._converged, self._newest_nis = False, 0.0
        self._monitor.reset(observations)
        if len(self._held.imu):
            self._keep_rotation(float(observations.time_s[-1]))
        self._discard_trajectory()
        self.residuals_m = np.full((len(observations), 3), np.nan)
        if not len(self._held.imu):
            raise GeometryError("no samples of the IMU")
        # Before the first sample nothing links the measurements.
        begin_s = self._held.begin_s
        if observations.time_s[0] < begin_s:
            self._horizon_s = begin_s
            self._select(observations.time_s >= begin_s)
            observations = observations.select(observations.time_s >= begin_s)
        searched = observations if self._searched is None else self._searched
        searched = searched.select(searched.time_s >= begin_s)
        found, consistent = self._search.find(self._mounted(searched), self._held)
        knots = found.knots
        prior = diffuse_inertial_prior(
            knots.select(slice(0, 1)), found.gravity, self._noise, self._gyro_only, self._held.odometry
        )
        sigmas = np.diag(prior.information) ** -0.5
        sigmas[:9] = DIFFUSE_SIGMAS
        anchor = replace(prior, information=np.diag(sigmas**-2.0))
        samples = self._held.contiguous(knots.time_s)
        self._window = KnotWindow(knots, found.factors, samples.at(knots.time_s), anchor, samples)
        # Without measurements before the horizon, which the start needed.
        held = searched.time_s >= self._horizon_s
        first = int(found.knot_index[held][0])
        self._anchor_displacement = None
        outliers = self._accept(self._mounted(searched), found.knot_index, found.gravity, found.factor, found)
        outliers = outliers[held]
        if outliers.all():  # a single one, say, after an outage: whether the start still holds is not known
            raise GeometryError("none of the newest measurements agrees with the trajectory")
        self._converged &= consistent and self._keeps_rotation()
        if self._converged:
            if first > 0:
                self._eliminate(searched, found.knot_index, first, ~held)
            self.residuals_m = self.residuals_m[-len(observations) :]
            counts = np.bincount(observations.prism[~outliers])
            # A wrong prism that is measured alone agrees with itself.
            unproven = len(observations.layout) > 1 and int(np.count_nonzero(counts > 1)) < 2
            self._monitor.set_start(
                float(observations.time_s[0 if unproven else -1]), needs_two_prisms=unproven
            )
            self._search.restart()
            self._reliable_from_s = _measured_twice_s(observations.select(~outliers))
        else:
            self.residuals_m = np.full((len(observations), 3), np.nan)
            # Samples from before the IMU was consistent again contradict the measurements: the next search does without the older half.
            middle_s = 0.5 * (searched.time_s[0] + searched.time_s[-1])
            self._searched = searched.select(searched.time_s >= middle_s)
            self._horizon_s = max(self._horizon_s, float(middle_s))
            self._select(observations.time_s >= middle_s)
            raise GeometryError("the measurements do not determine the trajectory")

    def _keeps_rotation(self) -> bool:
        """Whether the rotation of a start is the one from before, propagated by the gyro.

        A tripod that has moved or tilted turns what two prisms tell of the rotation, or all that one tells of the heading.
        """
        assert self._solved is not None  # noqa: S101 (it was solved)
        if self._known is None:
            return True
        knots = self._solved.window.knots
        known = self._propagated(self._known, float(knots.time_s[-1]))
        turned = log_so3(known.rotation.T @ knots.rotation[-1])
        covariance = known.covariance[:3, :3] + self._solved.factor.last_covariance()[3:6, 3:6]
        return float(turned @ np.linalg.solve(covariance, turned)) < MAX_ROTATION_SQUARES

    def _keep_rotation(self, newest_s: float) -> None:
        """Remember the rotation that the measurements before the window told, or the one from before: newer ones may be wrong."""
        known = self._known
        if known is not None:
            known = None if newest_s > known.until_s else self._propagated(known, newest_s)
        if self._window is not None:
            lost = self._propagated(KnownRotation.of(self._window.anchor), newest_s)
            # A trajectory that was lost soon knows less than the one before it.
            if known is None or np.trace(lost.covariance[:3, :3]) < np.trace(known.covariance[:3, :3]):
                known = lost
        self._known = known

    def _propagated(self, known: KnownRotation, time_s: float) -> KnownRotation:
        times_s = np.array([known.time_s, max(time_s, known.time_s)])
        return known.propagated(self._held.contiguous(times_s), float(times_s[1]), self._noise)

    def _update_tracked(self, held: Observations, new: Observations) -> bool:
        assert self._window is not None  # noqa: S101 (converged)
        assert self.observations is not None  # noqa: S101 (converged)
        if self._window.knots.time_s[0] - new.time_s[0] > 0.5 * MIN_KNOT_SPACING_S:
            return False  # in the first window, earlier than all others
        self._check_proven(new)
        self._window = self._window_with(new.time_s)
        window, observations = self._window, self._mounted(self.observations)
        knot_index = nearest_knots(window.knots.time_s, observations.time_s)
        is_new = time_order(held, new) >= len(held)
        knots, gravity = window.knots, self._gravity

        def assembled(active: NDArray[np.bool_] | None) -> InertialEquations:
            return window.assemble(
                observations, knot_index, knots, gravity, rejectable=~is_new, active=active
            )

        system = assembled(~is_new)
        factor = factorise(system)

        def solve_system(rhs: FloatArray) -> FloatArray:
            shared = np.zeros((len(system.corner_gradient), rhs.shape[2]))
            shared[:, -1] = -system.corner_gradient
            return factor.solve(rhs, shared)[0]

        nis, sequential_nis = normalised_innovations(
            system.whitened[is_new], knot_index[is_new], system.gradient, solve_system
        )
        if self._health.innovations(observations.time_s[is_new], observations.prism[is_new], nis):
            self._held.clear_imu()
            self._search.restart()
            self._searched = self._known = None
            return False
        certain = None
        if sequential_nis.max() > NOT_BY_CHANCE_NIS:
            covariance = factor.marginals()[0][knot_index[is_new]]
            position, rotation = (
                np.linalg.eigvalsh(covariance[:, block, block])[:, -1] for block in (slice(3), slice(3, 6))
            )
            certain = (rotation < LOST_SIGMA_RAD**2) & (position * rotation < MAX_SECOND_ORDER_M**2)
        weights = self._weigh(nis, sequential_nis)
        system.weights[is_new] = weights
        add_measurements(
            system.whitened[is_new], weights, knot_index[is_new], system.diagonal, system.gradient
        )
        for _ in range(MAX_STEPS):
            factor = factorise(system)
            step, shared = factor.solve(-system.gradient, -system.corner_gradient)
            gain = -float(np.vdot(step, system.gradient) + np.vdot(shared, system.corner_gradient))
            knots, gravity = knots.retract(step), gravity.retract(shared)
            if gain < COST_TOLERANCE or (np.all(weights == 1.0) and is_below_step_tolerance(step)):
                self._window = replace(window, knots=knots)
                outliers = self._accept(
                    observations,
                    knot_index,
                    gravity,
                    factor,
                    apply_linear_step(system, knot_index, step, gain),
                )
                break
            system = assembled(None)
        else:
            found = solve_inertial(
                observations,
                InertialSetup(window.samples, self._noise, self._gyro_only, self._held.odometry),
                knots,
                gravity,
                anchor=window.anchor,
                factors=window.factors,
            )
            self._window = replace(window, knots=found.knots, factors=found.factors)
            outliers = self._accept(observations, knot_index, found.gravity, found.factor, found)
            self._converged &= found.iterations < MAX_ITERATIONS
        self._monitor.update(
            observations, is_new, sequential_nis, outliers, self.residuals_m, certain=certain
        )
        return self._converged

    def _check_proven(self, new: Observations) -> None:
        """Have the measurements after an outage confirmed by another prism, where there is one."""
        assert self._predictor is not None  # noqa: S101 (converged)
        first_s = float(new.time_s[0])
        if first_s - self._predictor.time_s < UNPROVEN_GAP_S:
            return
        self._monitor.set_outage(self._predictor.time_s, first_s)
        _, covariance = self._predict(first_s, POSE_DIM)
        if np.trace(covariance[0, :3, :3]) > UNPROVEN_SIGMA_M**2:
            prisms = frozenset(new.prism.tolist())
            self._monitor.set_unproven(first_s, prisms, needs_two_prisms=len(new.layout) > 1)

    def _window_with(self, time_s: FloatArray) -> KnotWindow:
        """Return the window with knots at measurement times that have none nearby, and with the samples that have arrived."""
        assert self._window is not None  # noqa: S101 (converged)
        window = self._window
        knots, old_s = window.knots, window.knots.time_s
        added = [each for each in time_s.tolist() if np.abs(old_s - each).min() > 0.5 * MIN_KNOT_SPACING_S]
        times_s = old_s
        for each in added:
            if np.abs(times_s - each).min() > 0.5 * MIN_KNOT_SPACING_S:
                times_s = np.sort(np.append(times_s, each))
        if added and times_s[-1] - old_s[-1] > MAX_KNOT_SPACING_S:
            newest = int(times_s.searchsorted(old_s[-1]))
            times_s = np.concatenate([times_s[:newest], divided(times_s[newest:])])
        samples = self._held.contiguous(times_s)
        # The states of the knots before; those of new ones are propagated below.
        nearest = old_s.searchsorted(times_s, side="right") - 1
        guess = replace(knots.select(nearest), time_s=times_s)
        factors = window.factors_at(
            guess,
            samples,
            self._noise,
            stale_from_s=self._held.stale_from_s,
            gyro_only=self._gyro_only,
            odometry=self._held.odometry,
        )
        for row in np.flatnonzero(old_s[nearest] != times_s).tolist():
            propagate(guess, row, factors, self._gravity, self._gyro_only)
        self._held.stale_from_s = np.inf
        if factors.odometry is not None:
            assert self._predictor is not None  # noqa: S101 (converged)
            steps = factors.odometry.with_slip(guess.wheels[:, 1])
            rejected = self._predictor.wheels_rejected(times_s)
            whitening = np.where(rejected[:, None, None], 0.0, steps.whitening)
            factors = replace(factors, odometry=replace(steps, whitening=whitening))
        return KnotWindow(guess, factors, samples.at(times_s), window.anchor, samples)

    def _accept(
        self,
        observations: Observations,
        knot_index: NDArray[np.intp],
        gravity: Gravity,
        factor: BorderedCholesky,
        found: InertialEquations | InertialSolution,
    ) -> NDArray[np.bool_]:
        """Make a solution the trajectory; return which measurements are outliers."""
        assert self._window is not None  # noqa: S101 (it was solved)
        linearised = Linearised(
            observations,
            found.linearised,
            found.weights,
            knot_index,
            self._window.anchor,
            self._anchor_displacement,
        )
        self._solved = SolvedWindow(self._window, gravity, factor, linearised)
        self._gravity, self._trajectory, self._displacement = gravity, None, None
        self.residuals_m = found.linearised.residuals_m
        covariance = factor.last_covariance()
        self._predictor = StrapdownPredictor(
            self._window.knots.select(slice(-1, None)),
            covariance,
            gravity,
            self._noise,
            self._mounting,
            self._prior,
            gyro_only=self._gyro_only is not None,
            rotation_predictor=self._rotation_predictor,
        )
        return self._check(found.squared_distances, covariance[3:6, 3:6])

    def _eliminate_before(self, before_s: float) -> None:
        assert self._window is not None  # noqa: S101 (converged)
        assert self.observations is not None  # noqa: S101 (converged)
        knots_s = self._window.knots.time_s
        first = int(knots_s.searchsorted(before_s, side="right")) - 1
        if first <= 0:
            return
        knot_index = nearest_knots(knots_s, self.observations.time_s)
        is_past = knot_index < first
        self._eliminate(self.observations, knot_index, first, is_past)
        self._horizon_s = float(self._window.knots.time_s[0])
        self._select(~is_past)

    def _eliminate(
        self, observations: Observations, knot_index: NDArray[np.intp], first: int, is_past: NDArray[np.bool_]
    ) -> None:
        """Marginalise the knots before one, and measurements, into an anchor prior on it."""
        assert self._window is not None  # noqa: S101 (converged)
        window = self._window
        past = self._mounted(observations.select(is_past))
        system = window.select(slice(first + 1)).assemble(
            past,
            knot_index[is_past],
            window.knots.select(slice(first + 1)),
            self._gravity,
            rejectable=np.ones(int(is_past.sum()), np.bool_),
        )
        factor = factorise(system)
        step, shared = factor.solve(-system.gradient, -system.corner_gradient)
        if self._sensitivity is not None:
            linearised = system.linearised, system.weights, knot_index[is_past]
            solved = Linearised(past, *linearised, window.anchor, self._anchor_displacement)
            self._anchor_displacement = self._sensitivity.at_last(solved, factor)
        anchor = InertialAnchor.at_point(
            window.knots.select(slice(first, first + 1)),
            self._gravity.shared,
            factor.last_information(),
            np.concatenate([step[first], shared]),
            past.layout[past.prism].mean(axis=0) if len(past) else window.anchor.point,
            window.kinematics[0][first],
            None if self._gyro_only is not None else self._gravity.vector(),
        )
        self._window = replace(window.select(slice(first, None)), anchor=anchor)


def _measured_twice_s(observations: Observations) -> float:
    """Time from which each prism has been measured twice, of those that have."""
    times_s = [observations.time_s[observations.prism == prism] for prism in np.unique(observations.prism)]
    return float(max((each[1] for each in times_s if len(each) > 1), default=observations.time_s[-1]))
