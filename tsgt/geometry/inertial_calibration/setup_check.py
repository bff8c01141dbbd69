"""Check of a configured IMU against the motion that stations measure: wrong mounting, latency, axes, units. Sans-I/O.

Gross errors, which no estimate survives, show in the rates and forces themselves. For the others the set-up is estimated as in a
calibration, and compared with the configured one: a cause is named if it is significant and large enough to harm, and ruled out if
the estimate is certain enough and near. One or two prisms do not tell a rotation of the robot about them: what they do not tell is
taken as configured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.inertial import Mounting, contiguous
from tsgt.geometry.inertial.states import TILT_DIM
from tsgt.geometry.inertial_calibration.alignment import (
    GRID_S,
    MIN_OVERLAP_S,
    UnrelatedRatesError,
    align,
    nearest_rotation,
    overlap_at,
    products_at,
    series_of_samples,
    series_of_states,
    series_of_trajectory,
    turns,
)
from tsgt.geometry.inertial_calibration.joint_solver import solve_jointly, states_of_imu
from tsgt.geometry.inertial_calibration.joint_system import stamp_times
from tsgt.geometry.inertial_calibration.setup import (
    LATENCY,
    POSITION,
    ROTATION,
    ImuSetup,
    SetupPrior,
    gyro_rotation,
)
from tsgt.geometry.rigid import log_so3

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.geometry.inertial import Gravity, InertialSamples
    from tsgt.geometry.inertial_calibration.alignment import Products, Series
    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory import Observations, States, Trajectory
    from tsgt.model import ImuNoise

Cause = Literal[
    "unit_of_rate", "unit_of_force", "gravity_sign", "axes", "rotation", "position", "latency", "unrelated"
]
"""``unrelated``: rates that are not the robot's at all."""

GROSS: frozenset[Cause] = frozenset({"unit_of_rate", "unit_of_force", "gravity_sign", "axes", "unrelated"})
"""Causes that rates and forces themselves show."""

MIN_TILT_RAD = math.radians(0.15)
"""Of a rotation about horizontal axes: gyro and gravity take most of it into the attitude, whatever the prisms say."""
MIN_ROTATION_RAD = math.radians(0.5)
MIN_POSITION_M = 0.05
MIN_LATENCY_S = 0.004
"""Errors below these harm less, as the prisms tell heading and position."""

MIN_SIGNIFICANCE = 5.0  # Sigmas, of three components together
EXCLUDED_SIGMAS = 2.0
CONFIRMED_LIMITS = 2.0
"""An error is ruled out if it is below the limits above with so many sigmas added. A set-up is confirmed if no error is found, and
each would be below so many of these limits.
"""

MIN_OVERLAP_SHARE = 0.6
"""Of the shorter series, as far as it is known, which the other one must overlap at the stamps and at any latency that is tried."""

FAST_RADPS = 1.0
"""Single turns that are faster are not compared: prisms that are measured twice a second do not tell them, and a robot that rolls
over hides its prisms.
"""

FAST_MARGIN_S = 1.0  # Before and after them: the trajectory of the stations is bent there
MAX_FAST_SHARE = 0.2  # Of a drive; above it the unit is wrong, or the robot turns like this

MIN_SHARED_S = 7.0  # In which both are known: a share of the shortest drive that is checked
MIN_CHECKED_MEASUREMENTS = 60  # Fewer do not tell the set-up
MIN_EXTENT_M = 0.05  # Between prisms that tell a rotation
MATRIX_SIGMA = 1e-2  # Of the matrices beside what is configured
MIN_RATE_FACTOR, MIN_FORCE_FACTOR = 2.0, 1.25
MAX_AXES_ERROR_RAD = math.radians(15.0)
MIN_GAIN = 25.0  # Half the decrease of the sum of squares by which other axes explain rates and forces better

RIGHT_ANGLED = [
    matrix
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
    if np.linalg.det(matrix := np.diag(signs)[:, order]) > 0
]
"""The 24 rotations that take axes to axes."""


@dataclass(frozen=True, slots=True)
class SetupFinding:
    """Something that is wrong in the configuration of an IMU."""

    cause: Cause
    size: float  # In rad, m, s, or a factor
    sigma: float  # One sigma of it; 0 where it is beyond doubt
    text: str


ALIGNED_S = 0.02
"""Latency by alignment, which is wrong by ten milliseconds, below which the joint estimation starts from the configured one: knots
that are right at once need not be chosen again.
"""


