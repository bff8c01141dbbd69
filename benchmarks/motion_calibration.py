"""Accuracy of `tsgt calibrate motion`: errors planted into simulated drives, and what remains of them.

    tsgt simulate dynamic --seed 3 --output r3.jsonl
    python benchmarks/run.py motion_calibration r3.jsonl ... [--length 300]

Takes recordings with true frames and latencies, cuts them into drives of a length in seconds, displaces station 2 by 5 mm,
0.5 mrad (each in a random direction) and 30 ms, and calibrates. Prints, per drive, the largest error of translations (mm),
rotations (mrad) and latencies (ms), the largest error in stated sigmas, and chi-square of all parameters.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from tsgt.analysis.calibration import calibrate_recording
from tsgt.geometry import exp_so3
from tsgt.geometry.motion_calibration import SetupPrior
from tsgt.recording import load_recording

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.model import Matrix4
    from tsgt.recording import Recording

KNOWN = SetupPrior(translation_sigma_m=0.02, rotation_sigma_rad=0.002, latency_sigma_s=0.1)
SHIFT_M, TURN_RAD, LATE_S = 0.005, 0.0005, 0.03


def planted(frame: Matrix4, rng: np.random.Generator) -> Matrix4:
    """Displace and rotate a frame."""
    shift, turn = rng.normal(size=3), rng.normal(size=3)
    wrong = np.array(frame)
    wrong[:3, :3] = exp_so3(turn * TURN_RAD / np.linalg.norm(turn)) @ wrong[:3, :3]
    wrong[:3, 3] += shift * SHIFT_M / np.linalg.norm(shift)
    return cast("Matrix4", tuple(map(tuple, wrong.tolist())))


def evaluate(name: str, recording: Recording, rng: np.random.Generator) -> tuple[float, FloatArray]:
    """Print chi-square of a drive and each parameter's error in stated sigmas; return both."""
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
    unknowns = found.parameters
    error = unknowns.local_coordinates(found.setup) - unknowns.local_coordinates(
        replace(found.setup, frames=frames, latencies_s=late_s)
    )
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
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--length", type=float, default=300.0)
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
    squared = np.array([each for each, _ in judged])
    sigmas = np.concatenate([each for _, each in judged])
    print(
        f"{len(judged)} drives: chi-square {squared.mean():.1f} on average ({squared.min():.1f} to {squared.max():.1f}); "
        f"errors over 2 sigmas {100 * np.mean(np.abs(sigmas) > 2):.1f} %, over 3 {100 * np.mean(np.abs(sigmas) > 3):.1f} %, "
        f"largest {np.abs(sigmas).max():.1f}"
    )
