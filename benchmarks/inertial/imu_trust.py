"""Wrong set-ups of the IMU in the live estimator: what poses say before, between and after its events.

    python benchmarks/run.py imu_trust [--model industrial|consumer] [--scenario dynamic] [--seeds 2] [--first 12] [--stations 3]
        [--until 90] [--errors NAME ...] [--missions FOLDER]

The missions of the benchmark imu, replayed as they arrived to a live estimator whose IMU is set up wrongly, as in the
benchmark imu_setup, or whose station 1 moves 60 s after the first measurement (by 10, 20 or 50 mm, 0.5 mrad; named: the first pose that is
`contradicted`, or degraded by `imu_disagrees`). Per error: when the IMU is confirmed and when an event names a cause (s after the first measurement); then for
predicted and for smoothed poses, over the whole drive: the share that is valid, the share of these that rests on the IMU, rms errors of
the prisms' centroid in mm and of the rotation in degrees, mean NEES, and the share of valid poses whose position or rotation is beyond
three sigmas (0.0027 expected of each).
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from inertial.imu import mission_stem, simulated
from inertial.imu_setup import CONFIGURED, SAMPLED, multiplied
from tsgt.estimation import LiveEstimator, centroid_at_point
from tsgt.geometry import log_so3, rotation_from_quaternion
from tsgt.log import configure_logging
from tsgt.model import ImuSamples, PolarMeasurement
from tsgt.recording import PoseRecord, load_recording, read_imu_samples

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tsgt.geometry import FloatArray
    from tsgt.model import Measurement, Parameters
    from tsgt.recording import EventRecord

FAULT_NS = 60_000_000_000


def turned(measurement: PolarMeasurement) -> PolarMeasurement:
    """Turn the tripod by 0.5 mrad."""
    return replace(measurement, horizontal_angle_rad=measurement.horizontal_angle_rad + 5e-4)


def tilted(measurement: PolarMeasurement) -> PolarMeasurement:
    """Tilt the tripod by 0.5 mrad."""
    lifted_rad = 5e-4 * np.cos(measurement.horizontal_angle_rad)
    return replace(measurement, zenith_angle_rad=measurement.zenith_angle_rad + float(lifted_rad))


def moved(by_m: Sequence[float], measurement: PolarMeasurement) -> PolarMeasurement:
    """Move the tripod by a vector in its frame."""
    if measurement.slope_distance_m is None:
        return measurement
    azimuth, zenith = measurement.horizontal_angle_rad, measurement.zenith_angle_rad
    direction = [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)]
    x, y, z = measurement.slope_distance_m * np.array(direction) - by_m
    distance_m = float(np.sqrt(x * x + y * y + z * z))
    return replace(
        measurement,
        horizontal_angle_rad=float(np.arctan2(y, x) % (2 * np.pi)),
        zenith_angle_rad=float(np.arccos(z / distance_m)),
        slope_distance_m=distance_m,
    )


FAULTS: dict[str, Callable[[PolarMeasurement], PolarMeasurement]] = {
    "tripod turned": turned,
    "tripod tilted": tilted,
    **{
        f"tripod moved {by_mm} mm": partial(moved, [by_mm / 1000 * np.sqrt(0.5)] * 2 + [0.0])
        for by_mm in (10, 20, 50)
    },
    "tripod sunk 20 mm": partial(moved, [0.0, 0.0, -0.02]),
}
ERRORS = ("none", *CONFIGURED, *SAMPLED, *FAULTS)
THREE_SIGMA_3D = 14.156


def with_stations(parameters: Parameters, count: int) -> Parameters:
    """Return the parameters of the first stations and prisms."""
    return replace(
        parameters,
        stations=parameters.stations[:count],
        prisms=parameters.prisms[:count],
        pipeline=replace(parameters.pipeline, estimator="continuous"),
        setup_covariance=None if count < len(parameters.stations) else parameters.setup_covariance,
    )


def replayed(
    parameters: Parameters, arrivals: Sequence[Measurement | ImuSamples]
) -> tuple[list[PoseRecord], list[EventRecord]]:
    """Return the poses of a drive, and the events on the set-up of the IMU."""
    live = LiveEstimator(parameters)
    poses: list[PoseRecord] = []
    events: list[EventRecord] = []
    for each in arrivals:
        found = live.imu_samples(each) if isinstance(each, ImuSamples) else live.measurement(each)
        poses += [record for record in found if isinstance(record, PoseRecord)]
        events += live.imu_setup_events()
    return poses, events


class Truth:
    """True poses at epochs, whose times are multiples of a period."""

    def __init__(self, path: Path, parameters: Parameters) -> None:
        known = np.load(path)
        self._poses, self._first_s, self._start_ns = (
            known["poses"],
            known["time_s"][0],
            int(known["start_ns"]),
        )
        self._rate_hz = 1.0 / float(known["time_s"][1] - known["time_s"][0])
        self._centroid_m = centroid_at_point(parameters)

    def errors(self, poses: Sequence[PoseRecord]) -> FloatArray:
        """(N, 12): errors of the centroid in m and of the rotation in rad, squared distances of position, rotation and both; 0, ..."""
        rows = [((each.stamp_ns - self._start_ns) / 1e9 - self._first_s) * self._rate_hz for each in poses]
        index = np.round(rows).astype(np.intp)
        assert not rows or np.abs(index - rows).max() < 1e-3  # noqa: S101 (both are multiples of the period)
        inside = (index >= 0) & (index < len(self._poses))
        some = [each for each, is_inside in zip(poses, inside, strict=True) if is_inside]
        true = self._poses[index[inside]]
        rotation = rotation_from_quaternion(np.array([each.orientation_xyzw for each in some]).reshape(-1, 4))
        position = np.array([each.position_m for each in some]).reshape(-1, 3)
        covariance = np.array([each.covariance for each in some]).reshape(-1, 6, 6)
        turned = log_so3(rotation @ np.swapaxes(true[:, :3, :3], 1, 2))
        moved = position - true[:, :3, 3]
        at_centroid = moved + (rotation - true[:, :3, :3]) @ self._centroid_m

        def squared(part: slice, error: FloatArray) -> FloatArray:
            found = np.linalg.solve(covariance[:, part, part], error[:, :, None])[:, :, 0]
            return np.asarray((error * found).sum(axis=1))

        return np.stack(
            [
                np.linalg.norm(at_centroid, axis=1),
                np.linalg.norm(turned, axis=1),
                squared(slice(0, 3), moved),
                squared(slice(3, 6), turned),
                squared(slice(0, 6), np.concatenate([moved, turned], axis=1)),
            ],
            axis=1,
        )


def figures(poses: Sequence[PoseRecord], truth: Truth) -> str:
    """Return the figures of poses of one kind."""
    valid = [each for each in poses if each.valid]
    if not valid:
        return f"{0.0:7.1%}{'-':>7}{'-':>8}{'-':>8}{'-':>7}{'-':>8}{'-':>8}"
    found = truth.errors(valid)
    rms = np.sqrt((found[:, :2] ** 2).mean(axis=0))
    beyond = (found[:, 2:4] > THREE_SIGMA_3D).mean(axis=0)
    used = np.mean([each.imu == "used" for each in valid])
    return (
        f"{len(valid) / len(poses):7.1%}{used:7.0%}{1e3 * rms[0]:8.2f}{np.degrees(rms[1]):8.3f}{found[:, 4].mean():7.1f}"
        f"{beyond[0]:8.2%}{beyond[1]:8.2%}"
    )


def main() -> None:
    """Print one line per mission and error."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", choices=["industrial", "consumer"], default="industrial")
    parser.add_argument("--scenario", default="dynamic")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first", type=int, default=12)
    parser.add_argument("--duration", type=float, default=600.0, help="Of the mission in s.")
    parser.add_argument("--stations", type=int, default=3)
    parser.add_argument("--until", type=float, default=90.0, help="In s.")
    parser.add_argument("--errors", nargs="*", choices=ERRORS, default=ERRORS)
    parser.add_argument("--missions", type=Path)
    arguments = parser.parse_args()
    configure_logging("critical")
    head = f"{'valid':>7}{'IMU':>7}{'mm':>8}{'deg':>8}{'NEES':>7}{'pos >3s':>8}{'rot >3s':>8}"
    print(f"{'':<29}{'confirmed':>10}{'named':>7}   predicted{head[9:]}   smoothed{head[9:]}")
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.missions or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            mission = simulated(arguments, seed, folder)
            path = folder / f"{mission_stem(arguments, seed)}.jsonl"
            recording = load_recording(path)
            parameters = replace(with_stations(recording.parameters, arguments.stations), imu=mission.imu)
            records: list[Measurement | ImuSamples] = [
                each for each in recording.measurements if each.station <= arguments.stations
            ]
            first_ns = min(each.received_ns for each in records)
            records += read_imu_samples(path)
            until_ns = first_ns + round(1e9 * arguments.until)
            records = sorted(
                (each for each in records if each.received_ns <= until_ns), key=lambda each: each.received_ns
            )
            truth = Truth(path.with_suffix(".npz"), parameters)
            rng = np.random.default_rng([seed, 9])
            for name in ERRORS:
                wrong, part = parameters, records
                if name in CONFIGURED:
                    assert parameters.imu is not None  # noqa: S101 (each mission has one)
                    wrong = replace(parameters, imu=CONFIGURED[name][0](parameters.imu, rng))
                elif name in FAULTS:
                    part = [
                        FAULTS[name](each)
                        if isinstance(each, PolarMeasurement)
                        and each.station == 1
                        and each.stamp_ns > first_ns + FAULT_NS
                        else each
                        for each in records
                    ]
                elif name in SAMPLED:
                    rates, forces, _ = SAMPLED[name]
                    part = [
                        multiplied(each, rates, forces) if isinstance(each, ImuSamples) else each
                        for each in records
                    ]
                if name not in arguments.errors:
                    continue
                poses, events = replayed(wrong, part)
                times = {
                    event: [
                        f"{(each.stamp_ns - first_ns) / 1e9:.0f}" for each in events if each.event == event
                    ]
                    for event in ("imu_setup_confirmed", "imu_setup_wrong")
                }
                confirmed, named = (next(iter(each), "-") for each in times.values())
                if name in FAULTS:
                    contradicted = [
                        each.stamp_ns
                        for each in poses
                        if each.reason == "contradicted" or "imu_disagrees" in each.degraded_by
                    ]
                    named = f"{(min(contradicted) - first_ns) / 1e9:.1f}" if contradicted else "-"
                columns = [
                    figures([each for each in poses if each.series == series], truth)
                    for series in ("predicted", "smoothed")
                ]
                print(f"{seed:4d}  {name:<23}{confirmed:>10}{named:>7}   {'   '.join(columns)}", flush=True)


if __name__ == "__main__":
    main()
