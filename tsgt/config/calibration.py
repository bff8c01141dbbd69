"""Calibration results in SI units, read from set-up files."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tsgt.config.files import load
from tsgt.config.setup import ImuMountingFile, PrismLayoutFile, StationFramesFile
from tsgt.model import ImuParameters, SetupCovariance, TargetResidual

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from tsgt.config.setup import CovarianceTable, StationFrame
    from tsgt.model import ImuNoise, Matrix4, Row4, StationParameters, Vector3


@dataclass(frozen=True, slots=True, kw_only=True)
class StationSetup:
    """Calibration of one station."""

    T_station1_station: Matrix4
    latency_ns: int | None = None  # None: as configured
    vertical_index_rad: float = 0.0
    collimation_rad: float = 0.0
    range_scale_ppm: float | None = None  # None: ``atmospheric_ppm`` as configured
    targets: tuple[TargetResidual, ...] = ()

    def applied(self, station: StationParameters) -> StationParameters:
        """Return the station's parameters with this calibration."""
        return dataclasses.replace(
            station,
            T_station1_station=self.T_station1_station,
            latency_ns=station.latency_ns if self.latency_ns is None else self.latency_ns,
            atmospheric_ppm=station.atmospheric_ppm if self.range_scale_ppm is None else self.range_scale_ppm,
            vertical_index_rad=self.vertical_index_rad,
            collimation_rad=self.collimation_rad,
            targets=self.targets,
        )


@dataclass(frozen=True, slots=True)
class StationCalibration:
    """Calibration of the stations by number, with its joint covariance; None: unknown."""

    stations: dict[int, StationSetup]
    covariance: SetupCovariance | None = None


@dataclass(frozen=True, slots=True)
class PrismLayout:
    """Prism positions in the robot frame in m by number, with their joint covariance; None: unknown."""

    positions_m: dict[int, Vector3]
    covariance: SetupCovariance | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuMounting:
    """Calibration of the robot's IMU."""

    position_m: Vector3  # in the robot frame
    orientation_xyzw: Row4
    latency_ns: int
    gyro_matrix: tuple[Vector3, Vector3, Vector3]
    # Of a file that describes the IMU completely
    noise: ImuNoise | None = None
    gravity_mps2: float | None = None
    tilt_sigma_rad: float | None = None
    covariance: SetupCovariance | None = None  # None: unknown

    def parameters(self) -> ImuParameters | None:
        """Return the parameters of the IMU; None: the file has no noise, or no gravity."""
        if self.noise is None or self.gravity_mps2 is None:
            return None
        imu = ImuParameters(
            position_m=self.position_m,
            orientation_xyzw=self.orientation_xyzw,
            noise=self.noise,
            gravity_mps2=self.gravity_mps2,
        )
        if self.tilt_sigma_rad is not None:
            imu = dataclasses.replace(imu, tilt_sigma_rad=self.tilt_sigma_rad)
        return self.applied(imu)

    def applied(self, imu: ImuParameters) -> ImuParameters:
        """Return the IMU's parameters with this calibration."""
        return dataclasses.replace(
            imu,
            position_m=self.position_m,
            orientation_xyzw=self.orientation_xyzw,
            latency_ns=self.latency_ns,
            gyro_matrix=self.gyro_matrix,
        )


def load_station_calibration(path: Path) -> StationCalibration:
    """Read a file of station frames; raises as :func:`tsgt.config.load`."""
    file = load(path, StationFramesFile)
    return StationCalibration(
        {int(number): _station(entry) for number, entry in file.stations.items()},
        _covariance(file.covariance),
    )


def load_prism_layout(path: Path) -> PrismLayout:
    """Read a prism layout; ``sigma_m`` alone is taken as uncorrelated. Raises as :func:`tsgt.config.load`."""
    file = load(path, PrismLayoutFile)
    covariance = _covariance(file.covariance)
    if covariance is None:
        variances = {
            f"prism{number}.{axis}": sigma**2
            for number, entry in file.prisms.items()
            if entry.sigma_m is not None
            for axis, sigma in zip("xyz", entry.sigma_m, strict=True)
        }
        covariance = _diagonal(variances) if variances else None
    return PrismLayout({int(number): entry.position_m for number, entry in file.prisms.items()}, covariance)


