"""Accuracy of the joint fit of `tsgt compare`: simulated estimates with unknown clock, extrinsic and frame.

    python benchmarks/run.py compare [--scenarios dynamic quarry ski-trail] [--kinds lidar visual-inertial gnss]
        [--seeds 100] [--first 0] [--duration 300] [--evo 0] [--json FILE] [--read FILE...]
        [--mission POSES TRUTH]

The reference has poses at 20 Hz and errors like those of processed missions: in sigma, correlation, and independence of its poses.
Prints rows of three tables, per scenario and kind of estimate. The fit, rms error and the Cramér-Rao bound that knows how large all
errors are: time offset (ms; share within 1 ms), lever arm x and y, z (mm), rotation of the sensor (deg), share within two stated
sigmas (%), ratio of the position ATE after the fit, aligned rigidly, to that with the true relation (share within 5 %). The frame: with
an alignment at the start and over all, share within two stated sigmas (%), NEES of the estimate's own covariance over its expectation
(median). With --evo, medians of the ATE in mm: true, ours, evo's with the true offset given, evo's with none; and the largest
difference of evo's ATE and RPE of our pairs to ours (m).
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from evo.core import metrics, sync
from evo.core import trajectory as evo_trajectory
from harness.drives.estimates import GNSS, LIDAR, VISUAL_INERTIAL, draw_relation, simulate_estimate
from measuring import Stopwatch
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from tsgt.analysis.compare import Estimate, FitSettings, ReferencePoses, Relation, nested_fits, pair
from tsgt.analysis.compare.alignment.drifting_frame import (
    NAMES,
    Unknowns,
    linearise,
    rows_of,
    solve,
    start_states,
)
from tsgt.analysis.compare.alignment.frame import FRAME_NAMES
from tsgt.analysis.compare.alignment.reference_error import as_white, own_covariance, whiten
from tsgt.analysis.compare.alignment.uncertainty import WEAK_SIGMA
from tsgt.analysis.compare.errors import nees
from tsgt.analysis.compare.interpolation import ReferenceTrajectory
from tsgt.analysis.compare.pairing import on_reference_clock
from tsgt.analysis.compare.relative import relative
from tsgt.analysis.formats.trajectories import read_reference_poses
from tsgt.geometry import (
    align,
    covariance_over_lever_arm,
    exp_so3,
    log_so3,
    quaternion_from_rotation,
    rotate,
    rotation_from_quaternion,
    transform_from,
)
from tsgt.model import ROBOT_ORIGIN
from tsgt.simulation.scenario_files import find_scenario
from tsgt.simulation.world import scenario_world

if TYPE_CHECKING:
    from harness.drives.estimates import EstimateModel, PoseAt, SimulatedEstimate, TrueRelation

    from tsgt.analysis.compare import Fit, PairedPoses
    from tsgt.geometry import FloatArray
    from tsgt.simulation.world import World

KINDS = {"lidar": LIDAR, "visual-inertial": VISUAL_INERTIAL, "gnss": GNSS}
START_NS = 1_700_000_000_000_000_000
MARGIN_S = 3.0
CENTROID_M = np.array([0.0, 0.0, 1.2])
POSITION_SIGMA_M, ROTATION_SIGMA_RAD = 0.001, 0.0017
SMOOTHING_S = (
    0.2  # Of a Gaussian kernel: correlation 0.82 over 0.2 s, 0.21 over 0.5 s, as errors of processed drives
)


def reference_and_truth(
    world: World, duration_s: float, rng: np.random.Generator
) -> tuple[ReferencePoses, PoseAt]:
    """Return reference poses at 20 Hz, and the truth about them.

    Errors of a smoother are independent of its poses, not of the truth: the world's motion is the reference, and the truth errs.
    """
    time_s = np.arange(0.0, duration_s, 0.05)
    n = len(time_s)
    motion = world.pose_at(time_s)
    width = SMOOTHING_S / 0.05
    white = gaussian_filter1d(rng.standard_normal((n, 6)), width, axis=0) * math.sqrt(
        2.0 * math.sqrt(math.pi) * width
    )
    spline = CubicSpline(time_s, white * np.repeat([POSITION_SIGMA_M, ROTATION_SIGMA_RAD], 3))

    def truth_at(at_s: FloatArray) -> FloatArray:
        at_s = np.clip(at_s, 0.0, time_s[-1])
        T, error = world.pose_at(at_s), spline(at_s)
        arm_m, turn = rotate(T[:, :3, :3], CENTROID_M), exp_so3(error[:, 3:])
        return transform_from(turn @ T[:, :3, :3], T[:, :3, 3] + arm_m + error[:, :3] - rotate(turn, arm_m))

    covariance = np.tile(np.diag(np.repeat([POSITION_SIGMA_M, ROTATION_SIGMA_RAD], 3) ** 2), (n, 1, 1))
    reference = ReferencePoses(
        stamp_ns=START_NS + np.rint(time_s * 1e9).astype(np.int64),
        T_station1_point=motion,
        covariance=covariance_over_lever_arm(covariance, -rotate(motion[:, :3, :3], CENTROID_M)),
        covariance_common=None,
        valid=np.ones(n, dtype=np.bool_),
        point=ROBOT_ORIGIN,
    )
    return reference, truth_at


def simulated(
    scenario: str, model: EstimateModel, seed: int, duration_s: float
) -> tuple[ReferencePoses, ReferencePoses, SimulatedEstimate]:
    """Simulate a mission: the reference, the truth, and one estimate."""
    rng = np.random.default_rng([seed, 24])
    world = scenario_world(find_scenario(scenario), duration_s, rng)
    reference, truth_at = reference_and_truth(world, duration_s - 0.1, rng)
    relation = draw_relation(model, rng)
    made = simulate_estimate(model, relation, truth_at, duration_s - 0.2, rng, start_ns=START_NS)
    time_s = (reference.stamp_ns - START_NS) / 1e9
    exact = replace(reference, T_station1_point=truth_at(time_s), covariance=None)
    return reference, exact, made


def of_mission(
    poses: Path, truth: Path, model: EstimateModel, seed: int
) -> tuple[ReferencePoses, ReferencePoses, SimulatedEstimate]:
    """Return a processed mission, its truth, and an estimate simulated from that."""
    rng = np.random.default_rng([seed, 77])
    reference, true = read_reference_poses(poses), read_reference_poses(truth)
    trajectory, start_ns = ReferenceTrajectory(true), int(true.stamp_ns[0])
    until_s = (int(true.stamp_ns[-1]) - start_ns) / 1e9

    def truth_at(at_s: FloatArray) -> FloatArray:
        stamp_ns = start_ns + np.rint(np.clip(at_s, 0.0, until_s) * 1e9).astype(np.int64)
        return trajectory.motion_at(stamp_ns).transform

    relation = draw_relation(model, rng)
    made = simulate_estimate(model, relation, truth_at, until_s - 0.3, rng, start_ns=start_ns)
    exact_T = truth_at((reference.stamp_ns - start_ns) / 1e9)
    return reference, replace(reference, T_station1_point=exact_T, covariance=None), made


def errors(found: Fit, made: SimulatedEstimate) -> dict[str, float]:
    """Return the errors of the fitted unknowns by name, without those of the frame."""
    truth, relation = made.truth, found.relation
    arm = relation.T_point_sensor[:3, 3] - truth.T_robot_sensor[:3, 3]
    turn = log_so3(relation.T_point_sensor[:3, :3] @ truth.T_robot_sensor[:3, :3].T)
    return {
        "offset_s": relation.offset_s - truth.offset_s,
        **dict(zip([f"extrinsic_{axis}_m" for axis in "xyz"], arm.tolist(), strict=True)),
        **dict(zip([f"extrinsic_{a}_rad" for a in ("roll", "pitch", "yaw")], turn.tolist(), strict=True)),
    }


def frame_errors(relation: Relation, made: SimulatedEstimate) -> dict[str, float]:
    """Return the errors of the frame by name, at the centroid of the estimate's positions as ``Fit`` defines them.

    The true frame is that of the estimate's start: stationary errors of the estimate, there averaged over a second, belong to it.
    """
    first = made.stamp_ns <= made.stamp_ns[0] + 1_000_000_000
    estimated, true = made.T_station1_estimated[first], made.T_station1_sensor[first]
    turn = exp_so3(log_so3(estimated[:, :3, :3] @ np.swapaxes(true[:, :3, :3], 1, 2)).mean(axis=0))
    start_m = true[:, :3, 3].mean(axis=0)
    shifted_m = start_m + (estimated - true)[:, :3, 3].mean(axis=0)
    wrong = transform_from(turn, shifted_m - turn @ start_m)
    started = np.linalg.inv(wrong) @ made.truth.T_station1_frame
    error = relation.T_station1_frame @ np.linalg.inv(started)
    centroid_m = started[:3, :3] @ made.position_m.mean(axis=0) + started[:3, 3]
    shift = error[:3, :3] @ centroid_m + error[:3, 3] - centroid_m
    return dict(zip(FRAME_NAMES, [*shift.tolist(), *log_so3(error[:3, :3]).tolist()], strict=True))


def bound(
    reference: ReferencePoses, estimate: Estimate, model: EstimateModel, truth: TrueRelation
) -> dict[str, float]:
    """Return sigmas that no estimator goes below that knows how large all errors are, and how they drift (Cramér-Rao).

    Errors of the reference count as white noise of the same power; without a covariance it is exact.
    """
    trajectory = ReferenceTrajectory(reference)
    relation = Relation(truth.offset_s, 0.0, truth.T_robot_sensor, truth.T_station1_frame, 1.0)
    stamp_ns = on_reference_clock(estimate, relation)
    rows = rows_of(estimate, trajectory.covers(stamp_ns), 1e-6)
    R, arm_m = truth.T_robot_sensor[:3, :3], truth.T_robot_sensor[:3, 3]
    given = Unknowns(truth.offset_s, 0.0, 1.0, arm_m, R, np.zeros((0, 3, 3)), np.zeros((0, 3)))
    at = start_states(trajectory, rows, given, truth.T_station1_frame[:3, :3])
    linear = linearise(trajectory, rows, at)
    jitter = model.stamp_jitter_s**2 * (linear.pose_by_border[:, :, 0] ** 2).mean(axis=0)
    white = np.repeat([model.position_noise_m**2, model.rotation_noise_rad**2], 3) + jitter
    stationary = np.array(
        [model.horizontal_error_m] * 2 + [model.vertical_error_m] + [model.tilt_error_rad] * 2 + [0.0]
    )
    walk_per_m = np.array([model.position_walk_m] * 3 + [model.tilt_walk_rad] * 2 + [model.yaw_walk_rad]) ** 2
    driven_m = np.linalg.norm(np.diff(rows.position_m[rows.knot], axis=0), axis=1)[:, None]
    walk = 2.0 * stationary**2 / model.correlation_time_s * rows.step_s[:, None] + walk_per_m * driven_m
    covariance = own_covariance(trajectory, stamp_ns, trajectory.covers(stamp_ns))
    if covariance is not None:
        covariance = as_white(covariance[rows.row], float(np.median(np.diff(rows.since_first_s))))
    whitening = whiten(linear.pose, white, covariance, linear.arm_m, has_orientation=model.orientation).matrix
    whitening = whitening * linear.known[:, None, None]
    active = [0, 3, 4, 5] + ([6, 7, 8] if model.orientation else [])
    zero = (np.zeros(len(NAMES)), np.zeros(len(NAMES)))
    solved = solve(rows, linear, whitening, 1.0 / (walk + 1e-12), active, zero)
    sigma = np.sqrt(np.diag(np.linalg.inv(solved.information)))
    return {NAMES[i]: float(value) for i, value in zip(active, sigma, strict=True)}


def evo_figures(
    reference: ReferencePoses, estimate: Estimate, truth: TrueRelation, pairs: PairedPoses
) -> dict[str, float]:
    """Return evo's ATE of the estimate against the reference, aligned, with no offset and with the true one, and of our pairs."""

    def trajectory(stamp_ns: Any, position_m: FloatArray, rotation: FloatArray) -> Any:
        xyzw = quaternion_from_rotation(rotation)
        return evo_trajectory.PoseTrajectory3D(
            position_m, np.roll(xyzw, 1, axis=1), (stamp_ns - reference.stamp_ns[0]) / 1e9
        )

    def rmse(metric: Any, first: Any, second: Any) -> float:
        metric.process_data((first, second))
        return float(metric.get_statistic(metrics.StatisticsType.rmse))

    part = metrics.PoseRelation.translation_part
    T = reference.T_station1_point
    theirs = trajectory(reference.stamp_ns, T[:, :3, 3], T[:, :3, :3])
    own = np.tile(np.eye(3), (len(estimate.stamp_ns), 1, 1))
    if estimate.orientation_xyzw is not None:
        own = rotation_from_quaternion(estimate.orientation_xyzw)
    found = {}
    for name, offset_s in (("ape_m", 0.0), ("ape_known_offset_m", truth.offset_s)):
        stamp_ns = estimate.stamp_ns + round(offset_s * 1e9)
        associated = sync.associate_trajectories(
            theirs, trajectory(stamp_ns, estimate.position_m, own), max_diff=0.03
        )
        associated[1].align(associated[0])
        found[name] = rmse(metrics.APE(part), *associated)
    same = [
        trajectory(pairs.stamp_ns, each[:, :3, 3], each[:, :3, :3])
        for each in (pairs.reference, pairs.estimated)
    ]
    found["same_pairs_ape_m"] = rmse(metrics.APE(part), *same)
    found["same_pairs_rpe_m"] = rmse(metrics.RPE(part, 10.0, metrics.Unit.meters), *same)
    return found


