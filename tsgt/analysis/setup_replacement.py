"""Replacing the set-up in the parameters of a recording by that of set-up files."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from tsgt.config import setup_covariance
from tsgt.errors import ConfigError, DegenerateGeometryError
from tsgt.geometry import check_layout
from tsgt.model import PrismPosition

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.config import ImuMounting, PrismLayout, StationCalibration
    from tsgt.model import Parameters, SetupCovariance


def with_calibration(parameters: Parameters, calibration: StationCalibration, *, path: Path) -> Parameters:
    """Replace frames, instrument errors, latencies, target residuals and their covariance by those of a set-up file.

    Raises ConfigError if a station is missing.
    """
    missing = [s.station for s in parameters.stations if s.station not in calibration.stations]
    if missing:
        raise ConfigError(
            f"{path}: stations.{missing[0]}: missing; the recording has this station", path=path
        )
    known = parameters.setup_covariance
    stations = tuple(calibration.stations[s.station].applied(s) for s in parameters.stations)
    return dataclasses.replace(
        parameters,
        stations=stations,
        setup_covariance=_covariance(parameters, calibration.covariance, known, known),
    )


def with_layout(parameters: Parameters, layout: PrismLayout, *, path: Path) -> Parameters:
    """Replace the prism layout and its covariance by those of a set-up file; prisms that the recording lacks are ignored.

    Raises ConfigError if a prism of the recording has no position in the file, or the layout determines no pose.
    """
    positions_m = layout.positions_m
    # A master without a calibration knows which prisms its stations track.
    numbers = [p.prism for p in parameters.prisms] or sorted({s.prism for s in parameters.stations})
    missing = [number for number in numbers if number not in positions_m]
    if missing:
        raise ConfigError(f"{path}: prisms.{missing[0]}: missing; the recording has this prism", path=path)
    try:
        check_layout(
            [positions_m[number] for number in numbers], names=numbers, imu=parameters.imu is not None
        )
    except DegenerateGeometryError as error:
        raise ConfigError(f"{path}: {error}", path=path, key="prisms") from error
    known = parameters.setup_covariance
    prisms = tuple(PrismPosition(prism=number, position_m=positions_m[number]) for number in numbers)
    parameters = dataclasses.replace(parameters, prisms=prisms)
    covariance = _covariance(parameters, known, layout.covariance, known)
    return dataclasses.replace(parameters, setup_covariance=covariance)


def with_imu_mounting(parameters: Parameters, mounting: ImuMounting, *, path: Path) -> Parameters:
    """Replace mounting, latency and gyro matrix of the IMU and their covariance by those of a set-up file.

    Shocks before the recording say nothing of another mounting. A recording without an IMU gets that of the file. Raises ConfigError if
    the file does not describe it completely.
    """
    imu = mounting.parameters() if parameters.imu is None else mounting.applied(parameters.imu)
    if imu is None:
        raise ConfigError(
            f"{path}: needs noise and gravity_mps2, because the recording has no IMU; `tsgt calibrate imu` writes them",
            path=path,
        )
    if parameters.imu is not None and parameters.imu.mounting != imu.mounting:
        imu = dataclasses.replace(imu, shocks_before=0)
    known = parameters.setup_covariance
    return dataclasses.replace(
        parameters, imu=imu, setup_covariance=_covariance(parameters, known, known, mounting.covariance)
    )


def _covariance(
    parameters: Parameters,
    stations: SetupCovariance | None,
    prisms: SetupCovariance | None,
    imu: SetupCovariance | None,
) -> SetupCovariance | None:
    return setup_covariance(
        stations,
        prisms,
        station_numbers=(s.station for s in parameters.stations),
        prism_numbers=(p.prism for p in parameters.prisms),
        imu=imu,
    )
