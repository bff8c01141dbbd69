"""Accuracy of `tsgt calibrate motion`: errors planted into simulated drives, and what remains of them.

    tsgt simulate dynamic --seed 3 --output r3.jsonl
    python benchmarks/run.py motion_calibration r3.jsonl ... [--length 300]

    python benchmarks/run.py motion_calibration --drawn 20 [--length 300] [--truncated]

Takes recordings with true frames and latencies, cuts them into drives of a length in seconds, displaces station 2 by 5 mm,
0.5 mrad (each in a random direction) and 30 ms, and calibrates. Prints, per drive, the largest error of translations (mm),
rotations (mrad) and latencies (ms), the largest error in stated sigmas, and chi-square of all parameters. ``--drawn``: drives
of the robot of the scenario `dynamic` with normal noise only; ``--truncated``: their times in whole milliseconds, as of an
instrument that measures in another part of one for the whole drive.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from tsgt.analysis.calibration import calibrate_recording
from tsgt.config import ScenarioConfig
from tsgt.estimation.observations import INSTRUMENT_TIME_SIGMA_S
from tsgt.geometry import (
    cartesian_to_polar,
    exp_so3,
    invert,
    polar_to_cartesian,
    transform_from,
    transform_points,
)
from tsgt.geometry.motion_calibration import Setup, SetupPrior, calibrate_motion
from tsgt.geometry.trajectory import Observations
from tsgt.recording import load_recording
from tsgt.simulation.world import scenario_world

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.geometry.motion_calibration import MotionCalibration
    from tsgt.model import Matrix4
    from tsgt.recording import Recording

KNOWN = SetupPrior(translation_sigma_m=0.02, rotation_sigma_rad=0.002, latency_sigma_s=0.1)
SCENARIO = ScenarioConfig()
PERIOD_S = 0.4
SHIFT_M, TURN_RAD, LATE_S = 0.005, 0.0005, 0.03


def planted(frame: Matrix4, rng: np.random.Generator) -> Matrix4:
    """Displace and rotate a frame."""
    shift, turn = rng.normal(size=3), rng.normal(size=3)
    wrong = np.array(frame)
    wrong[:3, :3] = exp_so3(turn * TURN_RAD / np.linalg.norm(turn)) @ wrong[:3, :3]
    wrong[:3, 3] += shift * SHIFT_M / np.linalg.norm(shift)
    return cast("Matrix4", tuple(map(tuple, wrong.tolist())))


def drawn(length_s: float, seed: int, *, truncated: bool) -> Observations:
    """Measure the robot of `dynamic` three times 2.5 Hz, with the stated noise and the estimator's time noise."""
    rng = np.random.default_rng(seed)
    world = scenario_world(SCENARIO, length_s + 1.0, rng)
    frames = np.array([
        transform_from(exp_so3(np.array([0.0, 0.0, np.radians(each.yaw_deg)])), np.array(each.position_m))
        for each in SCENARIO.stations
    ])  # fmt: skip
    rows = []
    for column, frame in enumerate(frames):
        time_s = np.arange(rng.uniform(0.0, PERIOD_S), length_s, PERIOD_S)
        seen = transform_points(invert(frame), world.prism_at(time_s, column))
        horizontal, zenith, distance_m = cartesian_to_polar(seen)
        across_m, along_m = np.hypot(np.radians(1 / 3600) * distance_m, 1e-3), np.hypot(2e-3, 1e-3)
        noise = rng.normal(size=(3, len(time_s)))
        points_m = polar_to_cartesian(
            horizontal + noise[0] * across_m / (distance_m * np.sin(zenith)),
            zenith + noise[1] * across_m / distance_m,
            distance_m + noise[2] * along_m,
        )
        count = len(time_s)
        late_s = (
            np.full(count, -rng.uniform(0.0, 1e-3))
            if truncated
            else rng.normal(scale=INSTRUMENT_TIME_SIGMA_S, size=count)
        )
        sigmas_m = np.column_stack([np.full(len(time_s), along_m), across_m, across_m])
        rows.append(np.column_stack([time_s + late_s, np.full(len(time_s), column), points_m, sigmas_m]))
    table = np.concatenate(rows)
    table = table[np.argsort(table[:, 0], kind="stable")]
    which = table[:, 1].astype(np.intp)
    return Observations(
        time_s=table[:, 0],
        time_sigma_s=np.full(len(table), INSTRUMENT_TIME_SIGMA_S),
        points_m=table[:, 2:5],
        sigmas_m=table[:, 5:8],
        polar=np.ones(len(table), dtype=bool),
        station=which,
        prism=which,
        frames=frames,
        layout=np.array([each.position_m for each in SCENARIO.prisms]),
    )