def one(
    scenario: str,
    kind: str,
    seed: int,
    duration_s: float,
    *,
    with_evo: bool,
    mission: tuple[Path, Path] | None = None,
) -> dict[str, Any]:
    """Fit one estimate; returns errors and sigmas. ``mission``: files of its poses and of its truth."""
    model = KINDS[kind]
    if mission is None:
        reference, exact, made = simulated(scenario, model, seed, duration_s)
    else:
        poses, true_poses = mission
        reference, exact, made = of_mission(poses, true_poses, model, seed)
    estimate = Estimate(kind, made.stamp_ns, made.position_m, made.orientation_xyzw, made.covariance)
    settings = FitSettings(frozenset({"offset", "extrinsic", "frame"}), "rigid")
    with Stopwatch() as stopwatch:
        nested = nested_fits(reference, estimate, settings)
    (_, start), (_, found) = nested[-2:]
    sigma = _sigmas(found)
    error = {name: value for name, value in errors(found, made).items() if name in sigma}
    pairs, exact_pairs = (pair(each, estimate, found.relation) for each in (reference, exact))
    normalised = {
        alignment: nees(each)
        for alignment, each in (("start", pair(reference, estimate, start.relation)), ("rigid", pairs))
    }
    result = {
        "scenario": scenario,
        "kind": kind,
        "seed": seed,
        "error": error,
        "sigma": {name: sigma[name] for name in error},
        "bound": bound(reference, estimate, model, made.truth),
        "bound_exact": bound(exact, estimate, model, made.truth),
        "frame": {
            alignment: {
                name: [value, _sigmas(each)[name]]
                for name, value in frame_errors(each.relation, made).items()
                if name in each.names
            }
            for alignment, each in (("start", start), ("rigid", found))
        },
        "nees": {a: each.statistics.mean / each.degrees_of_freedom for a, each in normalised.items() if each},
        "unobservable": found.unobservable,
        "used": float(found.used.mean()),
        "ate_m": _ate_m(pairs),
        "ate_sigma_m": found.ate_sigma_m,
        "exact_ate_m": _ate_m(exact_pairs),
        "true_ate_m": _true_ate_m(made, exact_pairs),
        "cpu_s": stopwatch.cpu_s,
    }
    if with_evo:
        result["evo"] = evo_figures(reference, estimate, made.truth, pairs)
        (rpe,) = [
            each
            for each in relative(pairs)
            if (each.delta, each.unit, each.pairs) == (10.0, "m", "consecutive")
        ]
        result["rpe_m"] = rpe.judged.errors.position_mm.rms / 1e3
    return result


