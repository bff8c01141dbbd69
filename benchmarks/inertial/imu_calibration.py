"""Accuracy of `tsgt calibrate imu`: simulated missions with an unknown mounting, latency and device each.

    python benchmarks/run.py imu_calibration industrial|consumer [--seeds 40] [--first 0] [--duration 300] [--folder DIR]

Each mission has a device of its own, mounted anywhere in any orientation, and a latency of up to 50 ms; the robot is shaken
while it drives. The truth about the axes of a device is that at its mean temperature. Prints, per mission, the errors of rotation (deg), position (mm, the largest of x and y, and z) and latency
(ms), the same in stated sigmas (rotation and position: the largest component), and over all missions the rms, the largest
error, the share within two sigmas, and chi-square per component of rotation, position and latency together.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from harness.inertial.imu_calibration import in_calibrated_axes
from scipy.spatial.transform import Rotation

from tsgt.analysis.calibration import calibrate_recorded_imu
from tsgt.config import SimulatedImu, SuperframeMasterConfig
from tsgt.geometry import log_so3, rotation_from_quaternion
from tsgt.geometry.inertial import Mounting
from tsgt.geometry.inertial_calibration import ImuSetup
from tsgt.log import configure_logging
from tsgt.recording import load_recording, read_imu_samples
from tsgt.simulation.imu import IMU_MODELS
from tsgt.simulation.imu.device import ImuDevice
from tsgt.simulation.options import SimulationOptions
from tsgt.simulation.runner import simulate
from tsgt.simulation.scenario_files import find_scenario

if TYPE_CHECKING:
    from tsgt.config import ScenarioConfig
    from tsgt.geometry import FloatArray

LIMITS = {"rotation": 0.08, "horizontal": 4.0, "vertical": 7.0, "latency": 0.6}


def scenario_with_imu(name: str, model: str, seed: int) -> ScenarioConfig:
    """Return a scenario with a device, a mounting and a latency of the seed's."""
    rng = np.random.default_rng([seed, 7])
    quaternion = np.round(Rotation.random(random_state=rng.integers(2**31)).as_quat(), 5)
    imu = SimulatedImu.model_validate(
        {
            "model": model,
            "serial_number": seed,
            "position_m": tuple(np.round(rng.uniform([-0.5, -0.5, 0.0], [0.5, 0.5, 1.0]), 4).tolist()),
            "orientation_xyzw": tuple(quaternion.tolist()),
            "latency_ms": float(np.round(rng.uniform(0.0, 50.0), 3)),
        }
    )
    scenario = find_scenario(name)
    # The poses of the mission are not used.
    pipeline = scenario.pipeline.model_copy(update={"estimator": "linear"})
    return scenario.model_copy(update={"imu": imu, "pipeline": pipeline})


def recorded_mission(folder: Path, model: str, seed: int, duration_s: float) -> Path:
    """Return the recording of a mission that a folder holds; simulate it first if it holds none."""
    path = folder / f"{model}-{seed}.jsonl"
    if not path.exists():
        scenario = scenario_with_imu("dynamic", model, seed)
        options = SimulationOptions(
            duration_s=duration_s, protocol=SuperframeMasterConfig(kind="superframe"), seed=seed
        )
        with tempfile.TemporaryDirectory(dir=folder) as empty:
            run = simulate(scenario, options, folder=Path(empty))
            recording = run.master_logs[0].recording()
            if recording is None:
                raise SystemExit("the mission has no recording")
            recording.rename(path)
    return path


def calibrated(path: Path, model: str, seed: int) -> tuple[FloatArray, FloatArray]:
    """Calibrate; return errors and sigmas: rotation (3) in deg, position (3) in mm, latency in ms."""
    started_s = time.process_time()
    recording = load_recording(path)
    found = calibrate_recorded_imu(recording, read_imu_samples(path))
    cpu_s = time.process_time() - started_s
    configured = found.configured
    calibration = found.calibration
    device = ImuDevice.drawn(IMU_MODELS[model], seed)
    warming_k = float(device.warming_k(np.linspace(0.0, calibration.duration_s)).mean())
    gyro_matrix = device.gyro_matrix * (1.0 + device.gyro_scale_per_k * warming_k)
    accelerometer_matrix = device.accelerometer_matrix * (1.0 + device.accelerometer_scale_per_k * warming_k)
    exact = in_calibrated_axes(
        ImuSetup(
            Mounting(
                rotation_from_quaternion(np.array(configured.orientation_xyzw)),
                np.array(configured.position_m),
            ),
            configured.latency_ns / 1e9,
            np.asarray(np.linalg.inv(gyro_matrix), np.float64),
            np.asarray(np.linalg.inv(accelerometer_matrix), np.float64),
            np.zeros(3),
            calibration.setup.vertical,
        )
    )
    estimate = rotation_from_quaternion(np.array(found.parameters.orientation_xyzw))
    error = np.concatenate(
        [
            np.degrees(log_so3(estimate @ exact.mounting.rotation.T)),
            1e3 * (np.array(found.parameters.position_m) - configured.position_m),
            [(found.parameters.latency_ns - configured.latency_ns) / 1e6],
        ]
    )
    covariance = np.array(found.covariance.matrix)[:7, :7]
    order = [3, 4, 5, 0, 1, 2, 6]
    scale = np.array([180 / np.pi] * 3 + [1e3] * 4)
    sigmas = scale * np.sqrt(np.diag(covariance))[order]
    z = np.abs(error / sigmas)
    print(
        f"{seed:4d} rotation {np.linalg.norm(error[:3]):.3f} deg ({z[:3].max():.1f})  "
        f"position {np.abs(error[3:5]).max():.1f}, {abs(error[5]):.1f} mm ({z[3:6].max():.1f})  "
        f"latency {error[6]:+.2f} ms ({z[6]:.1f})  Birge {calibration.birge_ratio:.2f}, "
        f"log Bayes factor {calibration.log_bayes_factor:+.0f}, failed {found.failed_checks()}, {cpu_s:.1f} s",
        flush=True,
    )
    return error, sigmas


def main() -> None:
    """Run all missions, then print the summary."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", choices=["industrial", "consumer"])
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--duration", type=float, default=300.0)
    parser.add_argument("--folder", type=Path, help="keeps the recordings, and uses those that it holds")
    arguments = parser.parse_args()
    configure_logging("critical")
    found = []
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        with tempfile.TemporaryDirectory() as temporary:
            folder = arguments.folder or Path(temporary)
            path = recorded_mission(folder, arguments.model, seed, arguments.duration)
            found.append(calibrated(path, arguments.model, seed))
    errors, sigmas = np.array([each[0] for each in found]), np.array([each[1] for each in found])
    z = errors / sigmas
    for name, sizes, within in (
        ("rotation", np.linalg.norm(errors[:, :3], axis=1), z[:, :3]),
        ("horizontal", np.abs(errors[:, 3:5]).max(axis=1), z[:, 3:5]),
        ("vertical", np.abs(errors[:, 5]), z[:, 5:6]),
        ("latency", np.abs(errors[:, 6]), z[:, 6:]),
    ):
        print(
            f"{name:>10}: rms {np.sqrt(np.mean(sizes**2)):.3f}, largest {sizes.max():.3f}, "
            f"within {LIMITS[name]}: {np.mean(sizes <= LIMITS[name]):.0%}, "
            f"components within 2 sigmas: {np.mean(np.abs(within) < 2):.1%}, mean square {np.mean(within**2):.2f}"
        )


if __name__ == "__main__":
    main()