def evaluate_drawn(
    name: str, observations: Observations, rng: np.random.Generator
) -> tuple[float, FloatArray]:
    """Calibrate a drawn drive from a wrong set-up."""
    frames = observations.frames.copy()
    frames[1] = planted(cast("Matrix4", tuple(map(tuple, frames[1].tolist()))), rng)
    late_s = np.zeros(len(frames))
    late_s[1] = -LATE_S
    start = replace(Setup.of(observations), frames=frames, latencies_s=late_s)
    return judge(name, calibrate_motion(observations, KNOWN, start=start), Setup.of(observations))


def evaluate(name: str, recording: Recording, rng: np.random.Generator) -> tuple[float, FloatArray]:
    """Calibrate a part of a recording from a wrong set-up."""
    stations = list(recording.parameters.stations)
    stations[1] = replace(
        stations[1],
        T_station1_station=planted(stations[1].T_station1_station, rng),
        latency_ns=stations[1].latency_ns - round(1e9 * LATE_S),
    )
    wrong = replace(recording, parameters=replace(recording.parameters, stations=tuple(stations)))
    found = calibrate_recording(wrong, KNOWN, held_out=False).calibration
    frames = np.array([*(each.T_station1_station for each in recording.parameters.stations), np.eye(4)])
    late_s = np.zeros(len(frames))
    late_s[1] = LATE_S
    return judge(name, found, replace(found.setup, frames=frames, latencies_s=late_s))


def judge(name: str, found: MotionCalibration, truth: Setup) -> tuple[float, FloatArray]:
    """Print chi-square of a drive and each parameter's error in stated sigmas; return both."""
    unknowns = found.parameters
    error = unknowns.local_coordinates(found.setup) - unknowns.local_coordinates(truth)
    largest = [
        1e3 * np.abs(error[at]).max()
        for at in (unknowns.translations, unknowns.rotations, unknowns.latencies)
    ]
    free = found.prior_sigmas > 0
    error, covariance = error[free], found.covariance[np.ix_(free, free)]
    sigmas = error / np.sqrt(np.diag(covariance))
    squared = float(error @ np.linalg.solve(covariance, error))
    print(
        name,
        "{:.2f} mm {:.3f} mrad {:.2f} ms".format(*largest),
        f"largest {np.abs(sigmas).max():.1f} sigma, chi-square {squared:.1f} of {len(error)},",
        f"noise {found.noise_scale:.2f}, wander {1e3 * found.wander_s:.2f} ms, disagreement {found.birge_ratio:.2f}",
        "in sigmas",
        " ".join(f"{each:.1f}" for each in sigmas),
        flush=True,
    )
    return squared, np.asarray(sigmas, np.float64)


def main() -> None:
    """Evaluate all drives."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--length", type=float, default=300.0)
    parser.add_argument("--drawn", type=int, default=0, help="number of drawn drives")
    parser.add_argument("--truncated", action="store_true")
    chosen = parser.parse_args()
    rng = np.random.default_rng(0)
    judged = []
    for path in chosen.recordings:
        recording = load_recording(path)
        first_ns = min(each.stamp_ns for each in recording.measurements)
        last_ns = max(each.stamp_ns for each in recording.measurements)
        count = max(round((last_ns - first_ns) / 1e9 / chosen.length), 1)
        edges_ns = np.linspace(first_ns, last_ns + 1, count + 1)
        for drive in range(count):
            inside = [
                each
                for each in recording.measurements
                if edges_ns[drive] <= each.stamp_ns < edges_ns[drive + 1]
            ]
            judged.append(evaluate(f"{path.stem} {drive + 1}", replace(recording, measurements=inside), rng))
    judged += [
        evaluate_drawn(f"drawn {seed}", drawn(chosen.length, seed, truncated=chosen.truncated), rng)
        for seed in range(chosen.drawn)
    ]
    squared = np.array([each for each, _ in judged])
    sigmas = np.concatenate([each for _, each in judged])
    print(
        f"{len(judged)} drives: chi-square {squared.mean():.1f} on average ({squared.min():.1f} to {squared.max():.1f}); "
        f"errors over 2 sigmas {100 * np.mean(np.abs(sigmas) > 2):.1f} %, over 3 {100 * np.mean(np.abs(sigmas) > 3):.1f} %, "
        f"largest {np.abs(sigmas).max():.1f}"
    )