def load_imu_mounting(path: Path) -> ImuMounting:
    """Read the mounting of an IMU; raises as :func:`tsgt.config.load`."""
    file = load(path, ImuMountingFile)
    return ImuMounting(
        position_m=file.position_m,
        orientation_xyzw=file.orientation_xyzw,
        latency_ns=round(file.latency_ms * 1e6),
        gyro_matrix=file.gyro_matrix,
        noise=None if file.noise is None else file.noise.noise(),
        gravity_mps2=file.gravity_mps2,
        tilt_sigma_rad=None if file.tilt_sigma_mrad is None else file.tilt_sigma_mrad / 1e3,
        covariance=_covariance(file.covariance),
    )


def setup_covariance(
    stations: SetupCovariance | None,
    prisms: SetupCovariance | None,
    *,
    station_numbers: Iterable[int],
    prism_numbers: Iterable[int],
    imu: SetupCovariance | None = None,
) -> SetupCovariance | None:
    """Join the stations' components of one covariance, the prisms' of another and the IMU's, for these stations and prisms.

    None: those of stations and prisms are unknown. Of one that is unknown no component is in the result: it is taken as exact.
    """
    parts = [
        _restricted(stations, {f"station{number}" for number in station_numbers}),
        _restricted(prisms, {f"prism{number}" for number in prism_numbers}),
    ]
    known = [part for part in parts if part is not None]
    if not known:  # The IMU's alone would say that the others are exact
        return None
    of_imu = _restricted(imu, {"imu"})
    return _joined(known if of_imu is None else [*known, of_imu])


def with_latencies(
    covariance: SetupCovariance, known: SetupCovariance | None, stations: Iterable[int]
) -> SetupCovariance:
    """Join the latencies of these stations, as known from elsewhere, to a covariance without them."""
    wanted = {f"station{number}.latency" for number in stations}
    kept = _selected(known, [name in wanted for name in known.components]) if known else None
    return covariance if kept is None else _joined([covariance, kept])


def _joined(known: Sequence[SetupCovariance]) -> SetupCovariance:
    """Join covariances of components that are not correlated with those of the others."""
    components = [name for part in known for name in part.components]
    rows: list[tuple[float, ...]] = []
    before = 0
    for part in known:
        after = len(components) - before - len(part.components)
        rows += [(0.0,) * before + row + (0.0,) * after for row in part.matrix]
        before += len(part.components)
    return SetupCovariance(components=tuple(components), matrix=tuple(rows))


def _restricted(covariance: SetupCovariance | None, owners: set[str]) -> SetupCovariance | None:
    """Keep the components of these stations or prisms."""
    if covariance is None:
        return None
    return _selected(covariance, [name.partition(".")[0] in owners for name in covariance.components])


def _selected(covariance: SetupCovariance, wanted: Sequence[bool]) -> SetupCovariance | None:
    """Keep components, if any."""
    kept = [i for i, is_wanted in enumerate(wanted) if is_wanted]
    if not kept:
        return None
    return SetupCovariance(
        components=tuple(covariance.components[i] for i in kept),
        matrix=tuple(tuple(covariance.matrix[i][j] for j in kept) for i in kept),
    )


def _diagonal(variances: dict[str, float]) -> SetupCovariance:
    names = tuple(variances)
    return SetupCovariance(
        components=names,
        matrix=tuple(tuple(variances[a] if a == b else 0.0 for b in names) for a in names),
    )


def _station(entry: StationFrame) -> StationSetup:
    return StationSetup(
        T_station1_station=entry.T_station1_station,
        latency_ns=None if entry.latency_ms is None else round(entry.latency_ms * 1e6),
        vertical_index_rad=(entry.vertical_index_mrad or 0.0) / 1e3,
        collimation_rad=(entry.collimation_mrad or 0.0) / 1e3,
        range_scale_ppm=entry.range_scale_ppm,
        targets=tuple(
            TargetResidual(
                target=fit.target,
                residual_m=_metres(fit.residual_mm),
                leave_one_out_m=_metres(fit.leave_one_out_mm),
            )
            for fit in entry.targets
        ),
    )


def _covariance(table: CovarianceTable | None) -> SetupCovariance | None:
    return None if table is None else SetupCovariance(components=table.components, matrix=table.matrix)


def _metres(length_mm: float | None) -> float | None:
    return None if length_mm is None else length_mm / 1e3
