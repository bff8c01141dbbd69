"""Wrong set-ups of the IMU: how soon the monitor names them, and how often it names a right one.

    python benchmarks/run.py imu_setup industrial|consumer [--seeds 40] [--first 0] [--folder DIR]

Missions as in imu_calibration. Per error: how many missions have an event with its cause within 60 s of the first measurement, the time
to that event (s), and the events with another cause. Of the whole missions without error: the events with a cause.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from inertial.imu_calibration import recorded_mission
from tsgt.estimation import ImuSetupMonitor
from tsgt.log import configure_logging
from tsgt.model import ImuSamples
from tsgt.recording import load_recording, read_imu_samples

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.geometry import FloatArray
    from tsgt.model import ImuParameters, Measurement, Parameters
    from tsgt.recording import EventRecord

START_NS, DURATION_NS = 60_000_000_000, 64_000_000_000
"""Part of a mission with a wrong set-up; the monitor waits 4 s for a result."""


def turned(imu: ImuParameters, rng: np.random.Generator) -> ImuParameters:
    """Turn the mounting by a degree about any axis."""
    turn = Rotation.from_rotvec(np.radians(direction(rng)))
    x, y, z, w = (turn * Rotation.from_quat(imu.orientation_xyzw)).as_quat().tolist()
    return replace(imu, orientation_xyzw=(x, y, z, w))


def displaced(imu: ImuParameters, rng: np.random.Generator) -> ImuParameters:
    """Move the lever arm by 100 mm along any axis."""
    x, y, z = (np.array(imu.position_m) + 0.1 * direction(rng)).tolist()
    return replace(imu, position_m=(x, y, z))


def late(imu: ImuParameters, rng: np.random.Generator) -> ImuParameters:
    """Set the clock 10 ms off."""
    return replace(imu, latency_ns=imu.latency_ns + int(rng.choice([-1, 1])) * 10_000_000)


def direction(rng: np.random.Generator) -> FloatArray:
    """Return a unit vector, (3,)."""
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


CONFIGURED = {
    "mounting 1 deg off": (turned, "mounting of the IMU is wrong"),
    "lever arm 100 mm off": (displaced, "position of the IMU is wrong"),
    "clock 10 ms off": (late, "latency of the IMU is wrong"),
}
SWAPPED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
SAMPLED = {
    "axes swapped": (SWAPPED, SWAPPED, "axes of the IMU are swapped"),
    "two axes exchanged": (np.eye(3)[[1, 0, 2]], np.eye(3)[[1, 0, 2]], "left-handed"),
    "degrees per second": (np.eye(3) * 180 / np.pi, np.eye(3), "degrees per second"),
    "multiples of g": (np.eye(3), np.eye(3) / 9.80665, "g instead of m/s^2"),
    "gravity's sign": (np.eye(3), -np.eye(3), "wrong sign"),
}


def multiplied(record: ImuSamples, rates: FloatArray, forces: FloatArray) -> ImuSamples:
    """Multiply samples by matrices."""
    return replace(
        record,
        angular_rate_radps=tuple(map(tuple, (np.array(record.angular_rate_radps) @ rates.T).tolist())),
        specific_force_mps2=tuple(map(tuple, (np.array(record.specific_force_mps2) @ forces.T).tolist())),
    )


def monitored(parameters: Parameters, arrivals: Sequence[Measurement | ImuSamples]) -> list[EventRecord]:
    """Return the events of a drive."""
    monitor = ImuSetupMonitor(parameters)
    for record in arrivals:
        if isinstance(record, ImuSamples):
            monitor.samples(record)
        else:
            monitor.measurement(record)
    return list(monitor.take_events())


def mission(folder: Path, model: str, seed: int, found: dict[str, list[tuple[float | None, int]]]) -> str:
    """Monitor one mission with each error and with none; add times and other events, return the events of a right set-up."""
    path = recorded_mission(folder, model, seed, 300.0)
    recording = load_recording(path)
    parameters = recording.parameters
    assert parameters.imu is not None  # noqa: S101 (each mission has one)
    records: list[Measurement | ImuSamples] = [*recording.measurements, *read_imu_samples(path)]
    records.sort(key=lambda each: each.received_ns)
    first_ns = min(each.received_ns for each in recording.measurements)
    begin_ns = first_ns + START_NS
    part = [each for each in records if begin_ns <= each.received_ns <= begin_ns + DURATION_NS]
    rng = np.random.default_rng([seed, 9])

    def count(name: str, expected: str, parameters: Parameters, part: list[Measurement | ImuSamples]) -> None:
        events = [each for each in monitored(parameters, part) if each.event == "imu_setup_wrong"]
        named = [each for each in events if expected in each.message]
        noticed_s = (named[0].stamp_ns - begin_ns) / 1e9 if named else None
        found.setdefault(name, []).append((noticed_s, len(events) - len(named)))

    for name, (change, expected) in CONFIGURED.items():
        count(name, expected, replace(parameters, imu=change(parameters.imu, rng)), part)
    for name, (rates, forces, expected) in SAMPLED.items():
        samples = [multiplied(each, rates, forces) if isinstance(each, ImuSamples) else each for each in part]
        count(name, expected, parameters, samples)
    events = monitored(parameters, records)
    confirmed = [(each.stamp_ns - first_ns) / 1e9 for each in events if each.event == "imu_setup_confirmed"]
    false = [each.message for each in events if each.event == "imu_setup_wrong"]
    found.setdefault("right", []).append((confirmed[0] if confirmed else None, len(false)))
    return "; ".join(false)


def main() -> None:
    """Run all missions, then print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", choices=["industrial", "consumer"])
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--folder", type=Path, help="keeps the recordings, and uses those that it holds")
    arguments = parser.parse_args()
    configure_logging("critical")
    found: dict[str, list[tuple[float | None, int]]] = {}
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        with tempfile.TemporaryDirectory() as temporary:
            started_s = time.process_time()
            false = mission(arguments.folder or Path(temporary), arguments.model, seed, found)
            times = " ".join("-" if each[-1][0] is None else f"{each[-1][0]:.0f}" for each in found.values())
            print(f"{seed:4d} {times}  {false}  {time.process_time() - started_s:.0f} s", flush=True)
    for name, each in found.items():
        noticed_s = [seconds for seconds, _ in each if seconds is not None]
        print(
            f"{name:>20}: {len(noticed_s)} of {len(each)}, median {np.median(noticed_s):.0f} s, "
            f"largest {max(noticed_s):.0f} s, other causes {sum(others for _, others in each)}"
        )


if __name__ == "__main__":
    main()
