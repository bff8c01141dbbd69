"""Parameters in metres, radians and nanoseconds from configuration and set-up files."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

from tsgt.config.calibration import (
    load_imu_mounting,
    load_prism_layout,
    load_station_calibration,
    setup_covariance,
)
from tsgt.config.sensors import IMU_NOISE
from tsgt.errors import ConfigError
from tsgt.model import (
    ARCSECOND_RAD,
    MIN_PRISMS,
    ImuParameters,
    InstrumentNoise,
    Matrix4,
    MotionPrior,
    Parameters,
    PipelineParameters,
    PrismPosition,
    StationParameters,
)

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.config.base import NoiseConfig
    from tsgt.config.master import MasterConfig, StationConfig
    from tsgt.config.pipeline import PipelineConfig, ReferencePointConfig
    from tsgt.config.scenario import ScenarioConfig, SimulatedImu, SimulatedStation
    from tsgt.model import ReferencePoint, SetupCovariance


def parameters(config: MasterConfig) -> Parameters:
    """Read the set-up files of a master's configuration and convert everything to SI units.

    Prisms that no station tracks are omitted: every pose would wait for them. Raises ConfigError if a set-up file is
    invalid, a station has no frame, a prism has no position, or the stations track fewer than three prisms without an IMU.
    """
    calibration = load_station_calibration(config.setup.station_frames)
    prism_layout = load_prism_layout(config.setup.prism_layout)
    layout = prism_layout.positions_m
    for station in config.stations:
        if station.station not in calibration.stations:
            raise ConfigError(
                f"{config.setup.station_frames}: stations.{station.station}: missing; each station needs a frame",
                path=config.setup.station_frames,
                key=f"stations.{station.station}",
            )
        if station.prism not in layout:
            raise ConfigError(
                f"{config.setup.prism_layout}: prisms.{station.prism}: missing; station {station.station} tracks it",
                path=config.setup.prism_layout,
                key=f"prisms.{station.prism}",
            )
    tracked = sorted({station.prism for station in config.stations})
    if len(tracked) < MIN_PRISMS:
        _check_imu(config, len(tracked))
    return _parameters(
        config,
        tuple(calibration.stations[each.station].applied(_station(each)) for each in config.stations),
        tuple(PrismPosition(prism=prism, position_m=layout[prism]) for prism in tracked),
        calibration.covariance,
        prism_layout.covariance,
    )


def missing_setup_files(config: MasterConfig) -> list[Path]:
    """Return the set-up files that do not exist: before the first calibration a master has none."""
    missing = []
    for path in (config.setup.station_frames, config.setup.prism_layout):
        try:
            path.stat()
        except FileNotFoundError:
            missing.append(path)
        except OSError:  # its reader says which
            continue
    return missing


def parameters_in_force(config: MasterConfig) -> Parameters:
    """Return the parameters of a master: as :func:`parameters`; if a set-up file is missing, those without poses."""
    missing = missing_setup_files(config)
    if not missing:
        return parameters(config)
    commands = {
        config.setup.station_frames: "tsgt calibrate targets",
        config.setup.prism_layout: "tsgt calibrate prisms",
    }
    files = " and ".join(f"{path} (`{commands[path]}` writes it)" for path in missing)
    stations = tuple(_station(each) for each in config.stations)
    uncalibrated = _parameters(config, stations, (), None, None)
    return dataclasses.replace(uncalibrated, no_poses=f"not calibrated: {files} does not exist")


def _station(config: StationConfig) -> StationParameters:
    """Return the parameters of a station without a calibration."""
    return StationParameters(
        station=config.station,
        prism=config.prism,
        prism_constant_m=config.prism_constant_mm / 1e3,
        atmospheric_ppm=config.atmospheric_ppm,
        latency_ns=round(config.latency_ms * 1e6),
        time_sigma_s=config.time_sigma_ms / 1e3,
        noise=noise(config.noise),
        noise_scale=config.noise_scale,
    )


def _parameters(
    config: MasterConfig,
    stations: tuple[StationParameters, ...],
    prisms: tuple[PrismPosition, ...],
    station_covariance: SetupCovariance | None,
    prism_covariance: SetupCovariance | None,
) -> Parameters:
    mounting = (
        None if config.imu is None or config.imu.mounting is None else load_imu_mounting(config.imu.mounting)
    )
    imu = None if config.imu is None else config.imu.parameters()
    if imu is not None and mounting is not None:
        imu = mounting.applied(imu)
    return Parameters(
        stations=stations,
        prisms=prisms,
        pipeline=pipeline_parameters(config.pipeline),
        reference_point=_reference_point(config.reference_point, imu),
        setup_covariance=setup_covariance(
            station_covariance,
            prism_covariance,
            station_numbers=(station.station for station in config.stations),
            prism_numbers=(prism.prism for prism in prisms),
            imu=None if mounting is None else mounting.covariance,
        ),
        imu=imu,
        odometry=None if config.odometry is None else config.odometry.parameters(),
    )


def _reference_point(config: ReferencePointConfig, imu: ImuParameters | None) -> ReferencePoint:
    """Return the point; that of the IMU if it has its name and no place of its own."""
    if (
        imu is not None
        and config.name == imu.name
        and not {"position_m", "orientation_xyzw"} & config.model_fields_set
    ):
        return imu.point
    return config.point()


def _check_imu(config: MasterConfig, prisms: int) -> None:
    """Raise ConfigError unless the poses of one or two prisms can be computed with an IMU."""
    setup = f"{_count(len(config.stations), 'station')} on {_count(prisms, 'prism')}"
    if config.imu is None:
        raise ConfigError(
            f"stations: {setup} cannot give poses without an IMU: add the table [imu], or stations until "
            f"{MIN_PRISMS} prisms are tracked",
            key="stations",
        )
    if config.pipeline.estimator != "continuous":
        raise ConfigError(
            f'pipeline.estimator = "{config.pipeline.estimator}": {setup} and an IMU need the estimator "continuous"',
            key="pipeline.estimator",
        )


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def scenario_parameters(scenario: ScenarioConfig, *, imu: bool = False) -> Parameters:
    """Return the parameters of a master in the simulated world: exact set-up and true noise, but no IMU.

    The prisms of a robot with an IMU are those that a station tracks, as for a master. With ``imu``: with the robot's IMU,
    as its class and its place determine it, without errors of the device.
    """
    tracked = {station.prism for station in scenario.stations}
    prisms = [each for each in scenario.prisms if scenario.imu.model == "none" or each.prism in tracked]
    return Parameters(
        stations=tuple(
            StationParameters(
                station=station.station,
                prism=station.prism,
                T_station1_station=level_frame(station),
                prism_constant_m=station.prism_constant_mm / 1e3,
                noise=noise(station.noise),
            )
            for station in scenario.stations
        ),
        prisms=tuple(PrismPosition(prism=p.prism, position_m=p.position_m) for p in prisms),
        pipeline=pipeline_parameters(scenario.pipeline),
        reference_point=scenario.reference_point.point(),
        imu=_simulated_imu(scenario.imu) if imu else None,
    )


def _simulated_imu(config: SimulatedImu) -> ImuParameters | None:
    if config.model == "none":
        return None
    x, y, z, w = config.orientation_xyzw
    norm = math.hypot(x, y, z, w)
    return ImuParameters(
        position_m=config.position_m,
        orientation_xyzw=(x / norm, y / norm, z / norm, w / norm),
        noise=IMU_NOISE[config.model],
    )


def pipeline_parameters(pipeline: PipelineConfig) -> PipelineParameters:
    """Convert the configuration of the pipeline."""
    lag_ns = round(pipeline.lag_s * 1e9)
    delays_ns = sorted(round(delay_s * 1e9) for delay_s in pipeline.smoothed_delays_s)
    return PipelineParameters(
        estimator=pipeline.estimator,
        period_ns=round(1e9 / pipeline.rate_hz),
        outage_limit_ns=round(pipeline.outage_limit_s * 1e9),
        transport_limit_ns=round(pipeline.transport_limit_s * 1e9),
        residual_limit_m=pipeline.residual_limit_mm / 1e3,
        tilt_limit_rad=math.radians(pipeline.tilt_limit_deg),
        acceleration_sigma_mps2=pipeline.acceleration_sigma_mps2,
        angular_acceleration_sigma_radps2=pipeline.angular_acceleration_sigma_radps2,
        motion=MotionPrior(
            acceleration_sigma_mps2=pipeline.motion.acceleration_sigma_mps2,
            acceleration_correlation_time_s=pipeline.motion.acceleration_correlation_time_s,
            angular_acceleration_sigma_radps2=pipeline.motion.angular_acceleration_sigma_radps2,
            angular_acceleration_correlation_time_s=pipeline.motion.angular_acceleration_correlation_time_s,
        ),
        noise_scale=pipeline.noise_scale,
        lag_ns=lag_ns,
        # A lag that is shorter than the default delay leaves nothing to smooth before it.
        smoothed_delays_ns=tuple(delay_ns for delay_ns in delays_ns if delay_ns < lag_ns),
        position_sigma_limit_m=pipeline.position_sigma_limit_mm / 1e3,
        rotation_sigma_limit_rad=math.radians(pipeline.rotation_sigma_limit_deg),
        predicted_position_sigma_limit_m=pipeline.predicted_position_sigma_limit_mm / 1e3,
        predicted_rotation_sigma_limit_rad=math.radians(pipeline.predicted_rotation_sigma_limit_deg),
    )


def noise(config: NoiseConfig) -> InstrumentNoise:
    """Convert the noise of an instrument."""
    return InstrumentNoise(
        range_sigma_m=config.range_sigma_mm / 1e3,
        range_sigma_ppm=config.range_sigma_ppm,
        angle_sigma_rad=config.angle_sigma_arcsec * ARCSECOND_RAD,
        pointing_sigma_m=config.pointing_sigma_mm / 1e3,
    )


def level_frame(station: SimulatedStation) -> Matrix4:
    """Return ``T_station1_station`` of a levelled instrument, rotated about the vertical."""
    yaw = math.radians(station.yaw_deg)
    c, s = math.cos(yaw), math.sin(yaw)
    x, y, z = station.position_m
    return ((c, -s, 0.0, x), (s, c, 0.0, y), (0.0, 0.0, 1.0, z), (0.0, 0.0, 0.0, 1.0))