def _sigmas(found: Fit) -> dict[str, float]:
    return dict(zip(found.names, np.sqrt(np.diag(found.covariance)).tolist(), strict=True))


def _true_ate_m(made: SimulatedEstimate, pairs: PairedPoses) -> float:
    """Return the ATE with the true relation, of the poses that were compared."""
    estimated, true = (T[pairs.row, :3, 3] for T in (made.T_station1_estimated, made.T_station1_sensor))
    aligned = align(estimated, true).T
    return _rms(np.linalg.norm(estimated @ aligned[:3, :3].T + aligned[:3, 3] - true, axis=1))


def _ate_m(pairs: PairedPoses) -> float:
    return _rms(np.linalg.norm(pairs.estimated[:, :3, 3] - pairs.reference[:, :3, 3], axis=1))


def summary(results: list[dict[str, Any]]) -> list[str]:
    """Return three rows of tables about one scenario and kind: the fit, its sigmas, and evo's figures beside ours."""
    first = f"| `{results[0]['scenario']}` | {results[0]['kind']} |"
    offset_ms = 1e3 * _values(results, ["offset_s"])
    normalised = np.array([r["error"][n] / r["sigma"][n] for r in results for n in r["error"]])
    ratio = np.array([r["exact_ate_m"] / r["true_ate_m"] for r in results])
    arms, turns = (
        [f"extrinsic_{axis}_m" for axis in "xyz"],
        [f"extrinsic_{axis}_rad" for axis in ("roll", "pitch", "yaw")],
    )
    fitted = (
        f"{_against_bound(results, ['offset_s'], 1e3, 2)} ({100 * np.mean(np.abs(offset_ms) <= 1.0):.0f} %)",
        _against_bound(results, arms[:2], 1e3, 1),
        _against_bound(results, arms[2:], 1e3, 1),
        _against_bound(results, turns, math.degrees(1.0), 3),
        f"{100 * np.mean(np.abs(normalised) <= 2.0):.0f}",
        f"{ratio.min():.2f} to {ratio.max():.2f} ({100 * np.mean(np.abs(ratio - 1.0) <= 0.05):.0f} %)",
    )
    frames = []
    for alignment in ("start", "rigid"):
        framed = np.array([e / s for r in results for e, s in r["frame"][alignment].values()])
        consistency = np.median([r["nees"][alignment] for r in results])
        frames += [f"{100 * np.mean(np.abs(framed) <= 2.0):.0f}", f"{consistency:.2f}"]
    rows = [f"{first} {' | '.join(fitted)} |", f"{first} {' | '.join(frames)} |"]
    beside = [r for r in results if "evo" in r]
    if beside:
        figures = [
            (r["true_ate_m"], r["exact_ate_m"], r["evo"]["ape_known_offset_m"], r["evo"]["ape_m"])
            for r in beside
        ]
        medians = (1e3 * np.median(np.array(figures), axis=0)).tolist()
        difference = max(
            max(
                abs(r["evo"]["same_pairs_ape_m"] - r["ate_m"]), abs(r["evo"]["same_pairs_rpe_m"] - r["rpe_m"])
            )
            for r in beside
        )
        rows.append(f"{first} {' | '.join(f'{value:.0f}' for value in medians)} | {difference:.0e} |")
    return rows


