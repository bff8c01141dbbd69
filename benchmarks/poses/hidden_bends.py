"""Batch poses of the paper's drives, simulated, with and without the process-noise floor.

For each drive: NEES of valid poses, their errors, and the share of valid poses; once with the maximum-evidence prior, once as
`tsgt process` does it, once with the configured prior.

    python benchmarks/run.py hidden_bends [NAME:SEED]...
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import numpy as np
from measuring import normalised_squared, simulated

from tsgt.analysis.evaluation import interior_mask
from tsgt.analysis.smoothing import estimate_motion_model
from tsgt.analysis.validation import plausible_measurements
from tsgt.config import SuperframeMasterConfig
from tsgt.estimation import build_observations
from tsgt.estimation.observations import centroid_m
from tsgt.geometry import log_so3
from tsgt.geometry.batch import fit_trajectory, tune
from tsgt.log import configure_logging
from tsgt.model import PipelineParameters
from tsgt.recording import load_recording
from tsgt.simulation.options import SimulationOptions
from tsgt.simulation.scenario_files import find_scenario

if TYPE_CHECKING:
    from tsgt.recording import Recording
    from tsgt.simulation.world import World

DRIVES = (
    "quarry:0",
    "ski-trail:0",
    "ski-trail:1",
    "ski-trail:2",
    "snowmobile:0",
    "snowmobile:1",
    "snowmobile:2",
)
LIMITS = (22.46, 60.0)
ACCEPTED = PipelineParameters()


def drive(name: str, seed: int) -> None:
    """Print the lines of one drive."""
    scenario = find_scenario(name)
    scenario = scenario.model_copy(
        update={"pipeline": scenario.pipeline.model_copy(update={"estimator": "linear"})}
    )
    options = SimulationOptions(
        duration_s=scenario.duration_s,
        seed=seed,
        station_software="ours",
        protocol=SuperframeMasterConfig(kind="superframe"),
    )
    with simulated(scenario, options) as run:
        path = run.master_logs[-1].recording()
        if path is None:
            raise RuntimeError(f"{name}: the master made no recording")
        evaluate(f"{name} {seed}", load_recording(path), run.world, run.start_ns, run.end_ns)


def evaluate(name: str, recording: Recording, world: World, start_ns: int, end_ns: int) -> None:
    """Print the lines of one recording."""
    observations, _ = build_observations(
        recording.parameters, plausible_measurements(recording), origin_ns=start_ns
    )
    first_ns, last_ns = (round(1e9 * observations.time_s[row]) + start_ns for row in (0, -1))
    stamp_ns = np.arange(start_ns, end_ns, 50_000_000, dtype=np.int64)
    stamp_ns = stamp_ns[interior_mask(stamp_ns, start_ns, end_ns)]
    stamp_ns = stamp_ns[(stamp_ns >= first_ns) & (stamp_ns <= last_ns)]
    at_s = (stamp_ns - start_ns) / 1e9
    truth = world.pose_at(at_s)
    place_m = truth[:, :3, 3] + truth[:, :3, :3] @ centroid_m(recording.parameters)
    configured, motion = (
        recording.parameters.pipeline.motion,
        estimate_motion_model(observations, recording.parameters.pipeline),
    )
    for label, prior, occluded_prior in (
        ("tuned", tune(observations).prior, None),
        ("with floor", motion.prior, configured),
        ("configured", configured, None),
    ):
        found = fit_trajectory(
            observations, prior=prior, occluded_prior=occluded_prior, noise_scale=motion.noise_scales
        )
        states, covariance = found.trajectory.at(at_s, dim=6)
        off_m = place_m - states.position
        turned = log_so3(np.swapaxes(states.rotation, 1, 2) @ truth[:, :3, :3])
        error = np.concatenate([off_m, turned], axis=1)
        nees = normalised_squared(error, covariance)
        valid = (np.linalg.eigvalsh(covariance[:, :3, :3])[:, -1] < ACCEPTED.position_sigma_limit_m**2) & (
            np.linalg.eigvalsh(covariance[:, 3:, 3:])[:, -1] < ACCEPTED.rotation_sigma_limit_rad**2
        )
        shares = " | ".join(f"{1e3 * np.mean(nees[valid] > limit):.1f}" for limit in LIMITS)
        rms_mm = 1e3 * np.sqrt(np.mean(np.sum(off_m[valid] ** 2, axis=1)))
        rms_deg = np.degrees(np.sqrt(np.mean(np.sum(turned[valid] ** 2, axis=1))))
        print(
            f"| {name} | {label} | {nees[valid].mean():.1f} | {nees[valid].max():.0f} | {shares} "
            f"| {rms_mm:.1f} mm, {rms_deg:.2f}° | {valid.mean():.0%} |",
            flush=True,
        )


def main() -> None:
    """Print a table."""
    configure_logging("error")
    print(
        "| drive | motion | NEES, mean | largest | above 22.5 in 1000 | above 60 in 1000 | rms at the prisms' centroid | valid |"
    )
    for each in sys.argv[1:] or DRIVES:
        name, _, seed = each.partition(":")
        drive(name, int(seed))
