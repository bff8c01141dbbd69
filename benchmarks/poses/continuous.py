"""CPU time of the estimator `continuous`: batch by duration and by stations, and fixed-lag updates.

A simulated robot drives curves on rough ground; each station measures 2.5 times a second. Times are CPU seconds of this
process with one thread. The batch is what `tsgt process` does, without input and output: tuning of the prior, the trajectory
with all covariances, and poses 20 times a second.

    python benchmarks/run.py continuous [HOURS]
"""

from __future__ import annotations

import os

# More threads than one help with none of the small matrices, and their CPU time would count.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
from typing import TYPE_CHECKING

import numpy as np
from measuring import Stopwatch, peak_memory_mb

from tsgt.geometry import exp_so3, invert, transform_from, transform_points
from tsgt.geometry.batch import fit_trajectory
from tsgt.geometry.trajectory import FixedLagSmoother, Observations
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray

HOURS = 8
STATIONS = 8
RATE_HZ = 2.5
POSES_HZ = 20.0
LIVE_S, LAG_S, AHEAD_S = 120.0, 3.0, 0.5
SIGMAS_M = np.array([0.0025, 0.0011, 0.0011])
# The prisms of the reference scenario, in the robot frame, in m.
LAYOUT = np.array([[-0.4559, -0.1759, 1.1167], [0.4844, -0.1759, 1.4167], [-0.0285, 0.3519, 1.0667]])


def synthetic_observations(hours: float, stations: int) -> Observations:
    """Measure a robot that drives curves, rolls and pitches; stations beyond the third track the same prisms in turn."""
    rng = np.random.default_rng(1)
    count = round(hours * 3600 * RATE_HZ)
    station = np.tile(np.arange(stations), count)
    phases_s = rng.uniform(0, 1 / RATE_HZ, stations)
    time_s = np.repeat(np.arange(count) / RATE_HZ, stations) + phases_s[station]
    order = np.argsort(time_s, kind="stable")
    time_s, station = time_s[order], station[order]
    t = time_s[:, None]
    centre = np.array([60.0, 45.0, -1.0])
    position = centre + 20 * np.concatenate([np.cos(t / 20), np.sin(t / 13), 0.001 * np.sin(2 * t)], axis=1)
    turn = np.concatenate([0.026 * np.sin(1.9 * t), 0.026 * np.sin(2.3 * t + 1)], axis=1)
    rotation = exp_so3(np.concatenate([0 * turn, 2.0 * np.sin(t / 6)], axis=1)) @ exp_so3(
        np.concatenate([turn, 0 * t], axis=1)
    )
    yaws = np.stack([np.zeros(stations), np.zeros(stations), rng.uniform(-3, 3, stations)], axis=1)
    frames = transform_from(exp_so3(yaws), rng.uniform(-3, 3, (stations, 3)))
    prism = station % len(LAYOUT)
    world = position + (rotation @ LAYOUT[prism][:, :, None])[:, :, 0]
    points = transform_points(invert(frames)[station], world)
    return Observations(
        time_s=time_s,
        time_sigma_s=np.full(len(time_s), 1e-5),
        points_m=points + rng.normal(scale=0.0015, size=points.shape),
        sigmas_m=np.tile(SIGMAS_M, (len(time_s), 1)),
        polar=np.ones(len(time_s), dtype=bool),
        station=station,
        prism=prism,
        frames=frames,
        layout=LAYOUT,
    )


def batch(hours: float, stations: int) -> tuple[float, float]:
    """Return CPU seconds of the fit, and of the poses after it."""
    observations = synthetic_observations(hours, stations)
    epochs_s = np.arange(observations.time_s[0], observations.time_s[-1], 1 / POSES_HZ)
    with Stopwatch() as fit:
        found = fit_trajectory(observations)
    with Stopwatch() as query:
        for first in range(0, len(epochs_s), 1024):
            found.trajectory.at(epochs_s[first : first + 1024], dim=6)
    return fit.cpu_s, query.cpu_s


def updates(stations: int) -> FloatArray:
    """Return CPU ms of each fixed-lag update: add one measurement, marginalise, predict."""
    observations = synthetic_observations(LIVE_S / 3600, stations)
    filtered = FixedLagSmoother(MotionPrior())
    took_ms: list[float] = []
    for row, time_s in enumerate(observations.time_s):
        with Stopwatch() as stopwatch:
            filtered.update(observations.select(slice(row, row + 1)))
            filtered.marginalise_before(time_s - LAG_S)
            if filtered.initialised:
                filtered.predict(time_s + AHEAD_S)
        took_ms.append(1e3 * stopwatch.cpu_s)
    return np.array(took_ms)


def main() -> None:
    """Print CPU time by duration and by number of stations."""
    hours_max = int(sys.argv[1]) if len(sys.argv) > 1 else HOURS
    print("3 stations: hours, CPU seconds of the fit, of poses at 20 Hz, both per hour, largest memory in MB")
    hours = 1
    while hours <= hours_max:
        fitted_s, asked_s = batch(hours, 3)
        memory_mb = peak_memory_mb()
        per_hour_s = (fitted_s + asked_s) / hours
        print(f"  {hours:3} {fitted_s:8.2f} {asked_s:8.2f} {per_hour_s:8.2f} {memory_mb:8.0f}", flush=True)
        hours *= 2
    print("a quarter of an hour: stations, CPU seconds of the fit, per station")
    for stations in range(len(LAYOUT), STATIONS + 1):
        fitted_s, _ = batch(0.25, stations)
        print(f"  {stations:3} {fitted_s:8.2f} {fitted_s / stations:8.3f}", flush=True)
    print("fixed lag of 3 s: stations, CPU ms per measurement, mean, p50, p99, largest")
    for stations in (3, 6):
        took_ms = updates(stations)
        p50, p99 = np.percentile(took_ms, [50, 99])
        print(f"  {stations:3} {took_ms.mean():8.2f} {p50:8.2f} {p99:8.2f} {took_ms.max():8.2f}", flush=True)
