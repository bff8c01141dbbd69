"""Accuracy of poses with an IMU, post-processed: three, two and one stations, the gyro alone, outages; CPU time.

    python benchmarks/run.py imu [--model industrial|consumer] [--scenario dynamic] [--seeds 4] [--first 12]
        [--duration 600] [--outage SECONDS] [--odometry] [--spin] [--variants N] [--missions FOLDER]

Simulates missions with an IMU of their own each, whose mounting, latency and gyro matrix are known exactly, in the axes that
`tsgt calibrate imu` defines; the robot is shaken while it drives. Fits
each recording without the IMU and with it, from the measurements of three, two and one stations, and compares poses 20
times a second with the truth. Two seconds at either end are left out. Prints rms errors of the robot's origin, of the prisms'
centroid and of the rotation; mean NEES of the centroid's poses (6 expected) and the share above 22.5 (0.001
expected); CPU seconds of fit and poses. --outage: all measurements are missing for so long, once a minute; the errors are
those inside. --odometry: with wheel odometry, too; --spin: whose speed is 10 % too high for two seconds of each outage, from a second
after its start on. --variants: the first so many rows alone. --missions: keep the missions' recordings in a folder, and use those that it holds.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from harness.inertial.imu_calibration import in_calibrated_axes

from tsgt.config import SuperframeMasterConfig
from tsgt.errors import GeometryError
from tsgt.estimation.inertial import inertial_samples, wheel_samples
from tsgt.estimation.observations import build_observations, centroid_m
from tsgt.geometry import log_so3, quaternion_from_rotation
from tsgt.geometry.batch import fit_trajectory
from tsgt.geometry.inertial import Mounting, fit_inertial_trajectory
from tsgt.geometry.inertial_calibration import ImuSetup
from tsgt.log import configure_logging
from tsgt.model import MotionPrior
from tsgt.recording import load_recording
from tsgt.simulation.imu import IMU_MODELS
from tsgt.simulation.imu.device import ImuDevice
from tsgt.simulation.options import SimulationOptions
from tsgt.simulation.runner import simulate
from tsgt.simulation.scenario_files import find_scenario

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray
    from tsgt.geometry.inertial import InertialSamples, InertialTrajectory, WheelSamples
    from tsgt.geometry.trajectory import Observations, Trajectory
    from tsgt.model import ImuParameters, OdometryParameters

POSES_HZ = 20.0
MARGIN_S = 2.0
OUTAGE_PERIOD_S = 60.0
SPIN, SPIN_FROM_S, SPIN_S = 1.1, 1.0, 2.0
NEES_LIMIT = 22.5  # Exceeded by 1 in 1000 of chi-square with 6 degrees of freedom
VARIANTS = (
    ("no IMU, 3 stations", 3, None),
    ("3 stations", 3, "imu"),
    ("2 stations", 2, "imu"),
    ("1 station", 1, "imu"),
    ("gyro alone, 3 stations", 3, "gyro"),
    ("gyro alone, 2 stations", 2, "gyro"),
)


class Mission(NamedTuple):
    """What a fit takes, and the truth."""

    observations: Observations
    arrival_s: FloatArray  # (M,) of the measurements at the master
    samples: InertialSamples
    line_arrival_s: FloatArray  # (N,) of each sample's line
    imu: ImuParameters
    wheels: WheelSamples
    wheels_arrival_s: FloatArray  # (N,) of each sample's line
    odometry: OdometryParameters | None  # None: not to be used
    centroid_m: FloatArray
    time_s: FloatArray  # (N,) epochs
    position_m: FloatArray  # (N, 3) true position of the origin
    rotation: FloatArray  # (N, 3, 3)


def mission_stem(arguments: argparse.Namespace, seed: int) -> str:
    """Return the name of a mission's files in a folder."""
    return f"{arguments.scenario}-{arguments.model}-wheels-{seed}-{arguments.duration:.0f}"


