"""Peers of the estimators on the same measurements: gtsam's batch smoother, splines, the paper's linear interpolation.

    python benchmarks/run.py peers [--duration 120] [--seeds 1] [--scenarios dynamic quarry ...]

It needs gtsam: `pip install --requirement benchmarks/poses/peers.txt`, in an environment of its own that also has tsgt. Each row is one
estimator on one scenario: RMS error of the position at the robot's origin and of the rotation, at 5 Hz from the first to the last
measurement, once everywhere and once while each prism's measurements before and after are at most 1 s apart; the share of the
epochs that has a pose; mean NEES of the six components, 6 if the stated covariance is right; CPU time by minute of data. The
set-up is exact, and the missions have the scenarios' own occlusions, over the superframe.

`linear`: linear interpolation of each prism and a rigid fit of the layout, the paper's method. Cubic spline: an interpolating one
through the points of each prism, and a rigid fit. Quintic spline: one for position, roll, pitch and yaw, a knot each 0.5 s, least
squares on all points, weakly smoothed. gtsam: a state at each measurement and epoch, factors in Python, Levenberg-Marquardt,
Cauchy loss; white acceleration or white jerk, with the densities of the motion prior that `continuous` tuned, whose cost counts there
alone.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import sys
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from measuring import Stopwatch, normalised_squared, simulated
from scipy.interpolate import BSpline, CubicSpline
from scipy.sparse import csr_array, diags_array, kron, vstack
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from tsgt.estimation import LinearEstimator, build_observations, centroid_m
from tsgt.geometry import exp_so3, log_so3, poses_from_prisms, rotation_from_quaternion, skew
from tsgt.geometry.batch import fit_trajectory
from tsgt.geometry.rigid import inverse_right_jacobian
from tsgt.geometry.trajectory import line_of_sight_axes, ros_covariance, state_at_point
from tsgt.simulation.options import SimulationOptions
from tsgt.simulation.scenario_files import find_scenario

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray
    from tsgt.geometry.trajectory import Observations
    from tsgt.model import Measurement, MotionPrior, Parameters

SCENARIOS = ("static", "dynamic", "quarry", "ski-trail", "snowmobile")
EPOCH_S = 0.2
TRACKED_S = 1.0
SPLINE_KNOT_S, SPLINE_DEGREE = 0.5, 5
SPLINE_JERK_SIGMA = 30.0  # m/s^3 and rad/s^3, so weak that it matters in gaps alone
CAUCHY = 4.0  # Sigmas
MAX_ITERATIONS = 30  # Of gtsam, which takes seconds for each where its equations are nearly singular
MIN_STEP_DIGITS = 3  # States of gtsam at full ms: the motion within half of one is below the noise
NEAR_S = 0.005  # Epochs this close to a state of gtsam have none of their own


class Problem(NamedTuple):
    """Measurements of one mission, and the epochs at which poses are asked for."""

    parameters: Parameters
    measurements: list[Measurement]
    observations: Observations
    epochs_s: FloatArray
    origin_ns: int
    prior: MotionPrior
    noise_scales: FloatArray

    @property
    def arm_m(self) -> FloatArray:
        """From the prisms' centroid, which the states are of, to the robot's origin."""
        return -centroid_m(self.parameters)


class Poses(NamedTuple):
    """Poses of the robot's origin at the epochs; NaN where there are none."""

    position: FloatArray  # (N, 3)
    rotation: FloatArray  # (N, 3, 3)
    covariance: FloatArray | None = None  # (N, 6, 6) in ROS order


def continuous(problem: Problem) -> Poses:
    """Fit the batch estimator, hyperparameters and all."""
    trajectory = fit_trajectory(problem.observations).trajectory
    states, covariance = trajectory.at(problem.epochs_s, dim=6)
    states, covariance = state_at_point(states, covariance, problem.arm_m)
    return Poses(states.position, states.rotation, ros_covariance(states.rotation, covariance))


def linear(problem: Problem) -> Poses:
    """Run the live estimator `linear` on the sorted measurements."""
    estimator = LinearEstimator(problem.parameters)
    for measurement in sorted(problem.measurements, key=lambda m: m.stamp_ns):
        estimator.add(measurement)
    batch = estimator.advance(max(m.stamp_ns for m in problem.measurements) + 10_000_000_000)
    rows = np.searchsorted(
        batch.stamp_ns, np.rint(problem.origin_ns + 1e9 * problem.epochs_s).astype(np.int64) - 1000
    )
    rows = np.minimum(rows, len(batch) - 1)
    at_ns = batch.stamp_ns[rows] - problem.origin_ns
    known = batch.valid[rows] & (np.abs(at_ns - 1e9 * problem.epochs_s) < 1e4)
    rotation = np.full((len(rows), 3, 3), np.nan)
    rotation[known] = rotation_from_quaternion(batch.orientation_xyzw[rows[known]])
    position = np.where(known[:, None], batch.position_m[rows], np.nan)
    return Poses(position, rotation, batch.covariance[rows])