@dataclass(frozen=True, slots=True)
class SetupCheck:
    """What a drive says about the configuration of an IMU; nothing, if it does not tell."""

    findings: tuple[SetupFinding, ...] = ()
    excluded: frozenset[Cause] = frozenset()  # Causes that it rules out
    confirmed: bool = False
    """Whether it rules out all that harms: every cause, but for an error of the IMU's height, which flat ground does not tell."""


def check_imu_setup(
    observations: Observations,
    trajectory: Trajectory,
    samples: InertialSamples,
    mounting: Mounting,
    noise: ImuNoise,
    gravity: Gravity,
    *,
    on_iteration: Callable[[], None] = lambda: None,
) -> SetupCheck:
    """Compare a configured IMU with a drive of up to a minute.

    Takes a tenth of a second or two of computing.

    Parameters
    ----------
    observations : In the order of time, with the layout in the axes of the robot.
    trajectory : Of the robot at the reference point of the layout, from the stations alone.
    samples : Latency and gyro matrix as configured are applied.
    on_iteration : Called before each iteration of the joint estimation; with a GeometryError it ends without a finding.
    mounting : As configured, from that reference point.
    noise : Of the data sheet.
    """
    if not len(samples):
        return SetupCheck()
    robot, imu = series_of_trajectory(trajectory, gravity), _without_fast_turns(series_of_samples(samples))
    shorter_s = GRID_S * min(np.count_nonzero(each.known) for each in (robot, imu))
    ours, theirs = overlap_at(robot, imu, 0.0)
    if GRID_S * len(ours) < max(MIN_SHARED_S, MIN_OVERLAP_SHARE * shorter_s):
        return SetupCheck()  # the IMU was silent while the robot was measured, or the other way round
    shared = robot.select(ours)
    if not turns(shared):
        return SetupCheck()
    units = _wrong_units(shared, imu.select(theirs), gravity)
    if units:
        return SetupCheck(tuple(units))
    try:
        alignment = align(robot, imu, min_overlap_s=min(MIN_OVERLAP_S, MIN_OVERLAP_SHARE * shorter_s))
    except UnrelatedRatesError:
        text = "the angular rates of the IMU are not those of the robot at any latency: it is another robot's"
        return SetupCheck((SetupFinding("unrelated", 0.0, 0.0, text),))
    except GeometryError:  # a robot that turned while the IMU was heard may hardly have turned in all
        return SetupCheck()
    products = products_at(robot, imu, alignment.latency_s)
    gross = _wrong_axes(products, alignment.rotation, mounting.rotation)
    if gross is not None:
        return SetupCheck((gross,))
    right = abs(alignment.latency_s) < ALIGNED_S
    start = _Start(alignment.rotation, 0.0 if right else alignment.latency_s, alignment.gyro_bias)
    found = _estimated_errors(
        observations, trajectory.knots, samples, mounting, noise, gravity, start, on_iteration
    )
    return replace(found, excluded=found.excluded | GROSS)


def check_few_prisms(
    observations: Observations,
    states: States,
    gyro_bias: FloatArray,
    samples: InertialSamples,
    mounting: Mounting,
    noise: ImuNoise,
    gravity: Gravity,
    *,
    on_iteration: Callable[[], None] = lambda: None,
) -> SetupCheck:
    """Compare a configured IMU with measurements of one or two prisms, as :func:`check_imu_setup`.

    ``states``: with the IMU, whose axes and units are right therefore; ``gyro_bias``: (3,) of these.
    """
    if not turns(series_of_states(states, gravity)):
        return SetupCheck()
    start = _Start(mounting.rotation, 0.0, gyro_bias)
    found = _estimated_errors(observations, states, samples, mounting, noise, gravity, start, on_iteration)
    return replace(found, excluded=found.excluded | GROSS)


class _Start(NamedTuple):
    """Where the joint estimation starts."""

    rotation: FloatArray
    latency_s: float
    gyro_bias: FloatArray


def _without_fast_turns(imu: Series) -> Series:
    """Return rates and forces that are unknown around single fast turns."""
    fast = np.linalg.norm(imu.rate, axis=1) > FAST_RADPS
    margin = round(FAST_MARGIN_S / GRID_S)
    near = np.convolve(fast, np.ones(2 * margin + 1))[margin : margin + len(fast)] > 0.5
    if np.count_nonzero(near & imu.known) > MAX_FAST_SHARE * np.count_nonzero(imu.known):
        return imu
    return replace(imu, known=imu.known & ~near)