def simulated(
    arguments: argparse.Namespace, seed: int, folder: Path, *, odometry: bool = False, spin: bool = False
) -> Mission:
    """Simulate a mission, or read the one that the folder holds."""
    stem = mission_stem(arguments, seed)
    recording, truth = folder / f"{stem}.jsonl", folder / f"{stem}.npz"
    if not truth.exists():
        scenario = find_scenario(arguments.scenario)
        # A device of its own in each mission: errors of one device's axes are the same in all of them.
        imu = scenario.imu.model_copy(update={"model": arguments.model, "serial_number": seed})
        # The poses of the mission are not used.
        pipeline = scenario.pipeline.model_copy(update={"estimator": "linear"})
        scenario = scenario.model_copy(update={"imu": imu, "pipeline": pipeline, "odometry": True})
        options = SimulationOptions(
            duration_s=arguments.duration, protocol=SuperframeMasterConfig(kind="superframe"), seed=seed
        )
        with tempfile.TemporaryDirectory() as name:
            run = simulate(scenario, options, folder=Path(name))
            path = run.master_logs[0].recording()
            if path is None or run.imu is None:
                raise SystemExit("the mission has no recording")
            recording.write_bytes(path.read_bytes())
        time_s = np.arange(1.0, arguments.duration - 0.5, 1 / POSES_HZ)
        np.savez(truth, time_s=time_s, poses=run.true_poses(time_s), start_ns=run.start_ns)
    known = np.load(truth)
    loaded = load_recording(recording, imu=True)
    imu_parameters = loaded.parameters.imu
    if imu_parameters is None:
        raise SystemExit(f"{recording} has no IMU")
    imu_parameters = calibrated(imu_parameters, ImuDevice.drawn(IMU_MODELS[arguments.model], seed))
    origin_ns = int(known["start_ns"])
    observations, sources = build_observations(loaded.parameters, loaded.measurements, origin_ns=origin_ns)
    records = loaded.imu_samples
    samples = inertial_samples(records, imu_parameters, origin_ns)
    arrivals_ns = [record.received_ns for record in records for _ in record.stamp_ns]
    poses = known["poses"]
    if loaded.parameters.odometry is None:
        raise SystemExit(f"{recording} has no odometry")
    wheels = wheel_samples(loaded.odometry, loaded.parameters.odometry, origin_ns)
    wheels_arrivals_ns = [record.received_ns for record in loaded.odometry for _ in record.stamp_ns]
    if spin:
        phase_s = np.mod(wheels.end_s, OUTAGE_PERIOD_S) - 0.5 * OUTAGE_PERIOD_S
        spinning = (phase_s > SPIN_FROM_S) & (phase_s < SPIN_FROM_S + SPIN_S)
        wheels = replace(wheels, speed_mps=np.where(spinning, SPIN, 1.0) * wheels.speed_mps)
    return Mission(
        observations,
        np.array([source.received_ns - origin_ns for source in sources]) / 1e9,
        samples,
        (np.array(arrivals_ns)[: len(samples)] - origin_ns) / 1e9,
        imu_parameters,
        wheels,
        (np.array(wheels_arrivals_ns)[: len(wheels)] - origin_ns) / 1e9,
        loaded.parameters.odometry if odometry else None,
        centroid_m(loaded.parameters),
        known["time_s"],
        poses[:, :3, 3],
        poses[:, :3, :3],
    )


def calibrated(exact: ImuParameters, device: ImuDevice) -> ImuParameters:
    """Return the exact set-up of a device in the axes that a calibration defines."""
    mounting = Mounting.of(exact, np.zeros(3))
    setup = in_calibrated_axes(
        ImuSetup(
            mounting,
            exact.latency_ns / 1e9,
            np.asarray(np.linalg.inv(device.gyro_matrix), np.float64),
            np.asarray(np.linalg.inv(device.accelerometer_matrix), np.float64),
            np.zeros(3),
            mounting.rotation[2].copy(),
        )
    )
    qx, qy, qz, qw = quaternion_from_rotation(setup.mounting.rotation).tolist()
    first, second, third = ((a, b, c) for a, b, c in setup.gyro_matrix.tolist())
    return replace(exact, orientation_xyzw=(qx, qy, qz, qw), gyro_matrix=(first, second, third))


def fitted(mission: Mission, observations: Observations, kind: str | None) -> Trajectory | InertialTrajectory:
    """Fit a trajectory without the IMU (kind None), with it, or with its gyro alone."""
    if kind is None:
        return fit_trajectory(observations).trajectory
    return fit_inertial_trajectory(
        observations,
        mission.samples,
        mission.imu,
        reference_m=mission.centroid_m,
        gyro_only=MotionPrior() if kind == "gyro" else None,
        odometry=None if mission.odometry is None else (mission.wheels, mission.odometry),
    ).trajectory