def cubic_splines(problem: Problem) -> Poses:
    """Each prism's points interpolated, then the layout fitted."""
    points, some = problem.observations.in_world(), problem.observations
    tracks = []
    for prism in range(len(some.layout)):
        times_s, first = np.unique(some.time_s[some.prism == prism], return_index=True)
        tracks.append(CubicSpline(times_s, points[some.prism == prism][first])(problem.epochs_s))
    found = poses_from_prisms(some.layout, np.stack(tracks, axis=1))
    position = found.translation_m + found.rotation @ problem.arm_m
    return Poses(position, found.rotation)


def _euler(angles: FloatArray) -> FloatArray:
    return Rotation.from_euler("xyz", angles).as_matrix()


def quintic_spline(problem: Problem) -> Poses:
    """One spline for position and angles through all prisms, by Gauss-Newton from the cubic splines' poses."""
    some = problem.observations
    start_s, end_s = some.time_s[0], some.time_s[-1]
    inner = np.linspace(start_s, end_s, max(int((end_s - start_s) / SPLINE_KNOT_S), 2))
    step_s = inner[1] - inner[0]
    outer = step_s * np.arange(1, SPLINE_DEGREE + 1)
    knots = np.concatenate([inner[0] - outer[::-1], inner, inner[-1] + outer])
    basis = csr_array(BSpline.design_matrix(some.time_s, knots, SPLINE_DEGREE))
    count = basis.shape[1]
    third = diags_array([-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(count - 3, count)) / step_s**3
    smooth = kron(third, np.eye(6), format="csr") / SPLINE_JERK_SIGMA * np.sqrt(step_s)
    begun = cubic_splines(problem)
    angles = np.unwrap(Rotation.from_matrix(begun.rotation).as_euler("xyz"), axis=0)
    poses = np.column_stack([begun.position - begun.rotation @ problem.arm_m, angles])
    at_epochs = csr_array(
        BSpline.design_matrix(np.clip(problem.epochs_s, start_s, end_s), knots, SPLINE_DEGREE)
    )
    regular = 1e-3 * (third.T @ third).tocsr() * step_s**6 + 1e-9 * diags_array(np.ones(count))
    unknowns = np.stack(
        [spsolve((at_epochs.T @ at_epochs + regular).tocsc(), at_epochs.T @ column) for column in poses.T],
        axis=1,
    )
    levers, points, roots = some.layout[some.prism], some.in_world(), _whitening(problem)
    columns = kron(basis, np.eye(6), format="csr")
    for _ in range(8):
        at = basis @ unknowns
        rotation = _euler(at[:, 3:])
        residuals = at[:, :3] + (rotation @ levers[:, :, None])[:, :, 0] - points
        jacobian = np.empty((len(at), 3, 6))
        jacobian[:, :, :3] = np.eye(3)
        for axis in range(3):
            nudged = at[:, 3:] + 1e-6 * np.eye(3)[axis]
            jacobian[:, :, 3 + axis] = ((_euler(nudged) - rotation) @ levers[:, :, None])[:, :, 0] / 1e-6
        whitened, right = roots @ jacobian, (roots @ residuals[:, :, None])[:, :, 0]
        rows = np.repeat(np.arange(3 * len(at)), 6)
        cells = (6 * np.arange(len(at))[:, None] + np.arange(6))[:, None, :].repeat(3, axis=1)
        by_pose = csr_array((whitened.ravel(), (rows, cells.ravel())), shape=(3 * len(at), 6 * len(at)))
        whole = vstack([by_pose @ columns, smooth], format="csr")
        error = np.concatenate([right.ravel(), smooth @ unknowns.ravel()])
        step = spsolve((whole.T @ whole).tocsc(), -(whole.T @ error))
        unknowns = unknowns + step.reshape(-1, 6)
        if np.abs(step).max() < 1e-6:
            break
    at = at_epochs @ unknowns
    rotation = _euler(at[:, 3:])
    return Poses(at[:, :3] + rotation @ problem.arm_m, rotation)


def _whitening(problem: Problem) -> FloatArray:
    """(M, 3, 3) roots of the information of points in the world, with the noise that `continuous` found."""
    some = problem.observations
    axes, _ = line_of_sight_axes(some.points_m)
    sigmas_m = some.sigmas_m * problem.noise_scales[some.station]
    to_station = np.swapaxes(some.frames[some.station][:, :3, :3], 1, 2)
    return np.asarray((axes @ to_station) / sigmas_m[:, :, None])


class _Graph:
    """States of gtsam: position, rotation, velocities and, for white jerk, accelerations."""

    def __init__(self, problem: Problem, *, jerk: bool) -> None:
        gtsam: Any = importlib.import_module("gtsam")
        self._gtsam, self._jerk = gtsam, jerk
        self._size = 12 if jerk else 6  # Of velocities and accelerations, each linear and angular
        prior = problem.prior
        times_s = np.repeat(
            [prior.acceleration_correlation_time_s, prior.angular_acceleration_correlation_time_s], 3
        )
        variances = np.array([*prior.acceleration_sigma_mps2, *prior.angular_acceleration_sigma_radps2]) ** 2
        self._density = 2.0 * variances / times_s if jerk else 2.0 * variances * times_s

    def position(self, row: int) -> int:
        return int(self._gtsam.symbol("p", row))

    def rotation(self, row: int) -> int:
        return int(self._gtsam.symbol("r", row))

    def rates(self, row: int) -> int:
        return int(self._gtsam.symbol("v", row))

    def motion_factor(self, row: int, dt_s: float) -> object:
        """Between two successive states: later minus propagated, by axis, rotation as a rotation vector."""
        gtsam, jerk, size = self._gtsam, self._jerk, self._size
        keys = [f(i) for i in (row, row + 1) for f in (self.position, self.rotation, self.rates)]
        powers = np.array([dt_s**k for k in range(6)])
        if jerk:
            q = np.array([
                [powers[5] / 20, powers[4] / 8, powers[3] / 6],
                [powers[4] / 8, powers[3] / 3, powers[2] / 2],
                [powers[3] / 6, powers[2] / 2, powers[1]],
            ])  # fmt: skip
        else:
            q = np.array([[powers[3] / 3, powers[2] / 2], [powers[2] / 2, powers[1]]])
        noise = gtsam.noiseModel.Gaussian.Covariance(np.kron(q, np.diag(self._density)))
        blocks = size // 6
        # Errors of position and rotation, then of velocities, then of accelerations: linear in the rates.
        earlier, later = np.zeros((6 + size, size)), np.zeros((6 + size, size))
        for order in range(blocks):
            earlier[:6, 6 * order : 6 * order + 6] = -np.eye(6) * powers[order + 1] / (1, 2)[order]
            later[6 + 6 * order : 12 + 6 * order, 6 * order : 6 * order + 6] = np.eye(6)
            for below in range(order, blocks):
                earlier[6 + 6 * order : 12 + 6 * order, 6 * below : 6 * below + 6] = (
                    -np.eye(6) * powers[below - order]
                )

        def error(_: object, values: Any, jacobians: list[FloatArray] | None) -> FloatArray:
            p0, r0, v0, p1, r1, v1 = self.values(values, row)
            turned = log_so3((r0.T @ r1)[None])[0]
            found = earlier @ v0 + later @ v1
            found[:3] += p1 - p0
            found[3:6] += turned
            if jacobians is not None:
                by_rotation = inverse_right_jacobian(turned[None])[0]
                at_position, at_rotation = np.zeros((6 + size, 3)), np.zeros((6 + size, 3))
                at_position[:3] = np.eye(3)
                jacobians[0], jacobians[3] = -at_position, at_position
                jacobians[1] = at_rotation.copy()
                jacobians[1][3:6] = -by_rotation.T
                at_rotation[3:6] = by_rotation
                jacobians[2], jacobians[4], jacobians[5] = earlier, at_rotation, later
            return found

        return gtsam.CustomFactor(noise, keys, error)

    def values(self, values: Any, row: int) -> tuple[FloatArray, ...]:
        """Return position, rotation matrix and rates of two successive states."""
        return tuple(
            each
            for i in (row, row + 1)
            for each in (
                values.atVector(self.position(i)),
                values.atRot3(self.rotation(i)).matrix(),
                values.atVector(self.rates(i)),
            )
        )

    def point_factor(self, row: int, point: FloatArray, lever: FloatArray, root: FloatArray) -> object:
        """Compare a prism's point in the world, whitened, with a robust loss."""
        gtsam = self._gtsam
        noise = gtsam.noiseModel.Robust.Create(
            gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY), gtsam.noiseModel.Unit.Create(3)
        )
        position, rotation = self.position(row), self.rotation(row)
        crossed = skew(lever[None])[0]

        def error(_: object, values: Any, jacobians: list[FloatArray] | None) -> FloatArray:
            R = values.atRot3(rotation).matrix()
            if jacobians is not None:
                jacobians[0], jacobians[1] = root, -root @ R @ crossed
            return np.asarray(root @ (values.atVector(position) + R @ lever - point))

        return gtsam.CustomFactor(noise, [position, rotation], error)

    def solve(self, problem: Problem) -> Poses:
        """Return smoothed poses with covariances."""
        gtsam, some = self._gtsam, problem.observations
        # States closer than that are too close to be told apart by their process noise.
        times_s = np.unique(np.round(some.time_s, MIN_STEP_DIGITS))
        times_s = np.unique(
            np.concatenate([times_s, [t for t in problem.epochs_s if np.abs(times_s - t).min() > NEAR_S]])
        )
        begun = cubic_splines(problem._replace(epochs_s=times_s))
        graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
        centres = begun.position - begun.rotation @ problem.arm_m
        velocity = np.gradient(centres, times_s, axis=0)
        turns = (
            log_so3(np.swapaxes(begun.rotation[:-1], 1, 2) @ begun.rotation[1:]) / np.diff(times_s)[:, None]
        )
        for row in range(len(times_s)):
            rates = np.zeros(self._size)
            rates[:3], rates[3:6] = velocity[row], turns[min(row, len(turns) - 1)]
            initial.insert(self.position(row), centres[row])
            initial.insert(self.rotation(row), gtsam.Rot3(begun.rotation[row]))
            initial.insert(self.rates(row), rates)
        for row, dt_s in enumerate(np.diff(times_s).tolist()):
            graph.add(self.motion_factor(row, dt_s))
        roots, points = _whitening(problem), some.in_world()
        for i, row in enumerate(_nearest(times_s, some.time_s).tolist()):
            graph.add(self.point_factor(row, points[i], some.layout[some.prism[i]], roots[i]))
        loose = gtsam.noiseModel.Isotropic.Sigma(self._size, 10.0)
        graph.add(gtsam.PriorFactorVector(self.rates(0), np.zeros(self._size), loose))
        limits = gtsam.LevenbergMarquardtParams()
        limits.setMaxIterations(MAX_ITERATIONS)
        found = gtsam.LevenbergMarquardtOptimizer(graph, initial, limits).optimize()
        marginals = gtsam.Marginals(graph, found)
        positions, rotations, covariances = [], [], []
        near = _nearest(times_s, problem.epochs_s)
        for row, after_s in zip(near.tolist(), (problem.epochs_s - times_s[near]).tolist(), strict=True):
            keys = [self.position(row), self.rotation(row)]
            joint = marginals.jointMarginalCovariance(keys)
            rates = found.atVector(self.rates(row))
            position = found.atVector(keys[0]) + after_s * rates[:3]
            R = found.atRot3(keys[1]).matrix() @ exp_so3(after_s * rates[None, 3:6])[0]
            blocks = np.block([[joint.at(a, b) for b in keys] for a in keys])
            to_origin = np.eye(6)
            to_origin[:3, 3:] = -R @ skew(problem.arm_m[None])[0]
            to_origin[3:, 3:] = R
            covariances.append(to_origin @ blocks @ to_origin.T)
            positions.append(position + R @ problem.arm_m)
            rotations.append(R)
        return Poses(np.array(positions), np.array(rotations), np.array(covariances))


