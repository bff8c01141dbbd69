"""Draw the picture of the README: the drive, and the position errors of both estimators over a minute.

tsgt simulate dynamic --seed 1 --output dynamic.jsonl --truth dynamic.tum
python benchmarks/run.py overview_figure dynamic.jsonl dynamic.tum docs/overview.png
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np

from poses.continuous_figure import COLOURS, FROM_S, UNTIL_S, errors
from tsgt.analysis.evaluation import read_tum
from tsgt.recording import load_recording

mpl.use("Agg")
from matplotlib import pyplot as plt

if TYPE_CHECKING:
    from tsgt.analysis.processing import Estimator

LABELS: dict[Estimator, str] = {"linear": "linear: the paper's estimator", "continuous": "continuous"}


def main() -> None:
    """Draw the figure."""
    recording_path, truth_path, output = map(Path, sys.argv[1:4])
    plt.rcParams.update({"font.size": 9, "font.family": "sans-serif"})
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(10.0, 4.0), width_ratios=(1, 1.5), layout="constrained"
    )
    truth = read_tum(truth_path)
    stations = load_recording(recording_path).parameters.stations
    left.plot(truth.position_m[:, 0], truth.position_m[:, 1], color="#444444", lw=0.8, label="robot")
    places = np.array([np.reshape(station.T_station1_station, (4, 4))[:2, 3] for station in stations])
    left.plot(places[:, 0], places[:, 1], "^", color="#D55E00", label="total stations")
    left.set_aspect("equal", adjustable="datalim")
    left.set_xlabel("x in m")
    left.set_ylabel("y in m")
    left.legend(loc="lower right", frameon=False)
    for estimator, label in LABELS.items():
        found = errors(recording_path, truth_path, estimator)
        shown = (found.time_s >= FROM_S) & (found.time_s < UNTIL_S)
        rms_mm = np.sqrt(np.nanmean(found.position_mm**2))
        right.plot(
            found.time_s[shown], found.position_mm[shown], color=COLOURS[estimator], lw=1.0,
            label=f"{label}, rms {rms_mm:.1f} mm",
        )  # fmt: skip
    right.set_xlabel("time in s")
    right.set_ylabel("position error at the prisms' centroid in mm")
    right.set_xlim(FROM_S, UNTIL_S)
    right.set_ylim(0, None)
    right.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
    for axes in (left, right):
        axes.grid(alpha=0.25, lw=0.5)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(output, dpi=110, metadata={"Software": None})
