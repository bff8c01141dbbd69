"""Simulated measurements of targets by total stations, with errors of instruments, sights and tripods."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry import cartesian_to_polar, exp_so3, log_so3
from tsgt.geometry.target_calibration import DATA_SHEET_SIGMA, ERRORS, InstrumentError, TargetReadings
from tsgt.model import TARGET_NOISE

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.geometry.target_calibration import NetworkCalibration


@dataclass(kw_only=True)
class TargetField:
    """A field of targets, by row of station and target; the errors default to none."""

    rng: np.random.Generator
    targets: int = 10
    stations: int = 3
    far: int = 0  # Targets at 260 to 290 m; the others at 10 to 150 m
    spread_m: float = 8.0
    noise: float = 1.0  # Factor on the stated noise
    both_faces: bool = False
    errors: dict[tuple[int, InstrumentError], float] = field(default_factory=dict)
    in_specification: bool = False  # Draw all other instrument errors from the data sheet
    displaced: dict[tuple[int, int], FloatArray] = field(default_factory=dict)  # Sights, in m in frame 1
    # Displacement in m and heading in rad of a tripod before this target is measured
    moved_tripod: tuple[int, int, FloatArray] | None = None

    def __post_init__(self) -> None:
        """Draw the set-up."""
        rng, n = self.rng, self.targets
        azimuth, distance = rng.uniform(0, 2 * np.pi, n), rng.uniform(10, 150, n)
        distance[: self.far] = rng.uniform(260, 290, self.far)
        height = rng.uniform(-0.03, 0.06, n) * distance + rng.uniform(-1, 3, n)
        self.points_m = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), height], axis=1)
        self.rotation = np.stack(
            [np.eye(3)]
            + [
                exp_so3(np.array([*rng.normal(0, 3e-4, 2), 0]))
                @ exp_so3(np.array([0, 0, rng.uniform(-3, 3)]))
                for _ in range(self.stations - 1)
            ]
        )
        self.translation_m = np.zeros((self.stations, 3))
        self.translation_m[1:] = rng.uniform(-1, 1, (self.stations - 1, 3)) * [
            self.spread_m,
            self.spread_m,
            0.5,
        ]
        sheet = np.array([DATA_SHEET_SIGMA[error] for error in ERRORS])
        drawn = rng.normal(size=(self.stations, len(ERRORS))) * sheet
        self.instrument = drawn if self.in_specification else np.zeros_like(drawn)
        for (row, error), value in self.errors.items():
            self.instrument[row, ERRORS.index(error)] = value

    def measure(self) -> TargetReadings:
        """Measure every target by every station, station by station."""
        rows = [
            (station, target, face)
            for station in range(self.stations)
            for target in range(self.targets)
            for face in ((1, -1) if self.both_faces else (1,))
        ]
        readings = np.array([self._reading(*row) for row in rows])
        return TargetReadings(
            stations=tuple(range(1, self.stations + 1)),
            targets=tuple(range(1, self.targets + 1)),
            station=np.array([row[0] for row in rows]),
            target=np.array([row[1] for row in rows]),
            horizontal_rad=readings[:, 0],
            zenith_rad=readings[:, 1],
            distance_m=readings[:, 2],
        )

    def _reading(self, station: int, target: int, face: int) -> tuple[float, float, float]:
        """Horizontal and zenith reading and distance."""
        point = self.points_m[target] + self.displaced.get((station, target), np.zeros(3))
        rotation, translation = self.rotation[station], self.translation_m[station]
        if self.moved_tripod is not None:
            moved, first, change = self.moved_tripod
            if moved == station and target >= first:
                rotation = exp_so3(np.array([0, 0, change[3]])) @ rotation
                translation = translation + change[:3]
        h, z, d = (float(each) for each in cartesian_to_polar(rotation.T @ (point - translation)))
        index, collimation, scale, constant = self.instrument[station]
        across = np.hypot(TARGET_NOISE.angle_sigma_rad, TARGET_NOISE.pointing_sigma_m / d)
        along = np.sqrt(
            TARGET_NOISE.range_sigma_m**2
            + (1e-6 * TARGET_NOISE.range_sigma_ppm * d) ** 2
            + TARGET_NOISE.pointing_sigma_m**2
        )
        noise = self.noise * self.rng.normal(size=3)
        h += noise[0] * across / np.sin(z) - face * collimation / np.sin(z)
        z = z + noise[1] * across if face > 0 else 2 * np.pi - z - noise[1] * across
        distance = (d + noise[2] * along - constant) / (1 + scale)
        return (h if face > 0 else h + np.pi), z + index, distance


def frame_nees(calibration: NetworkCalibration, truth: TargetField) -> tuple[float, int]:
    """Normalised squared error of all frames, and its degrees of freedom."""
    places = [place for place, (_, component) in enumerate(calibration.columns) if component < 6]
    errors = []
    for row, component in (calibration.columns[place] for place in places):
        if component < 3:
            error = truth.translation_m[row] - calibration.network.translation_m[row]
        else:
            error = log_so3(truth.rotation[row] @ calibration.network.rotation[row].T)
        errors.append(error[component % 3])
    covariance = calibration.covariance[np.ix_(places, places)]
    vector = np.array(errors)
    return float(vector @ np.linalg.solve(covariance, vector)), len(vector)