def _wrong_units(robot: Series, imu: Series, gravity: Gravity) -> list[SetupFinding]:
    """Find rates and forces that are all too large or too small."""
    findings = []
    turning, turned = (np.sqrt(np.var(each.rate[each.known], axis=0).sum()) for each in (robot, imu))
    factor = float(turned / turning)
    if not 1 / MIN_RATE_FACTOR < factor < MIN_RATE_FACTOR:
        unit = " (degrees per second instead of radians)" if 0.7 < factor * np.pi / 180 < 1.4 else ""
        text = f"the angular rates are {factor:.3g} times those of the robot: another unit{unit}"
        findings.append(SetupFinding("unit_of_rate", factor, 0.0, text))
    factor = float(np.median(np.linalg.norm(imu.force[imu.known], axis=1))) / gravity.magnitude_mps2
    if not 1 / MIN_FORCE_FACTOR < factor < MIN_FORCE_FACTOR:
        unit = " (g instead of m/s^2)" if 0.9 < factor * gravity.magnitude_mps2 < 1.1 else ""
        text = f"the specific force is {factor:.3g} times gravity: another unit{unit}"
        findings.append(SetupFinding("unit_of_force", factor, 0.0, text))
    return findings


def _wrong_axes(products: Products, aligned: FloatArray, configured: FloatArray) -> SetupFinding | None:
    """Find forces of the wrong sign, left-handed axes, or axes in the wrong order."""

    def agreement(rotation: FloatArray, sign: float = 1.0) -> float:
        """Half the decrease of the sum of squares against no agreement."""
        return float(np.vdot(rotation, products.rates + sign * products.forces))

    inverted = nearest_rotation(products.rates - products.forces)
    if agreement(inverted, -1.0) - agreement(aligned) > MIN_GAIN:
        text = "the specific force has the wrong sign: at rest it must point up, against gravity"
        return SetupFinding("gravity_sign", -1.0, 0.0, text)
    total = products.rates + products.forces
    if np.linalg.det(total) < 0 and np.linalg.svd(total, compute_uv=False)[2] > MIN_GAIN:
        text = "the axes of the IMU are left-handed: two of them are exchanged, or one is inverted"
        return SetupFinding("axes", 0.0, 0.0, text)
    wrong = configured.T @ aligned  # Takes true axes of the IMU to those that the configuration means
    nearest = max(RIGHT_ANGLED, key=lambda each: float(np.vdot(each, wrong)))
    error_rad = float(np.linalg.norm(log_so3(nearest.T @ wrong)))
    if np.trace(nearest) > 2 or error_rad > MAX_AXES_ERROR_RAD:
        return None
    if agreement(aligned) - agreement(configured) < MIN_GAIN:
        return None
    names = ", ".join(
        f"its {'xyz'[column]} is the configured {'-' if nearest[row, column] < 0 else ''}{'xyz'[row]}"
        for column in range(3)
        for row in range(3)
        if nearest[row, column]
    )
    size = float(np.linalg.norm(log_so3(nearest)))
    return SetupFinding("axes", size, error_rad, f"the axes of the IMU are swapped: {names}")


