"""Faults of the set-up that the live estimator with an IMU notices, with three, two and one stations.

    python benchmarks/run.py few_stations [--model industrial|consumer] [--scenario dynamic] [--seed 12]
        [--missions FOLDER]

A minute into a drive of two and a half, a tripod or prism moves without the estimator being told. Smoothed poses 3 s later are
compared with the truth from 5 s after the fault on; the layout monitor's figure is the lower quartile of the prisms' residuals, its
default limit 6 mm. Prints by fault and number of stations: the share of poses that are valid, their errors (rms of
the prisms' centroid) and stated sigmas, that quartile, and for how long poses were ambiguous right after the fault.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from inertial.imu import Mission, simulated
from tsgt.geometry import exp_so3, log_so3
from tsgt.geometry.inertial import InertialFixedLagSmoother
from tsgt.log import configure_logging
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.geometry import FloatArray
    from tsgt.geometry.trajectory import Observations

    # Where a prism seems to be in the world, from where it is, its station's position, the offset of
    # prism 3 from it in the robot, and the rotation of the robot.
    Fault = Callable[[FloatArray, FloatArray, FloatArray, FloatArray], FloatArray]

FAULT_S, END_S, LAG_S, STEP_S, TRANSPORT_S = 60.0, 150.0, 3.0, 0.5, 0.3
SETTLED_S = 5.0
MOVED_M = np.array([0.0141, 0.0141, 0.0])


def _moved(point: FloatArray, _station: FloatArray, _offset: FloatArray, _rotation: FloatArray) -> FloatArray:
    seen: FloatArray = point - MOVED_M
    return seen


def _turned(about: tuple[float, float, float]) -> Fault:
    turn = exp_so3(-np.array(about))

    def seen(
        point: FloatArray, station: FloatArray, _offset: FloatArray, _rotation: FloatArray
    ) -> FloatArray:
        found: FloatArray = station + turn @ (point - station)
        return found

    return seen


def _slipped(
    point: FloatArray, _station: FloatArray, _offset: FloatArray, rotation: FloatArray
) -> FloatArray:
    seen: FloatArray = point + rotation @ MOVED_M
    return seen


def _other_prism(
    point: FloatArray, _station: FloatArray, offset: FloatArray, rotation: FloatArray
) -> FloatArray:
    seen: FloatArray = point + rotation @ offset
    return seen


FAULTS: dict[str, tuple[int, Fault]] = {
    f"{what} {number}": (number - 1, fault)
    for number in (1, 2)
    for what, fault in {
        "20 mm: tripod": _moved,
        "0.5 mrad turned: tripod": _turned((0.0, 0.0, 5e-4)),
        "0.5 mrad tilted: tripod": _turned((5e-4, 0.0, 0.0)),
        "20 mm: prism": _slipped,
        "prism 3 tracked by": _other_prism,
    }.items()
}


def with_fault(mission: Mission, observations: Observations, station: int, fault: Fault) -> Observations:
    """Return the measurements that a fault of a station, by its row, leads to."""
    points = observations.points_m.copy()
    frame = observations.frames[station]
    for i in np.flatnonzero((observations.station == station) & (observations.time_s > FAULT_S)):
        row = min(int(np.searchsorted(mission.time_s, observations.time_s[i])), len(mission.time_s) - 1)
        offset = observations.layout[2] - observations.layout[observations.prism[i]]
        point = frame[:3, :3] @ points[i] + frame[:3, 3]
        seen = fault(point, frame[:3, 3], offset, mission.rotation[row])
        points[i] = frame[:3, :3].T @ (seen - frame[:3, 3])
    return replace(observations, points_m=points)


def smoothed_errors(mission: Mission, observations: Observations) -> FloatArray:
    """Return by instant, (N, 7): time, errors in m and rad, sigmas, rms residual of the prisms; NaN where not valid."""
    smoother = InertialFixedLagSmoother(mission.imu, MotionPrior(), reference_m=mission.centroid_m)
    samples, sample, done, found = mission.samples, 0, 0, []
    for now_s in np.arange(2.0, END_S, STEP_S).tolist():
        ending = int(np.searchsorted(samples.end_s, now_s))
        smoother.add_samples(samples.select(slice(sample, ending)))
        arrived = int(np.searchsorted(observations.time_s, now_s - TRANSPORT_S))
        if arrived > done:
            smoother.update(observations.select(slice(done, arrived)))
        sample, done = ending, max(done, arrived)
        found.append(_errors(mission, smoother, now_s - LAG_S))
        smoother.marginalise_before(now_s - LAG_S)
    return np.array(found)


def _errors(mission: Mission, smoother: InertialFixedLagSmoother, time_s: float) -> list[float]:
    at_s = np.array([time_s])
    unknown = [time_s, *[np.nan] * 5]
    if not (smoother.initialised and smoother.converged) or time_s <= smoother.reliable_from_s:
        return unknown
    if time_s >= smoother.ambiguous_from_s or smoother.ambiguous_at(at_s)[0] or smoother.observations is None:
        return unknown
    states, covariance = smoother.trajectory().at(at_s, dim=6)
    row = int(np.argmin(np.abs(mission.time_s - time_s)))
    rotation = mission.rotation[row]
    error = states.position[0] - mission.position_m[row] - rotation @ mission.centroid_m
    seen = smoother.observations
    squares = []
    for prism in np.unique(seen.prism):
        rows = np.flatnonzero(seen.prism == prism)
        near = rows[np.argsort(np.abs(seen.time_s[rows] - time_s))[:3]]
        squares.append(np.median((smoother.residuals_m[near] ** 2).sum(axis=1)))
    return [
        time_s,
        float(np.linalg.norm(error)),
        float(np.linalg.norm(log_so3(rotation.T @ states.rotation[0]))),
        float(np.sqrt(np.trace(covariance[0, :3, :3]))),
        float(np.sqrt(np.trace(covariance[0, 3:, 3:]))),
        float(np.sqrt(np.mean(squares))),
    ]


def row_of(name: str, stations: int, found: FloatArray) -> str:
    """Return one line of the table."""
    valid = np.isfinite(found[:, 1])
    after, just_after = found[:, 0] > FAULT_S + SETTLED_S, found[:, 0] > FAULT_S - LAG_S
    just_after &= found[:, 0] <= FAULT_S + SETTLED_S
    ambiguous_s = STEP_S * np.count_nonzero(just_after & ~valid)
    text = f"{name:<26} {stations} {valid[after].mean():7.0%} {ambiguous_s:7.1f}"
    some = found[after & valid]
    if not len(some):
        return f"{text}{'-':>9}{'-':>9}{'-':>9}{'-':>9}{'-':>9}"
    position, rotation = np.sqrt((some[:, 1:3] ** 2).mean(axis=0))
    sigma_m, sigma_rad = some[:, 3:5].mean(axis=0)
    return (
        f"{text} {1e3 * position:8.1f} {np.degrees(rotation):8.3f} {1e3 * sigma_m:8.1f} {np.degrees(sigma_rad):8.3f} "
        f"{1e3 * np.quantile(some[:, 5], 0.25):8.1f}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", choices=["industrial", "consumer"], default="industrial")
    parser.add_argument("--scenario", default="dynamic")
    parser.add_argument("--seed", type=int, default=12)
    parser.add_argument("--duration", type=float, default=END_S + 10.0, help="Of the mission in s.")
    parser.add_argument("--missions", type=Path)
    arguments = parser.parse_args()
    configure_logging("critical")
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.missions or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        mission = simulated(arguments, arguments.seed, folder)
    print(
        f"{'':<26} n   valid ambig.s   error mm      deg sigma mm      deg  res. mm   (n: number of stations)"
    )
    for name, (station, fault) in {"none": (3, _moved), **FAULTS}.items():
        for stations in (3, 2, 1):
            if name != "none" and station >= stations:
                continue
            observations = mission.observations
            observations = observations.select(
                (observations.station < stations) & (observations.time_s < END_S)
            )
            if name != "none":
                observations = with_fault(mission, observations, station, fault)
            # Station k follows prism k; a set-up has no other ones than its stations follow.
            observations = replace(observations, layout=observations.layout[:stations])
            print(row_of(name, stations, smoothed_errors(mission, observations)), flush=True)


if __name__ == "__main__":
    main()
