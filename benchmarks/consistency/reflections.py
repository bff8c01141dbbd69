"""Effect of one reflection of centimetres on the live poses of robots drawn from the motion prior.

One measurement of three prisms, each measured at a rate, is displaced by 4 to 30 cm in a random direction. For each kind of
pose that would be sent as valid (sigmas within the default limits at the prisms' centroid, state not ambiguous): the number of
robots with a squared error (NEES of 6) above 38.3 and above 60 and, among those, the largest position error. Once with the
reflection and once without. ``predicted``: from its arrival to two seconds later, at each new measurement and half way to the
next one. ``smoothed``: as after all measurements, within 0.4 s of the reflection.

    python benchmarks/run.py reflections [ROBOTS [RATE_HZ ...]]
"""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from harness.drives.prior_motion import STEP_S, draw_motions, measure, rows_at, sorted_by_time
from measuring import normalised_squared

from tsgt.geometry.trajectory import FixedLagSmoother
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray
    from tsgt.geometry.trajectory import Observations, States

ROBOTS = 60
RATES_HZ = (2.5, 1.2, 1.0)
UNTIL_S, REFLECTED_S, AFTER_S, NEAR_S, LAG_S = 9.8, 4.8, 2.5, 0.4, 3.0
SMALLEST_M, LARGEST_M = 0.04, 0.3
LIMITS = {"predicted": (0.15, np.radians(5.0)), "smoothed": (0.05, np.radians(2.0))}
SQUARES = (38.3, 60.0)


def reflected(measured: Observations, seed: int) -> tuple[Observations, int]:
    """Displace one measurement, made about five seconds after the first; return its row too."""
    random = np.random.default_rng(seed)
    row = int(np.searchsorted(measured.time_s, REFLECTED_S)) + int(random.integers(3))
    off_m = random.normal(size=3)
    off_m *= np.exp(random.uniform(np.log(SMALLEST_M), np.log(LARGEST_M))) / np.linalg.norm(off_m)
    points_m = measured.points_m.copy()
    points_m[row] += off_m
    return replace(measured, points_m=points_m), row


def judged(
    kind: str, motion: States, at_s: FloatArray, states: States, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return squared errors, and position errors in m, of the poses within the limits."""
    error = motion.select(rows_at(at_s)).local_coordinates_about(states)[:, :6]
    position_m, rotation_rad = LIMITS[kind]
    within: NDArray[np.bool_] = (np.sqrt(np.linalg.eigvalsh(covariance[:, :3, :3])[:, -1]) <= position_m) & (
        np.sqrt(np.linalg.eigvalsh(covariance[:, 3:, 3:])[:, -1]) <= rotation_rad
    )
    return normalised_squared(error, covariance)[within], np.linalg.norm(error[within, :3], axis=1)


def live(motion: States, measured: Observations, row: int) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Estimate as measurements arrive; return squared errors and position errors of valid poses."""
    smoother, predicted = FixedLagSmoother(MotionPrior()), []
    time_s = measured.time_s
    last = int(np.searchsorted(time_s, time_s[row] + AFTER_S))
    for each in range(last):
        smoother.update(measured.select(slice(each, each + 1)))
        smoother.marginalise_before(time_s[each] - LAG_S)
        if each < row or smoother.ambiguous:
            continue
        for instant_s in {float(time_s[each]), float(time_s[each] + time_s[each + 1]) / 2}:
            rounded_s = np.array([np.ceil(instant_s / STEP_S) * STEP_S])
            state, covariance = smoother.predict(float(rounded_s[0]), dim=6)
            predicted.append(judged("predicted", motion, rounded_s, state, covariance))
    first = np.ceil((time_s[row] - NEAR_S) / STEP_S)
    at_s = STEP_S * np.arange(first, np.floor((time_s[row] + NEAR_S) / STEP_S) + 1)
    at_s = at_s[~smoother.ambiguous_at(at_s) & (at_s < smoother.ambiguous_from_s)]
    states, covariance = smoother.trajectory().at(at_s, dim=6)
    squares, errors_m = zip(*predicted, strict=True) if predicted else ((np.empty(0),), (np.empty(0),))
    return {
        "predicted": (np.concatenate(squares), np.concatenate(errors_m)),
        "smoothed": judged("smoothed", motion, at_s, states, covariance),
    }


def main() -> None:
    """Print a row per rate and kind of pose."""
    robots = int(sys.argv[1]) if len(sys.argv) > 1 else ROBOTS
    print(
        f"| {robots} robots, rate per prism | poses | reflection | robots above 38.3 | above 60 | largest error above 38.3, mm |"
    )
    print("|---|---|---|---|---|---|")
    for rate_hz in [float(each) for each in sys.argv[2:]] or RATES_HZ:
        found: dict[tuple[str, str], list[tuple[FloatArray, FloatArray]]] = {}
        for seed in range(robots):
            (motion,) = draw_motions(MotionPrior(), count=1, duration_s=UNTIL_S + 0.7, seed=seed)
            right = sorted_by_time(measure(motion, until_s=UNTIL_S, rate_hz=rate_hz, seed=seed))
            wrong, row = reflected(right, seed)
            for name, measured in (("yes", wrong), ("no", right)):
                for kind, each in live(motion, measured, row).items():
                    found.setdefault((kind, name), []).append(each)
        for (kind, name), drives in sorted(found.items()):
            above = [sum(bool((squares > limit).any()) for squares, _ in drives) for limit in SQUARES]
            largest_m = max(
                (float(e[s > SQUARES[0]].max()) for s, e in drives if (s > SQUARES[0]).any()), default=0.0
            )
            print(
                f"| {rate_hz:g} Hz | {kind} | {name} | {above[0]} | {above[1]} | {1e3 * largest_m:.0f} |",
                flush=True,
            )
