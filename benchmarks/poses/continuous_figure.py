"""Draw the errors of both estimators over a minute of a simulated recording, with the 95 % bound of `continuous`.

tsgt simulate --protocol superframe --seed 0 --faults none --output dynamic.jsonl --truth dynamic.tum
python benchmarks/run.py continuous_figure dynamic.jsonl dynamic.tum docs/explanation/figures/continuous-errors.svg
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import matplotlib as mpl
import numpy as np

from tsgt.analysis.evaluation import read_tum
from tsgt.analysis.processing import process, with_estimator
from tsgt.geometry import log_so3, rotation_from_quaternion
from tsgt.recording import load_recording

mpl.use("Agg")
from matplotlib import pyplot as plt

if TYPE_CHECKING:
    from tsgt.analysis.processing import Estimator
    from tsgt.geometry import FloatArray

FROM_S, UNTIL_S = 60.0, 120.0
COLOURS = {"linear": "#b3541e", "continuous": "#1f5f8b"}
# 95 % of errors in three dimensions are within this many sigmas where all three are alike.
BOUND_SIGMAS = 2.795


class Errors(NamedTuple):
    """Errors of an estimator's poses over time; sigmas are square roots of a third of the covariance's trace."""

    time_s: FloatArray
    position_mm: FloatArray
    rotation_deg: FloatArray
    position_sigma_mm: FloatArray
    rotation_sigma_deg: FloatArray
    speed_mps: FloatArray


def errors(recording_path: Path, truth_path: Path, estimator: Estimator) -> Errors:
    """Process the recording and compare its valid poses with the truth at the prisms' centroid."""
    recording = with_estimator(load_recording(recording_path), estimator)
    poses = process(recording, path=recording_path)
    truth, known = read_tum(truth_path).at(poses.stamp_ns)
    arm = np.mean([prism.position_m for prism in recording.parameters.prisms], axis=0)
    rotation = np.broadcast_to(np.eye(3), (len(poses.stamp_ns), 3, 3)).copy()
    used = poses.valid & known
    rotation[used] = rotation_from_quaternion(poses.orientation_xyzw[used])
    miss = poses.position_m + rotation @ arm - truth[:, :3, 3] - truth[:, :3, :3] @ arm
    turned = log_so3(np.swapaxes(truth[:, :3, :3], 1, 2) @ rotation)
    to_centroid = np.zeros((len(rotation), 3, 6))
    x, y, z = np.moveaxis(rotation @ arm, -1, 0)
    zero = np.zeros_like(x)
    to_centroid[:, :, :3] = np.eye(3)
    to_centroid[:, :, 3:] = np.moveaxis(np.array([[zero, z, -y], [-z, zero, x], [y, -x, zero]]), -1, 0)
    covariance = to_centroid @ poses.covariance @ np.swapaxes(to_centroid, 1, 2)
    miss[~used] = turned[~used] = np.nan
    time_s = (poses.stamp_ns - poses.stamp_ns[0]) / 1e9
    return Errors(
        time_s,
        1e3 * np.linalg.norm(miss, axis=1),
        np.degrees(np.linalg.norm(turned, axis=1)),
        1e3 * np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3),
        np.degrees(np.sqrt(np.trace(poses.covariance[:, 3:, 3:], axis1=1, axis2=2) / 3)),
        np.linalg.norm(np.gradient(truth[:, :3, 3], time_s, axis=0), axis=1),
    )


def main() -> None:
    """Draw the figure, and print its numbers."""
    recording_path, truth_path, output = map(Path, sys.argv[1:4])
    plt.rcParams.update(
        {"svg.hashsalt": "tsgt", "svg.fonttype": "none", "font.size": 9, "font.family": "sans-serif"}
    )
    figure, (above, middle, below) = plt.subplots(
        3, 1, figsize=(8.0, 6.0), sharex=True, height_ratios=(3, 3, 1.2), layout="constrained"
    )
    both: dict[Estimator, Errors] = {
        name: errors(recording_path, truth_path, name) for name in ("linear", "continuous")
    }
    for estimator, found in both.items():
        shown = (found.time_s >= FROM_S) & (found.time_s < UNTIL_S)
        time_s, colour = found.time_s[shown], COLOURS[estimator]
        for axes, error, sigma in (
            (above, found.position_mm, found.position_sigma_mm),
            (middle, found.rotation_deg, found.rotation_sigma_deg),
        ):
            rms = np.sqrt(np.nanmean(error[shown] ** 2))
            axes.plot(time_s, error[shown], color=colour, lw=0.9, label=f"{estimator} (rms {rms:.2g})")
            if estimator == "continuous":
                stated = BOUND_SIGMAS * sigma[shown]
                axes.fill_between(
                    time_s, 0, stated, color=colour, alpha=0.18, lw=0, label="its stated 95 % bound"
                )
                within = np.mean(error[shown] <= stated)
                print(
                    f"{estimator}: rms {rms:.2f}, {within:.1%} within the bound, {stated.min():.2f}-{stated.max():.2f}"
                )
            else:
                print(f"{estimator}: rms {rms:.2f}")
    below.plot(time_s, found.speed_mps[shown], color="#444444", lw=0.9)
    above.set_ylabel("position error at the\nprisms' centroid in mm")
    middle.set_ylabel("rotation error\nin degrees")
    below.set_ylabel("speed\nin m/s")
    below.set_xlabel("time in s")
    for axes in (above, middle, below):
        axes.set_ylim(0, None)
        axes.grid(alpha=0.25, lw=0.5)
        axes.spines[["top", "right"]].set_visible(False)
    above.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=3, frameon=False)
    middle.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=3, frameon=False)
    below.set_xlim(FROM_S, UNTIL_S)
    figure.savefig(output, metadata={"Date": None})
    if output.suffix == ".svg":
        # The renderer leaves blanks at ends of lines.
        lines = output.read_text(encoding="utf-8").splitlines()
        output.write_text("\n".join(line.rstrip() for line in lines) + "\n", encoding="utf-8")