def evaluate(mission: Mission, stations: int, kind: str | None, outage_s: float) -> FloatArray:
    """Squared errors of origin and centroid in m^2, of rotation in rad^2, NEES, each (N,); CPU in s, twice: (6, N)."""
    observations = mission.observations.select(mission.observations.station < stations)
    first_s, last_s = observations.time_s[0] + MARGIN_S, observations.time_s[-1] - MARGIN_S
    rows = (mission.time_s > first_s) & (mission.time_s < last_s)
    if outage_s:
        # From the middle of each minute on.
        observations = observations.select(~missing(observations.time_s, outage_s))
        rows &= missing(mission.time_s, outage_s)
    started_s = time.process_time()
    trajectory = fitted(mission, observations, kind)
    fitted_s = time.process_time()
    time_s, true_position, true_rotation = (
        mission.time_s[rows],
        mission.position_m[rows],
        mission.rotation[rows],
    )
    states, covariance = trajectory.at(time_s, dim=6)
    ended_s = time.process_time()
    rotation_error = log_so3(np.swapaxes(true_rotation, 1, 2) @ states.rotation)
    centroid_error = states.position - true_position - true_rotation @ mission.centroid_m
    origin_error = states.position - states.rotation @ mission.centroid_m - true_position
    error = np.concatenate([centroid_error, rotation_error], axis=1)
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])
    squares = [(each**2).sum(axis=1) for each in (origin_error, centroid_error, rotation_error)]
    cpu_s = np.ones_like(nees)
    return np.array([*squares, nees, (fitted_s - started_s) * cpu_s, (ended_s - fitted_s) * cpu_s])


def missing(time_s: FloatArray, outage_s: float, period_s: float = OUTAGE_PERIOD_S) -> NDArray[np.bool_]:
    """Whether measurements at times are missing."""
    phase_s = np.mod(time_s, period_s) - 0.5 * period_s
    found: NDArray[np.bool_] = (phase_s > 0) & (phase_s < outage_s)
    return found


def row(name: str, found: FloatArray) -> str:
    """Return one line of the table."""
    rms = np.sqrt(found[:3].mean(axis=1)) * [1e3, 1e3, 180 / np.pi]
    p95 = np.sqrt(np.quantile(found[1], 0.95)) * 1e3
    return (
        f"{name:<24} {rms[0]:8.2f} {rms[1]:8.2f} {p95:8.2f} {rms[2]:8.3f} {found[3].mean():8.1f} "
        f"{(found[3] > NEES_LIMIT).mean():8.4f} {found[4].mean():8.2f} {found[5].mean():8.2f}"
    )


def mission_parser(description: str | None, variants: int) -> argparse.ArgumentParser:
    """Return the parser of what a table of missions needs; of this one and of imu_live."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", choices=["industrial", "consumer"], default="industrial")
    parser.add_argument("--scenario", default="dynamic")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first", type=int, default=12)
    parser.add_argument("--duration", type=float, default=600.0)
    parser.add_argument("--outage", type=float, default=0.0)
    parser.add_argument("--variants", type=int, default=variants)
    parser.add_argument("--odometry", action="store_true")
    parser.add_argument("--spin", action="store_true")
    parser.add_argument("--missions", type=Path)
    return parser


def main() -> None:
    """Print the table of each mission, and that of all."""
    arguments = mission_parser(__doc__, len(VARIANTS)).parse_args()
    configure_logging("critical")
    head = (
        f"{'':<24} {'origin':>8} {'centroid':>8} {'p95':>8} {'rotation':>8} {'NEES':>8} "
        f"{'> 22.5':>8} {'fit':>8} {'poses':>8}\n{'':<24} {'mm':>8} {'mm':>8} {'mm':>8} {'deg':>8} {'':>8} "
        f"{'':>8} {'CPU s':>8} {'CPU s':>8}"
    )
    total: dict[str, list[FloatArray]] = {name: [] for name, _, _ in VARIANTS}
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.missions or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            mission = simulated(arguments, seed, folder, odometry=arguments.odometry, spin=arguments.spin)
            print(f"seed {seed}\n{head}")
            for name, stations, kind in VARIANTS[: arguments.variants]:
                try:
                    found = evaluate(mission, stations, kind, arguments.outage)
                except GeometryError as error:
                    print(f"{name:<24} {error}", flush=True)
                    continue
                total[name].append(found)
                print(row(name, found), flush=True)
    print(f"all {arguments.seeds} missions, {arguments.scenario}, {arguments.model}\n{head}")
    for name, each in total.items():
        if each:
            print(row(name, np.concatenate(each, axis=1)))


if __name__ == "__main__":
    main()