def determined(results: list[dict[str, Any]]) -> str:
    """Return how many components were not named as weakly determined, and how many of these are within the limits."""
    within = [
        abs(r["error"][name]) <= 2.0 * WEAK_SIGMA[name]
        for r in results
        for name in r["error"]
        if r["sigma"][name] <= WEAK_SIGMA[name]
    ]
    everything = [abs(r["error"][n]) <= 2.0 * r["sigma"][n] for r in results for n in r["error"]]
    ate = [abs(r["exact_ate_m"] - r["true_ate_m"]) <= 2.0 * r["ate_sigma_m"] for r in results]
    return (
        f"{100 * np.mean(ate):.0f} % of ATE within two of their sigmas of the true ones; {100 * np.mean(everything):.1f} % of {len(everything)} components within two sigmas; {len(within)} determined within 1 ms, "
        f"5 mm or 0.1 degrees by their sigma, {100 * np.mean(within):.1f} % of these are"
    )


def _values(results: list[dict[str, Any]], names: list[str], key: str = "error") -> FloatArray:
    return np.array([r[key][name] for r in results for name in names if name in r["error"]])


def _against_bound(results: list[dict[str, Any]], names: list[str], factor: float, digits: int) -> str:
    if not len(_values(results, names)):
        return ""
    return " / ".join(
        f"{factor * _rms(_values(results, names, key)):.{digits}f}" for key in ("error", "bound")
    )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenarios", nargs="+", default=["dynamic", "quarry", "ski-trail"])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--duration", type=float, default=300.0)
    parser.add_argument("--evo", type=int, default=0, help="Number of seeds with evo's figures, too.")
    parser.add_argument("--json", type=Path, help="File of all errors to write.")
    parser.add_argument(
        "--read", type=Path, nargs="+", help="Files of all errors that are summarised, instead."
    )
    parser.add_argument(
        "--mission", type=Path, nargs=2, help="Processed poses and truth (.tum) of one of --scenarios."
    )
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.seeds)
    results = [r for path in options.read or () for r in json.loads(path.read_text())]
    rows: list[list[str]] = []
    for scenario in options.scenarios:
        for kind in options.kinds:
            if options.read is None:
                results += [
                    one(
                        scenario,
                        kind,
                        seed,
                        options.duration,
                        with_evo=seed < options.first + options.evo,
                        mission=None if options.mission is None else tuple(options.mission),
                    )
                    for seed in seeds
                ]
            own = [r for r in results if (r["scenario"], r["kind"]) == (scenario, kind)]
            if own:
                rows.append(summary(own))
    for table in zip_longest(*rows, fillvalue=""):
        print("\n".join(table), end="\n\n")
    print(determined(results))
    if options.json is not None:
        options.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
