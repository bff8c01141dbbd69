"""Simulated field days at the level of measurements: a drive, targets, instruments, and planted faults of known size.

No radio and no protocols: the measurements of three stations and of their targets follow from the ground truth directly, so
that a day takes a fraction of a second. Without faults all errors are within the data sheets.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from tsgt.analysis.calibration import solve_stations, target_residuals
from tsgt.analysis.formats import InstrumentErrors, TargetFile, TargetMeasurement
from tsgt.config import MotionConfig
from tsgt.geometry import cartesian_to_polar, exp_so3, invert, transform_from, transform_points
from tsgt.model import (
    ARCSECOND_RAD,
    TARGET_NOISE,
    TRACKING_NOISE,
    Parameters,
    PolarMeasurement,
    PrismPosition,
    StationParameters,
)
from tsgt.recording import Recording, RecordingHeader
from tsgt.simulation.world import World

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tsgt.geometry import FloatArray
    from tsgt.model import InstrumentNoise, Matrix4, Measurement

STATIONS = (1, 2, 3)
LAYOUT = np.array([[-0.4559, -0.1759, 1.1167], [0.4844, -0.1759, 1.4167], [-0.0285, 0.3519, 1.0667]])
START_NS = 1_700_000_000_000_000_000
CONSTANT_M = 0.010  # of prisms and targets
RATE_HZ = 2.5
TICK_JITTER_S = 0.004
STAMP_SIGMA_S = 3e-4
TARGETS = 12
FAR_TARGETS = (11, 12)  # at 260 to 290 m
ROUNDS = 2  # times that each station measures each target, in face 1
GAPS_PER_MIN = 1.2  # of each station

INDEX_RAD = 0.2e-3
TARGET_SHIFT_M = 0.015
TURN_RAD = 0.3e-3
PRISM_SHIFT_M = 0.010
NOISE_FACTOR = 3.0
LATENCY_S = 0.010
SINKING_M = 0.010
OUTLIERS = 4


class Kind(StrEnum):
    """A planted fault."""

    VERTICAL_INDEX = "vertical_index"
    FAR_TARGETS = "far_targets"
    TURNED_TRIPOD = "turned_tripod"
    PRISM = "prism"
    NOISE = "noise"
    LOCK_LOSS = "lock_loss"
    LATENCY = "latency"
    SINKING_TRIPOD = "sinking_tripod"
    OUTLIERS = "outliers"


REQUIRED = (
    Kind.VERTICAL_INDEX,
    Kind.FAR_TARGETS,
    Kind.TURNED_TRIPOD,
    Kind.PRISM,
    Kind.NOISE,
    Kind.LOCK_LOSS,
)


@dataclass(frozen=True, slots=True)
class Cause:
    """A planted fault: station or prism that has it (None: all), and its size in SI units, signed."""

    kind: Kind
    number: int | None
    size: float


@dataclass(slots=True)
class _Station:
    """One instrument with its true errors."""

    number: int
    frame: FloatArray  # (4, 4) while it measured the targets
    vertical_index_rad: float
    collimation_rad: float
    range_constant_m: float
    turn_rad: float = 0.0  # about its vertical, after the targets
    sinking_m: float = 0.0  # from the start to the end of the drive
    latency_s: float = 0.0
    horizontal_factor: float = 1.0
    drifting_locks: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class FieldDay:
    """A day: the recording, its frames not yet calibrated, the targets, the truth, and what was planted."""

    recording: Recording
    targets: TargetFile
    world: World
    frames: dict[int, FloatArray]  # (4, 4) true ``T_station1_station`` at the start of the drive
    layout: FloatArray  # (3, 3) true prisms
    causes: tuple[Cause, ...]
    outliers: frozenset[tuple[int, int]] = field(default_factory=frozenset)  # (station, sequence)


def field_day(kinds: Iterable[Kind | str] = (), seed: int = 0, *, duration_s: float = 240.0) -> FieldDay:
    """Simulate a day with planted faults."""
    wanted = [Kind(kind) for kind in kinds]
    rng = np.random.default_rng([seed, 2101])
    drive_rng, set_up_rng, fault_rng, noise_rng = rng.spawn(4)
    stations = _set_up(set_up_rng)
    layout = LAYOUT + set_up_rng.normal(scale=2e-4, size=(3, 3))
    targets_m = _targets(set_up_rng)
    causes = []
    shifts: dict[tuple[int, int], FloatArray] = {}
    for kind in sorted(wanted):
        cause = _plant(kind, fault_rng, stations, layout, targets_m, shifts)
        causes.append(cause)
    world = World(_motion(drive_rng), layout, duration_s, drive_rng)
    measurements: list[Measurement] = []
    outliers: set[tuple[int, int]] = set()
    for station, own_rng in zip(stations, noise_rng.spawn(len(stations)), strict=True):
        own, wrong = _track(
            world, station, duration_s, own_rng, outliers=OUTLIERS if Kind.OUTLIERS in wanted else 0
        )
        measurements += own
        outliers |= {(station.number, sequence) for sequence in wrong}
    measurements.sort(key=lambda each: each.received_ns)
    recording = Recording(
        header=RecordingHeader(software="field day", created_ns=START_NS, source="simulated field day"),
        parameters=Parameters(
            stations=tuple(
                StationParameters(station=s.number, prism=s.number, prism_constant_m=CONSTANT_M)
                for s in stations
            ),
            prisms=tuple(
                PrismPosition(prism=i + 1, position_m=(float(x), float(y), float(z)))
                for i, (x, y, z) in enumerate(LAYOUT)
            ),
        ),
        measurements=measurements,
        end_ns=max(each.received_ns for each in measurements),
    )
    return FieldDay(
        recording,
        _measure_targets(stations, targets_m, shifts, noise_rng),
        world,
        {s.number: _frame_at(s, np.zeros(1))[0] for s in stations},
        layout,
        tuple(causes),
        frozenset(outliers),
    )


def _set_up(rng: np.random.Generator) -> list[_Station]:
    """Three stations some metres apart, levelled to an arcsecond; the first is frame ``station1``."""
    stations = []
    bearing = rng.uniform(0.0, math.tau)
    for row, number in enumerate(STATIONS):
        frame = np.eye(4)
        if row:
            angle, distance_m = bearing + row * rng.uniform(1.2, 2.2), rng.uniform(3.0, 12.0)
            place = np.array(
                [distance_m * math.cos(angle), distance_m * math.sin(angle), rng.uniform(-0.3, 0.3)]
            )
            turn = np.append(rng.normal(scale=ARCSECOND_RAD, size=2), rng.uniform(-math.pi, math.pi))
            frame = transform_from(exp_so3(turn), place)
        stations.append(
            _Station(
                number,
                frame,
                vertical_index_rad=rng.normal(scale=1.5 * ARCSECOND_RAD),
                collimation_rad=rng.normal(scale=1.5 * ARCSECOND_RAD),
                range_constant_m=rng.normal(scale=3e-4),
            )
        )
    return stations


def _targets(rng: np.random.Generator) -> FloatArray:
    """Targets all around in frame ``station1``, (T, 3), the last two far and near each other."""
    near = TARGETS - len(FAR_TARGETS)
    distance_m = np.geomspace(12.0, 180.0, near) * rng.uniform(0.9, 1.1, near)
    bearing = rng.permutation(np.arange(near) * math.tau / near) + rng.uniform(-0.25, 0.25, near)
    far_bearing = rng.uniform(0, math.tau)
    distance_m = np.append(distance_m, rng.uniform(260.0, 290.0, 2))
    bearing = np.append(bearing, far_bearing + np.array([-0.12, 0.12]) * rng.uniform(0.5, 1.5, 2))
    height_m = rng.uniform(-0.02, 0.05, TARGETS) * distance_m + rng.uniform(-1.0, 1.0, TARGETS)
    return np.column_stack([distance_m * np.cos(bearing), distance_m * np.sin(bearing), height_m])


def _motion(rng: np.random.Generator) -> MotionConfig:
    """Drive and stop in an area of 35 to 45 m radius, whose centre is 75 to 105 m away."""
    bearing, distance_m = rng.uniform(0.0, math.tau), rng.uniform(75.0, 105.0)
    return MotionConfig(
        interval_min_s=4.0,
        interval_max_s=10.0,
        speeds_mps=(0.0, 0.7, 1.4, 2.0),
        speed_weights=(2.0, 2.0, 3.0, 3.0),
        yaw_rates_radps=(0.0, 0.0, 0.0, 0.2, -0.2, 0.4, -0.4),
        area_centre_m=(
            distance_m * math.cos(bearing),
            distance_m * math.sin(bearing),
            rng.uniform(-5.0, 1.0),
        ),
        area_radius_m=rng.uniform(35.0, 45.0),
    )


def _plant(
    kind: Kind,
    rng: np.random.Generator,
    stations: list[_Station],
    layout: FloatArray,
    targets_m: FloatArray,
    shifts: dict[tuple[int, int], FloatArray],
) -> Cause:
    """Plant a fault in one of the stations or prisms."""
    station = stations[int(rng.integers(len(stations)))]
    sign = float(rng.choice([-1.0, 1.0]))
    match kind:
        case Kind.VERTICAL_INDEX:
            station.vertical_index_rad = sign * INDEX_RAD
            return Cause(kind, station.number, station.vertical_index_rad)
        case Kind.FAR_TARGETS:
            for target in FAR_TARGETS:
                x, y, _ = targets_m[target - 1]
                shifts[station.number, target] = (
                    sign * TARGET_SHIFT_M * np.array([-y, x, 0.0]) / math.hypot(x, y)
                )
            return Cause(kind, station.number, sign * TARGET_SHIFT_M)
        case Kind.TURNED_TRIPOD:
            station.turn_rad = sign * TURN_RAD
            return Cause(kind, station.number, station.turn_rad)
        case Kind.PRISM:
            row = int(rng.integers(len(layout)))
            direction = layout[row] - layout[(row + int(rng.integers(1, 3))) % 3]
            # Within 60 degrees of the direction to another prism, in which it changes a distance.
            direction = direction / np.linalg.norm(direction) + rng.uniform(-1.0, 1.0, 3) * [0.5, 0.5, 0.5]
            layout[row] += sign * PRISM_SHIFT_M * direction / np.linalg.norm(direction)
            return Cause(kind, row + 1, PRISM_SHIFT_M)
        case Kind.NOISE:
            for each in stations:
                each.horizontal_factor = NOISE_FACTOR
            return Cause(kind, None, NOISE_FACTOR)
        case Kind.LOCK_LOSS:
            for each in stations:
                each.drifting_locks = True
            return Cause(kind, None, 0.055)
        case Kind.LATENCY:
            station.latency_s = sign * LATENCY_S
            return Cause(kind, station.number, station.latency_s)
        case Kind.SINKING_TRIPOD:
            station.sinking_m = SINKING_M
            return Cause(kind, station.number, SINKING_M)
        case Kind.OUTLIERS:
            return Cause(kind, None, 1.0)


def _frame_at(station: _Station, share: FloatArray) -> FloatArray:
    """(N, 4, 4) true frame at these shares of the drive, (N,), 0 to 1."""
    frames = np.repeat((station.frame @ _turned(station.turn_rad))[None], len(share), axis=0)
    frames[:, 2, 3] -= share * station.sinking_m
    return frames


def _turned(angle_rad: float) -> FloatArray:
    return transform_from(exp_so3(np.array([0.0, 0.0, angle_rad])), np.zeros(3))


def _track(
    world: World, station: _Station, duration_s: float, rng: np.random.Generator, *, outliers: int
) -> tuple[list[PolarMeasurement], list[int]]:
    """Measurements of the station's prism, with gaps, and the sequence numbers of planted outliers."""
    count = int(duration_s * RATE_HZ)
    time_s = (np.arange(count) + rng.uniform(0.05, 0.95)) / RATE_HZ + rng.normal(
        scale=TICK_JITTER_S, size=count
    )
    time_s = np.sort(np.clip(time_s, 0.0, duration_s))
    count = round(GAPS_PER_MIN * duration_s / 60.0)
    gap_starts = 8.0 + (np.arange(count) + rng.uniform(0.1, 0.6, count)) * (duration_s - 16.0) / count
    gap_ends = gap_starts + rng.uniform(1.2, 5.0, count)
    in_gap = ((time_s[:, None] > gap_starts) & (time_s[:, None] < gap_ends)).any(axis=1)
    time_s = time_s[~in_gap]
    point = world.prism_at(time_s, station.number - 1)
    in_station = transform_points(invert(_frame_at(station, time_s / duration_s)), point)
    horizontal, zenith, distance = cartesian_to_polar(in_station)
    along, across, up = _noise(TRACKING_NOISE, distance, rng)
    across = station.horizontal_factor * across
    if station.drifting_locks:
        for drift in _lock_drifts(time_s, rng):
            across = across + drift[0]
            up = up + drift[1]
    horizontal = horizontal + across / (distance * np.sin(zenith)) - station.collimation_rad / np.sin(zenith)
    zenith = zenith + up / distance + station.vertical_index_rad
    distance = distance + along + station.range_constant_m
    wrong = np.sort(rng.choice(np.arange(5, len(time_s) - 5), outliers, replace=False))
    distance[wrong] += rng.choice([-1.0, 1.0], outliers) * rng.uniform(0.15, 2.0, outliers)
    stamp_ns = START_NS + np.round(
        1e9 * (time_s + station.latency_s + rng.normal(scale=STAMP_SIGMA_S, size=len(time_s)))
    ).astype(np.int64)
    rows = zip(
        stamp_ns.tolist(),
        horizontal.tolist(),
        zenith.tolist(),
        (distance - CONSTANT_M).tolist(),
        strict=True,
    )
    return [
        PolarMeasurement(
            station=station.number,
            prism=station.number,
            sequence=sequence,
            stamp_ns=stamp,
            stamp_sigma_ns=round(1e9 * STAMP_SIGMA_S),
            received_ns=stamp + 200_000_000,
            horizontal_angle_rad=h,
            zenith_angle_rad=z,
            slope_distance_m=d,
            host_time_ns=stamp,
        )
        for sequence, (stamp, h, z, d) in enumerate(rows)
    ], wrong.tolist()


