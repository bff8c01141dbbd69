"""Trajectory of a whole recording with an IMU, from measurements of three, two or one stations. Sans-I/O.

The search over headings starts the trajectory where the measurements tell the heading. From there the gyro, whose bias is known
by then, carries the rotation to the next segment, and the prisms' tracks give its positions: with the rotation known, the rest
is nearly linear. Segments overlap and are solved one after the other, which bounds the memory for the equations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.inertial.factors import InertialFactors
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
    report_progress = on_progress or (lambda _: None)
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
    wheels = None if odometry is None else Odometry.of(*odometry, of_states, reference_m)
    prior = Gravity.of(imu)
    if gyro_only is None:
        prior = prior.with_matrix(imu.noise.accelerometer_scale_misalignment, mounting.rotation[2])
    near, gravity = find_start(mounted, setup, prior)
    count = max(round(float(time_s[-1] - time_s[0]) / SEGMENT_S), 1)
    edges_s = np.linspace(time_s[0], time_s[-1], count + 1)
    ends = [0, *time_s.searchsorted(edges_s[1:-1]).tolist(), len(time_s)]
    knot_index = nearest_knots(time_s, mounted.time_s)

    def solve(
        start_s: float, end_s: float, near: InertialStates | None, guess: InertialStates | None = None
    ) -> tuple[InertialSolution, Observations, int]:
        """Solve a stretch from states close to it, or from a guess of all states."""
        solved = slice(*time_s.searchsorted((start_s, np.nextafter(end_s, np.inf))))
        rows = slice(*knot_index.searchsorted((solved.start, solved.stop)))
        some = mounted.select(rows)
        preintegrated = None
        if guess is not None:
            guess = guess.select(solved)
        else:
            assert near is not None  # noqa: S101 (one of both)
            guess, preintegrated = extended(near, time_s[solved], some, setup)
            if wheels is not None:
                guess = guess.with_wheels()
        factors = InertialFactors.between(
            setup.samples,
            guess.select(slice(None, -1)),
            guess.time_s[1:],
            noise,
            gyro_only=gyro_only,
            odometry=wheels,
            found=preintegrated,
        )
        found = solve_inertial(some, replace(setup, odometry=wheels), guess, gravity, factors=factors)
        if wheels is not None:
            found = _with_large_slip(found, some, replace(setup, odometry=wheels))
        return found, some, solved.start

    first = int(np.clip(edges_s.searchsorted(near.time_s[0], side="right") - 1, 0, count - 1))
    whole: tuple[InertialSolution, Observations, int] | None = None
    while whole is None and (length_s := near.time_s[-1] - near.time_s[0]) * START_GROWTH < SEGMENT_S:
        margin_s = 0.5 * (START_GROWTH - 1.0) * length_s
        grown = solve(near.time_s[0] - margin_s, near.time_s[-1] + margin_s, near)
        near = grown[0].knots
        if len(near) == len(time_s):
            whole = grown
    parts: dict[int, _Part] = {}
    for number in [*range(first, count), *range(first - 1, -1, -1)]:
        report_progress(len(parts) / count)
        if parts:
            near = parts[number - 1 if number > first else number + 1].knots
        ends_s = edges_s[number] - OVERLAP_S, edges_s[number + 1] + OVERLAP_S
        solution, some, offset = whole if whole is not None else solve(*ends_s, near)
        kept = slice(ends[number] - offset, ends[number + 1] - offset)
        parts[number] = _Part.of(solution, some, kept, of_states, setup_jacobian, mounting_factor)
    ordered = [parts[number] for number in range(count)]
    if count > 1 and len(np.unique(mounted.prism)) == 1:
        ordered = []
        guess = concatenate_inertial_states([parts[number].knots for number in range(count)])
        for begin in range(0, count, ALONE_SEGMENTS):
            end = min(begin + ALONE_SEGMENTS, count)
            margins_s = edges_s[begin] - SEGMENT_S, edges_s[end] + SEGMENT_S
            solution, some, offset = solve(*margins_s, None, guess)
            kept = slice(ends[begin] - offset, ends[end] - offset)
            ordered.append(_Part.of(solution, some, kept, of_states, setup_jacobian, mounting_factor))
    report_progress(1.0)
    middle = ordered[len(ordered) // 2]
    trajectory = InertialTrajectory(
        concatenate_inertial_states([part.knots for part in ordered]),
        middle.gravity,
        setup.samples,
        of_states,
        np.concatenate([part.covariance for part in ordered]),
        np.concatenate([part.cross_covariance for part in ordered])[: len(time_s) - 1],
        gyro_only,
        None
        if setup_jacobian is None
        else np.concatenate([part.displacement for part in ordered if part.displacement is not None]),
        mounting_factor,
    )
    return InertialFit(
        trajectory,
        observations,
        np.concatenate([part.residuals_m for part in ordered]),
        np.concatenate([part.squared_distances for part in ordered]),
        np.concatenate([part.weights for part in ordered]),
        np.concatenate([part.residual_variances_m2 for part in ordered]),
        max(part.tilt_sigma_rad for part in ordered),
        None
        if wheels is None
        else WheelsFit(
            np.concatenate([part.wheels.sigmas for part in ordered if part.wheels]),
            np.concatenate([part.wheels.covered for part in ordered if part.wheels]),
            np.concatenate([part.wheels.rejected for part in ordered if part.wheels]),
        ),
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