def _estimated_errors(
    observations: Observations,
    states: States,
    samples: InertialSamples,
    mounting: Mounting,
    noise: ImuNoise,
    gravity: Gravity,
    start: _Start,
    on_iteration: Callable[[], None],
) -> SetupCheck:
    """Find errors of mounting and latency by joint estimation."""
    filled = contiguous(samples, noise)
    count = int(observations.station.max()) + 1
    configured = ImuSetup.initial(mounting, 0.0, count)
    near = replace(
        configured, mounting=Mounting(start.rotation, mounting.position), latency_s=start.latency_s
    )
    stamps_s = stamp_times(observations, near)
    measured = observations.select((stamps_s > filled.bounds_s[0]) & (stamps_s < filled.bounds_s[-1]))
    if len(measured) < MIN_CHECKED_MEASUREMENTS:
        return SetupCheck()
    try:
        solution = solve_jointly(
            measured,
            filled,
            noise,
            lambda times_s, setup: states_of_imu(states, times_s, setup, start.gyro_bias),
            SetupPrior.wide(configured, MATRIX_SIGMA),
            gravity,
            start=near,
            on_iteration=on_iteration,
        )
    except GeometryError:
        return SetupCheck()
    error = solution.point.setup.local_coordinates_about(configured)
    covariance = solution.factor.shared_covariance[TILT_DIM:, TILT_DIM:]
    axes = _unseen_rotations(observations.layout) @ mounting.rotation
    if len(axes):
        unseen = np.zeros((len(axes), len(error)))
        unseen[:, ROTATION] = axes
        gain = covariance @ unseen.T @ np.linalg.inv(unseen @ covariance @ unseen.T)
        error, covariance = error - gain @ unseen @ error, covariance - gain @ unseen @ covariance
    # The axes that are configured are the gyro's: the accelerometer's may be turned against them in the case.
    identity = np.eye(len(error))
    rotation = gyro_rotation(solution.point.setup)
    up = mounting.rotation.T @ _up(states)
    tilt = (np.eye(3) - np.outer(up, up)) @ rotation
    # What one or two prisms tell of a tilt has errors of a consumer accelerometer's axes in it.
    tilts = () if len(axes) else (tilt,)
    parts: tuple[tuple[Cause, FloatArray, float], ...] = (
        ("rotation", rotation, MIN_ROTATION_RAD),
        *(("rotation", tilt, MIN_TILT_RAD) for tilt in tilts),
        ("position", identity[POSITION], MIN_POSITION_M),
        ("latency", identity[LATENCY : LATENCY + 1], MIN_LATENCY_S),
    )

    def bound(jacobian: FloatArray) -> float:
        return certain_bound(jacobian @ error, jacobian @ covariance @ jacobian.T)

    findings: list[SetupFinding] = []
    excluded: set[Cause] = {cause for cause, _, _ in parts}
    excluded -= {cause for cause, jacobian, limit in parts if bound(jacobian) >= limit}
    for cause, jacobian, limit in parts:
        if cause in (each.cause for each in findings):
            continue
        part, own = jacobian @ error, jacobian @ covariance @ jacobian.T
        size = float(np.linalg.norm(part))
        if (
            size < limit
            or part @ np.linalg.pinv(own, rcond=1e-9, hermitian=True) @ part < MIN_SIGNIFICANCE**2
        ):
            continue
        sigma = float(np.sqrt(part @ own @ part)) / size
        findings.append(SetupFinding(cause, size, sigma, _describe(cause, part, sigma, mounting)))
        excluded.discard(cause)
    bounds = (
        # The accelerometer tells the rotation about the vertical sooner than the gyro.
        min(bound(rotation), bound(identity[ROTATION])) / MIN_ROTATION_RAD,
        *(bound(tilt) / MIN_TILT_RAD for tilt in tilts),
        bound(identity[POSITION][:2]) / MIN_POSITION_M,
        bound(identity[LATENCY : LATENCY + 1]) / MIN_LATENCY_S,
    )
    confirmed = not findings and max(bounds) < CONFIRMED_LIMITS
    return SetupCheck(tuple(findings), frozenset(excluded), confirmed)


def _up(states: States) -> FloatArray:
    """Return the mean direction of up in the axes of the robot, (3,)."""
    up = states.rotation[:, 2, :].mean(axis=0)
    return np.asarray(up / np.linalg.norm(up))


def certain_bound(error: FloatArray, covariance: FloatArray) -> float:
    """Return what the norm of an error is below for certain.

    What nothing tells is taken as configured: its covariance is zero up to rounding, of either sign.
    """
    variance = max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0)
    return float(np.linalg.norm(error)) + EXCLUDED_SIGMAS * math.sqrt(variance)


def _unseen_rotations(layout: FloatArray) -> FloatArray:
    """(K, 3) axes about which prisms, (M, 3) as they were measured, do not tell a rotation."""
    prisms = np.unique(layout, axis=0)
    _, sizes, axes = np.linalg.svd(prisms - prisms[0])
    seen = int(np.count_nonzero(sizes > MIN_EXTENT_M))
    return np.asarray(axes[: (3, 1, 0, 0)[seen]])


def _describe(cause: Cause, error: FloatArray, sigma: float, mounting: Mounting) -> str:
    if cause == "rotation":
        x, y, z = np.degrees(mounting.rotation @ error)
        size_deg, sigma_deg = np.degrees(np.linalg.norm(error)), np.degrees(sigma)
        return (
            f"the mounting of the IMU is wrong by {size_deg:.2f} deg (sigma {sigma_deg:.2f}): it is turned about the axes "
            f"of the robot by {x:+.2f}, {y:+.2f}, {z:+.2f} deg more"
        )
    if cause == "position":
        x, y, z = 1e3 * error
        return (
            f"the position of the IMU is wrong by {1e3 * np.linalg.norm(error):.0f} mm (sigma {1e3 * sigma:.0f}): it is "
            f"{x:+.0f}, {y:+.0f}, {z:+.0f} mm farther along the axes of the robot"
        )
    return (
        f"the latency of the IMU is wrong: its stamps are {1e3 * float(error[0]):+.1f} ms later than configured "
        f"(sigma {1e3 * sigma:.1f})"
    )
