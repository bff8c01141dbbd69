"""Accuracy of the joint fit of `tsgt compare`: simulated estimates with unknown clock, extrinsic and frame.

    python benchmarks/run.py compare [--scenarios dynamic quarry ski-trail] [--kinds lidar visual-inertial gnss]
        [--seeds 100] [--first 0] [--duration 300] [--json FILE]

The reference has poses at 20 Hz and errors like those of processed missions: in sigma, correlation, and independence of its poses.
Prints, per scenario and kind of estimate: errors of time offset (ms), lever arm (mm, largest component) and rotation of the sensor
(deg, largest component) where observable, the share of all these within two stated sigmas, and the ratio of the position ATE after
the fit, aligned rigidly, to that with the true relation.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from evo.core import metrics, sync
from evo.core import trajectory as evo_trajectory
from measuring import Stopwatch
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from tsgt.analysis.compare import Estimate, FitSettings, ReferencePoses, Relation, nested_fits, pair
from tsgt.analysis.compare.drifting_frame import NAMES, Unknowns, linearise, rows_of, solve, start_states
from tsgt.analysis.compare.errors import nees
from tsgt.analysis.compare.frame_alignment import FRAME_NAMES
from tsgt.analysis.compare.interpolation import ReferenceTrajectory
from tsgt.analysis.compare.pairing import on_reference_clock
from tsgt.analysis.compare.reference_error import as_white, own_covariance, whiten
from tsgt.analysis.compare.relative import relative
from tsgt.geometry import (
    covariance_over_lever_arm,
    exp_so3,
    log_so3,
    quaternion_from_rotation,
    rotate,
    rotation_from_quaternion,
    transform_from,
)
from tsgt.model import ROBOT_ORIGIN
from tsgt.simulation.estimates import GNSS, LIDAR, VISUAL_INERTIAL, draw_relation, simulate_estimate
from tsgt.simulation.scenario_files import find_scenario
from tsgt.simulation.world import scenario_world

if TYPE_CHECKING:
    from tsgt.analysis.compare import Fit, PairedPoses
    from tsgt.geometry import FloatArray
    from tsgt.simulation.estimates import EstimateModel, PoseAt, SimulatedEstimate, TrueRelation
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
            position_m, np.roll(xyzw, 1, axis=1), (stamp_ns - START_NS) / 1e9
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


def one(scenario: str, kind: str, seed: int, duration_s: float, *, with_evo: bool) -> dict[str, Any]:
    """Fit one estimate; returns errors and sigmas."""
    model = KINDS[kind]
    reference, exact, made = simulated(scenario, model, seed, duration_s)
    estimate = Estimate(kind, made.stamp_ns, made.position_m, made.orientation_xyzw, made.covariance)
    settings = FitSettings(frozenset({"offset", "extrinsic", "frame"}), "rigid")
    with Stopwatch() as stopwatch:
        nested = nested_fits(reference, estimate, settings)
    (_, start), (_, found) = nested[-2:]
    sigma = _sigmas(found)
    error = {name: value for name, value in errors(found, made).items() if name in sigma}
    pairs, exact_pairs = (pair(each, estimate, found.relation) for each in (reference, exact))
    normalised = {
        align: nees(each)
        for align, each in (("start", pair(reference, estimate, start.relation)), ("rigid", pairs))
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
            align: {
                name: [value, _sigmas(each)[name]]
                for name, value in frame_errors(each.relation, made).items()
                if name in each.names
            }
            for align, each in (("start", start), ("rigid", found))
        },
        "nees": {a: each.statistics.mean / each.degrees_of_freedom for a, each in normalised.items() if each},
        "unobservable": found.unobservable,
        "used": float(found.used.mean()),
        "ate_m": _ate_m(pairs),
        "exact_ate_m": _ate_m(exact_pairs),
        "true_ate_m": made.ate_position_m("rigid"),
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


def _ate_m(pairs: PairedPoses) -> float:
    return _rms(np.linalg.norm(pairs.estimated[:, :3, 3] - pairs.reference[:, :3, 3], axis=1))


def summary(results: list[dict[str, Any]]) -> str:
    """Return a line of figures of one scenario and kind."""
    names = sorted({name for r in results for name in r["error"]})
    offset = np.array([1e3 * r["error"]["offset_s"] for r in results if "offset_s" in r["error"]])
    groups = {"mm": (1e3, "_m"), "deg": (np.degrees(1.0), "_rad")}
    words = [f"{results[0]['scenario']:9} {results[0]['kind']:15} n={len(results)}"]
    words.append(f"offset rms {_rms(offset):.3f} max {np.abs(offset).max():.3f} ms")
    for unit, (factor, ending) in groups.items():
        worst = np.array(
            [
                factor * max((abs(v) for n, v in r["error"].items() if n.endswith(ending)), default=0.0)
                for r in results
            ]
        )
        words.append(
            f"extrinsic p50 {np.median(worst):.3f} p95 {np.quantile(worst, 0.95):.3f} max {worst.max():.3f} {unit}"
        )
    within = {n: [abs(r["error"][n]) <= 2 * r["sigma"][n] for r in results if n in r["error"]] for n in names}
    everything = [w for values in within.values() for w in values]
    words.append(f"within 2 sigma {100 * np.mean(everything):.1f} %")
    for name, words_of in (("ate_m", "against the reference"), ("exact_ate_m", "against the truth")):
        ratio = np.array([r[name] / r["true_ate_m"] for r in results])
        share = 100 * np.mean(np.abs(ratio - 1) <= 0.05)
        words.append(f"ATE {words_of} {ratio.min():.3f}..{ratio.max():.3f}, {share:.0f} % within 5 %")
    words.append(f"true ATE {1e3 * np.median([r['true_ate_m'] for r in results]):.0f} mm")
    words.append(f"cpu {np.mean([r['cpu_s'] for r in results]):.2f} s")
    lines = ["; ".join(words)]
    for n in names:
        e = np.array([r["error"][n] for r in results if n in r["error"]])
        s = np.array([r["sigma"][n] for r in results if n in r["error"]])
        factor, unit = (1e3, "mrad") if n.endswith("rad") else (1e3, "m" + n[-1])
        lines.append(
            f"    {n:22} observable {len(e):3}/{len(results)}  rms {factor * _rms(e):7.3f} {unit}  sigma {factor * np.median(s):7.3f}"
            f"  z rms {_rms(e / s):.2f}  within {100 * np.mean(np.abs(e) <= 2 * s):.0f} %"
        )
    return "\n".join(lines)


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
    parser.add_argument("--json", type=Path)
    parser.add_argument("--evo", type=int, default=0, help="Number of seeds with evo's figures, too.")
    options = parser.parse_args()
    results = []
    for scenario in options.scenarios:
        for kind in options.kinds:
            seeds = range(options.first, options.first + options.seeds)
            own = [
                one(scenario, kind, seed, options.duration, with_evo=seed < options.first + options.evo)
                for seed in seeds
            ]
            results += own
            print(summary(own), flush=True)
    if options.json is not None:
        options.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
