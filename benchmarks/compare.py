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
from measuring import Stopwatch
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from tsgt.analysis.compare import Estimate, FitSettings, ReferencePoses, fit, pair
from tsgt.geometry import covariance_over_lever_arm, exp_so3, log_so3, rotate, transform_from
from tsgt.model import ROBOT_ORIGIN
from tsgt.simulation.estimates import GNSS, LIDAR, VISUAL_INERTIAL, draw_relation, simulate_estimate
from tsgt.simulation.scenario_files import find_scenario
from tsgt.simulation.world import scenario_world

if TYPE_CHECKING:
    from tsgt.analysis.compare import Fit
    from tsgt.geometry import FloatArray
    from tsgt.simulation.estimates import EstimateModel, PoseAt, SimulatedEstimate
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


def one(scenario: str, kind: str, seed: int, duration_s: float) -> dict[str, Any]:
    """Fit one estimate; returns errors and sigmas."""
    reference, exact, made = simulated(scenario, KINDS[kind], seed, duration_s)
    estimate = Estimate(kind, made.stamp_ns, made.position_m, made.orientation_xyzw, None)
    settings = FitSettings(frozenset({"offset", "extrinsic", "frame"}), "rigid")
    with Stopwatch() as stopwatch:
        found = fit(reference, estimate, settings)
    sigma = dict(zip(found.names, np.sqrt(np.diag(found.covariance)).tolist(), strict=True))
    error = {name: value for name, value in errors(found, made).items() if name in sigma}
    ate_m, exact_ate_m = (_ate_m(each, estimate, found) for each in (reference, exact))
    return {
        "scenario": scenario,
        "kind": kind,
        "seed": seed,
        "error": error,
        "sigma": {name: sigma[name] for name in error},
        "unobservable": found.unobservable,
        "used": float(found.used.mean()),
        "ate_m": ate_m,
        "exact_ate_m": exact_ate_m,
        "true_ate_m": made.ate_position_m("rigid"),
        "cpu_s": stopwatch.cpu_s,
    }


def _ate_m(reference: ReferencePoses, estimate: Estimate, found: Fit) -> float:
    paired = pair(reference, estimate, found.relation)
    return _rms(np.linalg.norm(paired.estimated[:, :3, 3] - paired.reference[:, :3, 3], axis=1))


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
    options = parser.parse_args()
    results = []
    for scenario in options.scenarios:
        for kind in options.kinds:
            seeds = range(options.first, options.first + options.seeds)
            own = [one(scenario, kind, seed, options.duration) for seed in seeds]
            results += own
            print(summary(own), flush=True)
    if options.json is not None:
        options.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
