"""Trajectory of a whole recording with an IMU, from measurements of three, two or one stations. Sans-I/O.

The search over headings starts the trajectory where the measurements tell the heading. From there the gyro, whose bias is known
by then, carries the rotation to the next segment, and the prisms' tracks give its positions: with the rotation known, the rest
is nearly linear. Segments overlap and are solved one after the other, which bounds the memory for the equations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.inertial.initialisation import MIN_MEASUREMENTS, search_heading, states_on_tracks
from tsgt.geometry.inertial.odometry import Odometry, covered_steps, rejected_steps
from tsgt.geometry.inertial.preintegration import contiguous, preintegrate
from tsgt.geometry.inertial.query import InertialTrajectory
from tsgt.geometry.inertial.sensitivity import of_gyro_alone, residual_variances, setup_displacement
from tsgt.geometry.inertial.solver import InertialSetup, inertial_knot_times, solve_inertial
from tsgt.geometry.inertial.states import (
    INERTIAL_STATE_DIM,
    TILT_DIM,
    Gravity,
    InertialStates,
    Mounting,
    concatenate_inertial_states,
)
from tsgt.geometry.trajectory import nearest_knots
from tsgt.geometry.trajectory.gauss_newton import OUTLIER_THRESHOLD

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from tsgt.geometry.inertial.initialisation import HeadingSearch
    from tsgt.geometry.inertial.odometry import WheelSamples
    from tsgt.geometry.inertial.preintegration import Preintegrated
    from tsgt.geometry.inertial.samples import InertialSamples
    from tsgt.geometry.inertial.solver import InertialSolution
    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory import Observations, SetupJacobian
    from tsgt.model import ImuNoise, ImuParameters, MotionPrior, OdometryParameters

SEGMENT_S = 240.0  # Over which the gyro turns by a few degrees more than it says
OVERLAP_S = 40.0  # On either side of a segment, solved with it and discarded
ALONE_SEGMENTS = 8
"""Segments that are solved together once more where one prism was measured: it tells the heading in motion alone, so that a segment
in which the robot stands needs what comes before and after.
"""
START_GROWTH = 4.0  # Factor on the length that is solved from one start to the next, until it is a segment
MAX_SLIP_SOLUTIONS = 3  # Each with the noise of slip by the one before
FIRST_SEARCH_S, LONGEST_SEARCH_S = 10.0, 80.0
"""Length of measurements that the search over headings takes, doubled while they do not tell the heading."""

ANGULAR_RATE_DENSITY, VERTICAL_FORCE_DENSITY = 0.48, 0.05
"""Of a driving robot, in rad/s/sqrt(Hz) below 0.1 Hz, all axes together, and in m/s^2/sqrt(Hz) below 1 Hz: scenario ``dynamic``; the rates of
``quarry``, ``ski-trail`` and ``snowmobile`` are 0.04 to 0.11. An error of the sensor's matrix times these is noise to the estimator; that
by forces across the vertical is estimated.
"""
NOMINAL_GRAVITY_MPS2 = 9.81
EARTH_RATE_WALK, CORIOLIS_WALK = 1.6e-5, 6e-5
"""Random walks of biases, in rad/s/sqrt(s) and m/s^2/sqrt(s), that the Earth's rotation passes for. Its horizontal part, 5e-5 rad/s at a
latitude of 45 degrees, turns in the axes of a robot that turns within some 10 s; the Coriolis acceleration, 1e-4 m/s^2 at 1 m/s, changes with
the velocity every 5 s: variance times 2 over the correlation time.
"""


@dataclass(frozen=True, slots=True)
class WheelsFit:
    """Wheel odometry of a fit, beside its estimate in the knots."""

    sigmas: FloatArray  # (K, 3) of scale, slip and direction at the knots
    covered: NDArray[np.bool_]  # (K - 1,) steps between knots that samples cover
    rejected: NDArray[np.bool_]  # (K - 1,) those that contradict IMU and prisms

    @classmethod
    def joined(cls, parts: list[WheelsFit]) -> WheelsFit | None:
        """Return that of a trajectory in parts; None without wheel odometry."""
        if not parts:
            return None
        return cls(
            np.concatenate([part.sigmas for part in parts]),
            np.concatenate([part.covered for part in parts]),
            np.concatenate([part.rejected for part in parts]),
        )


@dataclass(frozen=True, slots=True)
class InertialFit:
    """A trajectory with an IMU fitted to measurements; fields not explained here are those of a fit without."""

    trajectory: InertialTrajectory
    observations: Observations
    residuals_m: FloatArray
    squared_distances: FloatArray
    weights: FloatArray
    residual_variances_m2: (
        FloatArray  # (M, 3) expected squares of the residuals; NaN where they carry no information
    )
    tilt_sigma_rad: float  # One sigma of the tilt of gravity after the fit, the larger of both
    wheels: WheelsFit | None = None  # None without wheel odometry


def estimation_noise(noise: ImuNoise) -> ImuNoise:
    """Return the noise that the estimator assumes: that of the data sheet, and what it does not model."""
    of_accelerometer = noise.accelerometer_scale_misalignment
    terms = {
        "gyro_noise_density": ANGULAR_RATE_DENSITY * noise.gyro_scale_misalignment,
        "accelerometer_noise_density": VERTICAL_FORCE_DENSITY * of_accelerometer,
        "gyro_bias_walk": EARTH_RATE_WALK,
        "accelerometer_bias_walk": CORIOLIS_WALK,
        "accelerometer_bias_mps2": NOMINAL_GRAVITY_MPS2 * of_accelerometer,
    }
    return replace(noise, **{name: math.hypot(getattr(noise, name), term) for name, term in terms.items()})


def fit_inertial_trajectory(
    observations: Observations,
    samples: InertialSamples,
    imu: ImuParameters,
    *,
    reference_m: FloatArray,
    gyro_only: MotionPrior | None = None,
    odometry: tuple[WheelSamples, OdometryParameters] | None = None,
    setup_jacobian: SetupJacobian | None = None,
    mounting_factor: FloatArray | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> InertialFit:
    """Fit a trajectory to measurements of any number of prisms and to the samples of an IMU.

    Raises GeometryError: too few measurements, or none tells the heading.

    Parameters
    ----------
    observations : In the order of time, with the layout in the axes of the robot; from the first to the last, samples may be
        missing.
    reference_m : Origin of that layout, (3,) in the robot frame: the point whose poses the trajectory gives.
    gyro_only : Do not use the specific forces but this prior of the motion.
    odometry : Samples of the wheel odometry, and how they are used.
    setup_jacobian, mounting_factor : Sensitivity to the set-up's errors, for the part of the covariance that all states share;
        :class:`~tsgt.geometry.inertial.sensitivity.InertialSensitivity`.
    on_progress : Called with the completed share of the work, 0 to 1.
    """
    mounting = Mounting.of(imu, reference_m)
    of_states = mounting if gyro_only is None else replace(mounting, position=np.zeros(3))
    mounted = replace(observations, layout=of_states.in_imu(observations.layout))
    if gyro_only is not None and mounting_factor is not None:
        mounting_factor = of_gyro_alone(mounting_factor)
    time_s = inertial_knot_times(observations.time_s)
    noise = estimation_noise(imu.noise)
    setup = InertialSetup(
        contiguous(samples, noise, start_s=float(time_s[0]), end_s=float(time_s[-1])), noise, gyro_only
    )
    prior = Gravity.of(imu)
    if gyro_only is None:
        prior = prior.with_matrix(imu.noise.accelerometer_scale_misalignment, mounting.rotation[2])
    near, gravity = find_start(mounted, setup, prior)
    wheels = None if odometry is None else Odometry.of(*odometry, of_states, reference_m)
    problem = _Problem(
        mounted,
        replace(setup, odometry=wheels),
        gravity,
        time_s,
        nearest_knots(time_s, mounted.time_s),
        of_states,
        setup_jacobian,
        mounting_factor,
    )
    parts = problem.solved_in_segments(near, on_progress or (lambda _: None))
    if len(parts) > 1 and len(np.unique(mounted.prism)) == 1:
        parts = problem.solved_together(parts)
    trajectory = InertialTrajectory(
        concatenate_inertial_states([part.knots for part in parts]),
        parts[len(parts) // 2].gravity,
        setup.samples,
        of_states,
        np.concatenate([part.covariance for part in parts]),
        np.concatenate([part.cross_covariance for part in parts])[: len(time_s) - 1],
        gyro_only,
        None
        if setup_jacobian is None
        else np.concatenate([part.displacement for part in parts if part.displacement is not None]),
        mounting_factor,
    )
    return InertialFit(
        trajectory,
        observations,
        np.concatenate([part.residuals_m for part in parts]),
        np.concatenate([part.squared_distances for part in parts]),
        np.concatenate([part.weights for part in parts]),
        np.concatenate([part.residual_variances_m2 for part in parts]),
        max(part.tilt_sigma_rad for part in parts),
        WheelsFit.joined([part.wheels for part in parts if part.wheels is not None]),
    )


class _Solved(NamedTuple):
    """A stretch of the trajectory: its solution, its measurements, and the number of its first knot."""

    solution: InertialSolution
    observations: Observations
    first_knot: int


@dataclass(frozen=True, slots=True)
class _Problem:
    """A whole recording, of which stretches are solved."""

    observations: Observations  # With the layout in the axes of the IMU
    setup: InertialSetup
    gravity: Gravity
    time_s: FloatArray  # (K,) knots
    knot_index: NDArray[np.intp]  # (M,) knot of each measurement
    mounting: Mounting
    setup_jacobian: SetupJacobian | None
    mounting_factor: FloatArray | None

    @property
    def _edges_s(self) -> FloatArray:
        """Begin of each segment, and the end of the last."""
        first_s, last_s = float(self.time_s[0]), float(self.time_s[-1])
        return np.linspace(first_s, last_s, max(round((last_s - first_s) / SEGMENT_S), 1) + 1)

    def solved_in_segments(
        self, near: InertialStates, report_progress: Callable[[float], None]
    ) -> list[_Part]:
        """Solve segment by segment, from the one that contains the first of the states ``near`` to both ends."""
        edges_s = self._edges_s
        count = len(edges_s) - 1
        first = int(np.clip(edges_s.searchsorted(near.time_s[0], side="right") - 1, 0, count - 1))
        near, whole = self._grown(near)
        parts: dict[int, _Part] = {}
        for number in [*range(first, count), *range(first - 1, -1, -1)]:
            report_progress(len(parts) / count)
            if parts:
                near = parts[number - 1 if number > first else number + 1].knots
            solved = whole or self._solved_near(
                edges_s[number] - OVERLAP_S, edges_s[number + 1] + OVERLAP_S, near
            )
            parts[number] = self._kept(solved, number, number + 1)
        report_progress(1.0)
        return [parts[number] for number in range(count)]

    def solved_together(self, parts: list[_Part]) -> list[_Part]:
        """Solve several segments at once, from their solutions one by one."""
        edges_s, guess = self._edges_s, concatenate_inertial_states([part.knots for part in parts])
        together = []
        for begin in range(0, len(parts), ALONE_SEGMENTS):
            end = min(begin + ALONE_SEGMENTS, len(parts))
            knots, rows = self._within(edges_s[begin] - SEGMENT_S, edges_s[end] + SEGMENT_S)
            some = self.observations.select(rows)
            solved = _Solved(self._solution(some, guess.select(knots)), some, knots.start)
            together.append(self._kept(solved, begin, end))
        return together

    def _grown(self, near: InertialStates) -> tuple[InertialStates, _Solved | None]:
        """Solve ever longer stretches around states, until it is a segment, or the whole recording, which is returned, too."""
        while (length_s := near.time_s[-1] - near.time_s[0]) * START_GROWTH < SEGMENT_S:
            margin_s = 0.5 * (START_GROWTH - 1.0) * length_s
            solved = self._solved_near(near.time_s[0] - margin_s, near.time_s[-1] + margin_s, near)
            near = solved.solution.knots
            if len(near) == len(self.time_s):
                return near, solved
        return near, None

    def _solved_near(self, start_s: float, end_s: float, near: InertialStates) -> _Solved:
        """Solve a stretch from states close to it."""
        knots, rows = self._within(start_s, end_s)
        some = self.observations.select(rows)
        guess, preintegrated = extended(near, self.time_s[knots], some, self.setup)
        if self.setup.odometry is not None:
            guess = guess.with_wheels()
        return _Solved(self._solution(some, guess, preintegrated), some, knots.start)

    def _within(self, start_s: float, end_s: float) -> tuple[slice, slice]:
        """Return the knots of a stretch, and the measurements at them."""
        knots = slice(*self.time_s.searchsorted((start_s, np.nextafter(end_s, np.inf))).tolist())
        return knots, slice(*self.knot_index.searchsorted((knots.start, knots.stop)).tolist())

    def _solution(
        self, observations: Observations, guess: InertialStates, preintegrated: Preintegrated | None = None
    ) -> InertialSolution:
        """Solve a stretch from a guess of all its states; ``preintegrated``: the motions between them, if known."""
        setup = self.setup
        factors = setup.factors(guess, preintegrated)
        found = solve_inertial(observations, setup, guess, self.gravity, factors=factors)
        return found if setup.odometry is None else _with_large_slip(found, observations, setup)

    def _kept(self, solved: _Solved, begin: int, end: int) -> _Part:
        """Keep the segments from ``begin`` to before ``end`` of a solution."""
        inner = self.time_s.searchsorted(self._edges_s[1:-1]).tolist()
        ends = [0, *inner, len(self.time_s)]
        kept = slice(ends[begin] - solved.first_knot, ends[end] - solved.first_knot)
        return _Part.of(
            solved.solution,
            solved.observations,
            kept,
            self.mounting,
            self.setup_jacobian,
            self.mounting_factor,
        )


@dataclass(frozen=True, slots=True)
class _Part:
    """What is kept of a solved segment: its factor is as large as the rest."""

    knots: InertialStates
    covariance: FloatArray
    cross_covariance: FloatArray
    residuals_m: FloatArray
    squared_distances: FloatArray
    weights: FloatArray
    residual_variances_m2: FloatArray
    displacement: FloatArray | None
    gravity: Gravity
    tilt_sigma_rad: float
    wheels: WheelsFit | None

    @classmethod
    def of(
        cls,
        solution: InertialSolution,
        observations: Observations,
        kept: slice,
        mounting: Mounting,
        setup_jacobian: SetupJacobian | None,
        mounting_factor: FloatArray | None,
    ) -> _Part:
        """Return the knots ``kept`` and their measurements."""
        motion = slice(INERTIAL_STATE_DIM)
        whole, cross_covariance = solution.factor.marginals()
        covariance, cross_covariance = whole[:, motion, motion], cross_covariance[:, motion, motion]
        rows = slice(*solution.knot_index.searchsorted((kept.start, kept.stop)))
        displacement = None
        if setup_jacobian is not None:
            displacement = setup_displacement(
                solution, observations, mounting, setup_jacobian, mounting_factor
            )[kept, motion]
        return cls(
            solution.knots.select(kept),
            covariance[kept],
            cross_covariance[kept],
            solution.linearised.residuals_m[rows],
            solution.squared_distances[rows],
            solution.weights[rows],
            residual_variances(solution, observations, covariance)[rows],
            displacement,
            solution.gravity,
            float(np.sqrt(np.diag(solution.factor.shared_covariance)[:TILT_DIM].max())),
            _wheels(solution, whole, kept),
        )


def _with_large_slip(
    found: InertialSolution, observations: Observations, setup: InertialSetup
) -> InertialSolution:
    """Solve again where the wheels slip far more than configured, with as much noise of slip as that shows."""
    for _ in range(MAX_SLIP_SOLUTIONS):
        steps, slip = found.factors.odometry, found.knots.wheels[:, 1]
        assert steps is not None  # noqa: S101 (there is odometry)
        if np.abs(slip).max() < OUTLIER_THRESHOLD * steps.slip_sigma:
            break
        factors = replace(found.factors, odometry=steps.with_slip(slip))
        found = solve_inertial(observations, setup, found.knots, found.gravity, factors=factors)
    return found


def _wheels(solution: InertialSolution, covariance: FloatArray, kept: slice) -> WheelsFit | None:
    """Wheel odometry at the knots ``kept`` and on the steps after them; ``covariance``: (K, D, D) of all knots."""
    steps = solution.factors.odometry
    if steps is None:
        return None
    variances = np.diagonal(covariance, axis1=1, axis2=2)[kept, INERTIAL_STATE_DIM:]
    return WheelsFit(
        np.sqrt(variances), covered_steps(steps)[kept], rejected_steps(solution.knots, steps)[kept]
    )


def find_start(
    observations: Observations, setup: InertialSetup, gravity: Gravity
) -> tuple[InertialStates, Gravity]:
    """Find states where the measurements tell the heading, as early as they do.

    The layout is in the axes of the IMU, from the origin of the states. Raises GeometryError: nowhere.
    """
    time_s = observations.time_s
    begin_s, length_s = float(time_s[0]), FIRST_SEARCH_S
    best: HeadingSearch | None = None
    while True:
        rows = (time_s >= begin_s) & (time_s <= begin_s + length_s)
        if np.count_nonzero(rows) >= MIN_MEASUREMENTS:
            best = search_heading(observations.select(rows), setup, gravity)
            if best.determined:
                return best.solution.knots, best.solution.gravity
        if begin_s + length_s >= time_s[-1]:
            break
        if length_s < LONGEST_SEARCH_S:
            length_s *= 2.0
        else:
            begin_s += 0.5 * length_s
    if best is None:
        raise GeometryError(f"a start needs {MIN_MEASUREMENTS} measurements within {LONGEST_SEARCH_S:.0f} s")
    raise GeometryError(
        "the measurements do not tell the heading of the robot: with one station it must accelerate and turn"
    )


def extended(
    near: InertialStates, time_s: FloatArray, observations: Observations, setup: InertialSetup
) -> tuple[InertialStates, Preintegrated]:
    """Guess states at times, (K,), from others close to them, forwards and backwards, and the motions between them.

    The gyro turns the nearest of the others, and the tracks of the prisms place the states.
    """
    known = int(np.abs(near.time_s - 0.5 * (time_s[0] + time_s[-1])).argmin())
    known_s, gyro_bias, zero = near.time_s[known], near.gyro_bias[known], np.zeros(3)
    first = int(np.abs(time_s - known_s).argmin())
    ends_s = np.sort([known_s, time_s[first]])
    between = preintegrate(setup.samples, ends_s[:1], ends_s[1:], gyro_bias, zero).rotation[0]
    found = preintegrate(setup.samples, time_s[:-1], time_s[1:], gyro_bias, zero)
    rotation = np.empty((len(time_s), 3, 3))
    rotation[first] = near.rotation[known] @ (between if known_s <= time_s[first] else between.T)
    for step in range(first, len(time_s) - 1):
        rotation[step + 1] = rotation[step] @ found.rotation[step]
    for step in range(first - 1, -1, -1):
        rotation[step] = rotation[step + 1] @ found.rotation[step].T
    return states_on_tracks(observations, time_s, rotation, gyro_bias), found