def _nearest(times_s: FloatArray, asked_s: FloatArray) -> NDArray[np.intp]:
    """(N,) index of the nearest time."""
    after = np.clip(np.searchsorted(times_s, asked_s), 1, len(times_s) - 1)
    return after - (asked_s - times_s[after - 1] < times_s[after] - asked_s)


def gtsam_white_acceleration(problem: Problem) -> Poses:
    """Smoother of gtsam with constant velocity."""
    return _Graph(problem, jerk=False).solve(problem)


def gtsam_white_jerk(problem: Problem) -> Poses:
    """Smoother of gtsam with constant acceleration."""
    return _Graph(problem, jerk=True).solve(problem)


PEERS: dict[str, Callable[[Problem], Poses]] = {
    "`continuous`": continuous,
    "gtsam, white jerk": gtsam_white_jerk,
    "gtsam, white acceleration": gtsam_white_acceleration,
    "quintic spline": quintic_spline,
    "cubic spline by prism": cubic_splines,
    "`linear`": linear,
}


def drawn(scenario: str, duration_s: float, seed: int) -> tuple[Problem, FloatArray]:
    """Simulate a mission; return its problem, and the true poses, (N, 4, 4)."""
    options = SimulationOptions(duration_s=duration_s, seed=seed)
    with simulated(find_scenario(scenario), options) as result:
        measurements: list[Measurement] = [m for log in result.master_logs for m in log.measurements]
        origin_ns = result.start_ns
        observations, _ = build_observations(result.parameters, measurements, origin_ns=origin_ns)
        period_ns = round(1e9 * EPOCH_S)
        first, last = (origin_ns + round(1e9 * observations.time_s[row]) for row in (0, -1))
        epochs_ns = np.arange(-(-first // period_ns) + 1, last // period_ns) * period_ns
        epochs_s = (epochs_ns - origin_ns) / 1e9
        fit = fit_trajectory(observations)
        problem = Problem(
            result.parameters, measurements, observations, epochs_s, origin_ns, fit.prior, fit.noise_scales
        )
        return problem, result.true_poses(epochs_s)


def tracked(problem: Problem) -> np.ndarray:
    """(N,) whether each prism was measured shortly before and after an epoch."""
    some, good = problem.observations, np.ones(len(problem.epochs_s), np.bool_)
    for prism in range(len(some.layout)):
        own_s = np.concatenate([[-np.inf], some.time_s[some.prism == prism], [np.inf]])
        after = np.searchsorted(own_s, problem.epochs_s)
        good &= own_s[after] - own_s[after - 1] <= TRACKED_S
    return good


def row_of(name: str, found: list[tuple[Poses, float, Problem, FloatArray]], duration_s: float) -> str:
    """Return the cells of one estimator over the seeds."""
    squares, nees, near = [], [], []
    for poses, _, problem, truth in found:
        error = np.column_stack([
            poses.position - truth[:, :3, 3],
            log_so3(np.nan_to_num(poses.rotation @ np.swapaxes(truth[:, :3, :3], 1, 2), nan=0.0) + _identity(poses)),
        ])  # fmt: skip
        error[~np.isfinite(poses.position[:, 0])] = np.nan
        squares.append(error**2)
        near.append(tracked(problem))
        if poses.covariance is not None:
            known = np.isfinite(error).all(axis=1) & np.isfinite(poses.covariance).all(axis=(1, 2))
            nees.append(normalised_squared(error[known], poses.covariance[known]))
    square, here = np.concatenate(squares), np.concatenate(near)

    def rms(rows: np.ndarray) -> str:
        some = square[rows]
        position_mm = 1e3 * np.sqrt(np.nanmean(some[:, :3].sum(axis=1)))
        return f"{position_mm:.2f} mm, {np.degrees(np.sqrt(np.nanmean(some[:, 3:].sum(axis=1)))):.3f}°"

    share = np.mean(np.isfinite(square[:, 0]))
    cpu_s = sum(each[1] for each in found) / len(found) * 60.0 / duration_s
    stated = f"{np.mean(np.concatenate(nees)):.1f}" if nees else "none stated"
    return (
        f"| {name} | {rms(np.ones(len(here), bool))} | {rms(here)} | {share:.0%} | {stated} | {cpu_s:.2f} |"
    )


def _identity(poses: Poses) -> FloatArray:
    """(N, 3, 3) the identity where there is no pose, so that logarithms are finite."""
    return np.where(np.isfinite(poses.position[:, :1, None]), 0.0, np.eye(3))


def main() -> None:
    """Print a table per scenario."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--duration", type=float, default=120.0, help="seconds")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--scenarios", nargs="+", default=SCENARIOS)
    parser.add_argument("--without-gtsam", action="store_true", help="the others alone")
    arguments = parser.parse_args()
    peers = dict(PEERS)
    if arguments.without_gtsam:
        peers = {name: each for name, each in PEERS.items() if not name.startswith("gtsam")}
    elif importlib.util.find_spec("gtsam") is None:
        sys.exit(
            "gtsam is not installed: pip install --requirement benchmarks/poses/peers.txt, or give --without-gtsam"
        )
    for scenario in arguments.scenarios:
        problems = [drawn(scenario, arguments.duration, seed) for seed in range(1, arguments.seeds + 1)]
        print(f"\n| {scenario} | everywhere | all prisms tracked | poses | NEES | CPU s per minute |")
        print("|---|---|---|---|---|---|")
        for name, peer in peers.items():
            found = []
            try:
                for problem, truth in problems:
                    with Stopwatch() as stopwatch:
                        poses = peer(problem)
                    found.append((poses, stopwatch.cpu_s, problem, truth))
            except RuntimeError as error:
                print(f"| {name} | no solution: {' '.join(str(error).split())[:60]} | | | | |", flush=True)
                continue
            print(row_of(name, found, arguments.duration), flush=True)
