"""Accuracy of live poses with an IMU, at the time of sending: three, two and one stations, the gyro alone, outages; CPU time.

    python benchmarks/run.py imu_live [--model industrial|consumer] [--scenario dynamic] [--seeds 4] [--first 12]
        [--duration 600] [--outage SECONDS] [--line SAMPLES] [--odometry] [--spin] [--variants N] [--missions FOLDER]

The missions of the benchmark imu. Measurements and lines of samples reach the smoother when they reached the master; four times
a second (20 times in outages) the pose of that epoch is predicted and compared with the truth, from ten seconds after the
start on. Prints rms errors of the robot's origin, of the prisms' centroid and of the rotation, 95 % quantiles; mean NEES (6 expected) and
the share above 22.5 (0.001 expected); the share of epochs with a pose that is not ambiguous; how old the newest sample is; and
CPU time: of an update (a measurement with all that comes of it), median and 99 % quantile, and of a prediction, median.
--outage: all measurements are missing for so long, once in a minute (each 20 s up to 3 s); the errors are those inside. --line: samples come
in lines of so many, 3 ms after the last one of a line, instead of as recorded. --odometry, --spin,
--variants: as of the benchmark imu.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from inertial.imu import NEES_LIMIT, Mission, missing, mission_parser, simulated
from tsgt.geometry import log_so3
from tsgt.geometry.inertial import InertialFixedLagSmoother
from tsgt.log import configure_logging
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    import argparse

    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray

LAG_S, MARGINALISE_EACH = 3.0, 10  # Epochs
PREDICT_EACH = 5  # Epochs, 0.25 s: not in step with the rounds of measurements, 0.4 s
START_S = 10.0
LINE_DELAY_S = 0.003
VARIANTS = (
    ("3 stations", 3, False),
    ("2 stations", 2, False),
    ("1 station", 1, False),
    ("gyro alone, 3 stations", 3, True),
)


class Live(NamedTuple):
    """Errors at epochs with a pose, (N,) each, and what it cost."""

    origin_m: FloatArray  # of the robot
    position_m: FloatArray  # of the prisms' centroid
    rotation_rad: FloatArray
    nees: FloatArray
    age_s: FloatArray
    available: FloatArray  # (E,) of all epochs
    update_s: FloatArray
    predict_s: FloatArray


def outages(time_s: FloatArray, outage_s: float) -> NDArray[np.bool_]:
    """Whether measurements at times are missing."""
    return missing(time_s, outage_s, 20.0) if outage_s <= 3.0 else missing(time_s, outage_s)


def run(mission: Mission, stations: int, arguments: argparse.Namespace, *, gyro_only: bool) -> Live:
    """Replay a mission."""
    rows = mission.observations.station < stations
    if arguments.outage:
        rows &= ~outages(mission.observations.time_s, arguments.outage)
    order = np.flatnonzero(rows)[np.argsort(mission.arrival_s[rows], kind="stable")]
    observations, arrival_s = mission.observations.select(order), mission.arrival_s[order]
    # With a layout of others, a prism measured alone would have to be confirmed by them.
    observations = replace(observations, layout=observations.layout[:stations])
    samples, sampled_s = mission.samples, mission.line_arrival_s
    if arguments.line:
        last = np.minimum((np.arange(len(samples)) // arguments.line + 1) * arguments.line, len(samples)) - 1
        sampled_s = samples.end_s[last] + LINE_DELAY_S
    window = InertialFixedLagSmoother(
        mission.imu,
        MotionPrior(),
        reference_m=mission.centroid_m,
        gyro_only=gyro_only,
        odometry=mission.odometry,
    )
    states, covariances, epochs, ages, available, update_s, predict_s = [], [], [], [], [], [], []
    taken = added = driven = 0
    first_s = np.inf
    for number, now_s in enumerate(mission.time_s):
        stop = int(np.searchsorted(sampled_s, now_s, side="right"))
        window.add_samples(samples.select(slice(added, stop)))
        added = stop
        stop = int(np.searchsorted(mission.wheels_arrival_s, now_s, side="right"))
        window.add_odometry(mission.wheels.select(slice(driven, stop)))
        driven = stop
        until = int(np.searchsorted(arrival_s, now_s, side="right"))
        for row in range(taken, until):
            started_s = time.thread_time()
            window.update(observations.select(slice(row, row + 1)))
            update_s.append(time.thread_time() - started_s)
        taken = until
        if number % MARGINALISE_EACH == 0:
            window.marginalise_before(now_s - LAG_S)
        has_pose = window.converged and not window.ambiguous
        if has_pose:
            first_s = min(first_s, now_s)
        wanted = outages(now_s, arguments.outage) if arguments.outage else number % PREDICT_EACH == 0
        if now_s < first_s + START_S or not wanted:
            continue
        available.append(has_pose)
        if has_pose:
            started_s = time.thread_time()
            state, covariance = window.predict(now_s)
            predict_s.append(time.thread_time() - started_s)
            states.append((state.position[0], state.rotation[0]))
            covariances.append(covariance[0])
            epochs.append(number)
            ages.append(now_s - samples.end_s[added - 1])
    true_rotation = mission.rotation[epochs]
    found, found_rotation = (np.array(each) for each in zip(*states, strict=True))
    position = found - true_rotation @ mission.centroid_m - mission.position_m[epochs]
    origin = found - found_rotation @ mission.centroid_m - mission.position_m[epochs]
    rotation = log_so3(np.swapaxes(true_rotation, 1, 2) @ found_rotation)
    error = np.concatenate([position, rotation], axis=1)
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(np.array(covariances), error[:, :, None])[:, :, 0])
    lengths = np.linalg.norm(error.reshape(-1, 2, 3), axis=2)
    rest = (np.array(each, dtype=np.float64) for each in (ages, available, update_s, predict_s))
    return Live(np.linalg.norm(origin, axis=1), lengths[:, 0], lengths[:, 1], nees, *rest)


def line(name: str, found: Live) -> str:
    """Return one line of the table."""
    rms_mm, p95_mm, rms_deg, p95_deg = (
        scale * value
        for scale, each in ((1e3, found.position_m), (180 / np.pi, found.rotation_rad))
        for value in (np.sqrt((each**2).mean()), np.quantile(each, 0.95))
    )
    return (
        f"{name:<24} {1e3 * np.sqrt((found.origin_m**2).mean()):8.2f} {rms_mm:8.2f} {p95_mm:8.2f} {rms_deg:8.3f} {p95_deg:8.3f} {found.nees.mean():8.1f} "
        f"{(found.nees > NEES_LIMIT).mean():8.4f} {found.available.mean():8.4f} {1e3 * found.age_s.mean():8.0f} "
        f"{1e3 * np.median(found.update_s):8.1f} {1e3 * np.quantile(found.update_s, 0.99):8.1f} "
        f"{1e3 * np.median(found.predict_s):8.2f}"
    )


def main() -> None:
    """Print the table of each mission, and that of all."""
    parser = mission_parser(__doc__, len(VARIANTS))
    parser.add_argument("--line", type=int, default=0)
    arguments = parser.parse_args()
    configure_logging("critical")
    head = "\n".join(
        " ".join(f"{each:>8}" for each in ("", "", "", *names))[2:]
        for names in (
            (
                "origin",
                "centroid",
                "p95",
                "rotation",
                "p95",
                "NEES",
                "> 22.5",
                "poses",
                "age",
                "update",
                "p99",
                "predict",
            ),
            ("mm", "mm", "mm", "deg", "deg", "", "", "", "ms", "ms", "ms", "ms"),
        )
    )
    total: dict[str, list[Live]] = {name: [] for name, *_ in VARIANTS}
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.missions or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            mission = simulated(arguments, seed, folder, odometry=arguments.odometry, spin=arguments.spin)
            print(f"seed {seed}\n{head}")
            for name, stations, gyro_only in VARIANTS[: arguments.variants]:
                total[name].append(run(mission, stations, arguments, gyro_only=gyro_only))
                print(line(name, total[name][-1]), flush=True)
    print(f"all {arguments.seeds} missions, {arguments.scenario}, {arguments.model}\n{head}")
    for name, each in total.items():
        if each:
            print(line(name, Live(*(np.concatenate(values) for values in zip(*each, strict=True)))))


if __name__ == "__main__":
    main()