def _lock_drifts(time_s: FloatArray, rng: np.random.Generator) -> list[FloatArray]:
    """Errors across the line of sight near each gap, (2, N) each: the lock drifts off for a second, and settles after."""
    drifts = []
    for after in np.flatnonzero(np.diff(time_s) > 0.9) + 1:
        angle, size_m = rng.uniform(-0.5, 0.5) + math.pi * rng.integers(2), rng.uniform(0.03, 0.08)
        before_s = time_s[after - 1] + 0.2 - time_s
        size = size_m * np.where((before_s >= 0) & (before_s < 1.0), (1.0 - before_s) ** 2, 0.0)
        since_s = time_s - time_s[after]
        settling_m = rng.uniform(0.01, 0.03)
        size += settling_m * np.where((since_s >= 0) & (since_s < 1.0), np.exp(-since_s / 0.4), 0.0)
        drifts.append(np.array([math.cos(angle), math.sin(angle)])[:, None] * size)
    return drifts


def _noise(
    noise: InstrumentNoise, distance_m: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Errors along, horizontally and vertically across the line of sight, in m."""
    along_m = np.sqrt(
        noise.range_sigma_m**2 + (1e-6 * noise.range_sigma_ppm * distance_m) ** 2 + noise.pointing_sigma_m**2
    )
    across_m = np.hypot(noise.angle_sigma_rad * distance_m, noise.pointing_sigma_m)
    along, across, up = rng.normal(size=(3, len(distance_m)))
    return along * along_m, across * across_m, up * across_m


def _measure_targets(
    stations: list[_Station],
    targets_m: FloatArray,
    shifts: dict[tuple[int, int], FloatArray],
    rng: np.random.Generator,
) -> TargetFile:
    """All targets by all stations, before the drive, in face 1."""
    measured: dict[int, dict[int, list[TargetMeasurement]]] = {}
    line = 1
    for station in stations:
        points = targets_m.copy()
        for row in range(len(points)):
            points[row] += shifts.get((station.number, row + 1), np.zeros(3))
        horizontal, zenith, distance = cartesian_to_polar(transform_points(invert(station.frame), points))
        own: dict[int, list[TargetMeasurement]] = {target + 1: [] for target in range(len(points))}
        for _ in range(ROUNDS):
            along, across, up = _noise(TARGET_NOISE, distance, rng)
            for row in range(len(points)):
                line += 1
                own[row + 1].append(
                    TargetMeasurement(
                        horizontal_angle_rad=float(
                            horizontal[row]
                            + (across[row] / distance[row] - station.collimation_rad) / np.sin(zenith[row])
                        ),
                        zenith_angle_rad=float(
                            zenith[row] + up[row] / distance[row] + station.vertical_index_rad
                        ),
                        slope_distance_m=float(
                            distance[row] + along[row] + station.range_constant_m - CONSTANT_M
                        ),
                        line=line,
                    )
                )
        measured[station.number] = own
    return TargetFile(Path("targets.csv"), measured, ())


def calibrated(day: FieldDay) -> Recording:
    """Return the recording with what its targets give, as ``tsgt calibrate targets`` writes it."""
    solved = solve_stations(day.targets, target_constant_m=CONSTANT_M)
    errors = solved.instrument_errors()
    stations = []
    for station in day.recording.parameters.stations:
        own = errors.get(station.station, InstrumentErrors())
        changed = replace(
            station,
            vertical_index_rad=own.vertical_index_rad or 0.0,
            collimation_rad=own.collimation_rad or 0.0,
            atmospheric_ppm=own.range_scale_ppm or 0.0,
        )
        if station.station != 1:
            frame = solved.frames[station.station]
            changed = replace(
                changed,
                T_station1_station=cast("Matrix4", tuple(map(tuple, frame.T.tolist()))),
                targets=target_residuals(frame),
            )
        stations.append(changed)
    parameters = replace(
        day.recording.parameters, stations=tuple(stations), setup_covariance=solved.covariance
    )
    return replace(day.recording, parameters=parameters)
