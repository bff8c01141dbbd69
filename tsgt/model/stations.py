"""A station as a master knows it: frame, noise, corrections."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tsgt.model.values import (
    ARCSECOND_RAD,
    IDENTITY4,
    MAX_NUMBER,
    FiniteNumbers,
    Matrix4,
    Vector3,
    check_coordinates,
    check_limits,
    check_rotation,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class InstrumentNoise(FiniteNumbers):
    """One-sigma noise of a single measurement of a total station, in the form of its data sheet."""

    range_sigma_m: float
    """Constant part of the slope distance's noise in m."""
    range_sigma_ppm: float
    """Part proportional to the distance, in 1e-6 of it; both parts add as variances."""
    angle_sigma_rad: float
    """Noise of the horizontal and of the zenith angle in rad, on the sphere: the horizontal angle's own noise is this
    over sin(zenith angle)."""
    pointing_sigma_m: float
    """Pointing noise across and along the line of sight, per axis, in m: tracking jitter and the prism's centring, or
    manual aiming at a foil target."""

    def __post_init__(self) -> None:
        """Reject noise that no instrument has."""
        check_limits(
            self,
            range_sigma_m=(0, 1e3),
            range_sigma_ppm=(0, 1e6),
            angle_sigma_rad=(0, math.pi),
            pointing_sigma_m=(0, 1e3),
        )


TRACKING_NOISE = InstrumentNoise(
    # Trimble S7 data sheet, tracking mode: 4 mm + 2 ppm and 1 arcsecond. The 4 mm are taken as two sigma, the rest as
    # one, which is conservative by 0.1 mm at 100 m. 1 mm of tracking jitter per axis.
    range_sigma_m=0.002,
    range_sigma_ppm=2.0,
    angle_sigma_rad=1.0 * ARCSECOND_RAD,
    pointing_sigma_m=0.001,
)

TARGET_NOISE = InstrumentNoise(
    # Single measurements on reflective foil. Along the line of sight the residuals meet the data sheet's 2 mm + 2 ppm as
    # two sigma; but those of the 18 targets that the paper's authors published are as large across it, where only manual
    # aiming contributes. The most likely values are 0.9 mm of pointing and little range noise.
    range_sigma_m=0.0005,
    range_sigma_ppm=1.0,
    angle_sigma_rad=1.0 * ARCSECOND_RAD,
    pointing_sigma_m=0.0009,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetResidual(FiniteNumbers):
    """The residual of one target in the frame that was solved from all of them."""

    target: int
    """Number of the target."""
    residual_m: float | None
    """Distance between its position as measured by the station, in its solved frame, and by station 1, in m; null for a
    rejected one."""
    leave_one_out_m: float | None
    """The same with the frame solved from the other targets only, in m; null where these were too few."""

    def __post_init__(self) -> None:
        """Reject impossible residuals."""
        check_limits(self, target=(1, MAX_NUMBER))
        for residual_m in (self.residual_m or 0.0, self.leave_one_out_m or 0.0):
            if not 0 <= residual_m <= 1e6:
                raise ValueError(f"a residual is {residual_m:g}, expected 0 to 1e+06 m")


@dataclass(frozen=True, slots=True, kw_only=True)
class StationParameters(FiniteNumbers):
    """Parameters that turn a station's raw measurements into positions in the frame ``station1``."""

    station: int
    """Number of the station, from 1."""
    prism: int
    """Number of the prism that the station tracks by default."""
    T_station1_station: Matrix4 = IDENTITY4
    """Rigid transform, 4x4, that takes coordinates in the station's frame to frame ``station1``, in m."""
    prism_constant_m: float = 0.0
    """Added to every raw slope distance, in m."""
    atmospheric_ppm: float = 0.0
    """Scale correction of the slope distance in 1e-6, only what the instrument did not apply itself."""
    latency_ns: int = 0
    """From the measurement to its host stamp, in ns; subtracted from the stamp. Positive: the stamp is late."""
    time_sigma_s: float = 0.0
    """One sigma of its host stamps in s, beyond that of an instrument on a cable, which is known."""
    vertical_index_rad: float = 0.0
    """Vertical index error in rad: the zenith angle (first face) that the instrument reads, less the true one."""
    collimation_rad: float = 0.0
    """Horizontal collimation error in rad: the line of sight deviates by it clockwise; the horizontal angle is
    too small by that, divided by sin(zenith angle)."""
    noise: InstrumentNoise = TRACKING_NOISE
    """Noise of one measurement."""
    noise_scale: Vector3 = (1.0, 1.0, 1.0)
    """Factors on that noise along the line of sight, horizontally and vertically across it, where estimated; multiplied
    with ``noise_scale`` of the pipeline. For ``continuous``."""
    targets: tuple[TargetResidual, ...] = ()
    """Targets from which the frame was solved, with their residuals; empty where unknown, and for station 1."""

    def __post_init__(self) -> None:
        """Reject impossible parameters."""
        check_limits(
            self,
            station=(1, MAX_NUMBER),
            prism=(1, MAX_NUMBER),
            prism_constant_m=(-10, 10),
            atmospheric_ppm=(-1e4, 1e4),
            latency_ns=(-(10**12), 10**12),
            time_sigma_s=(0, 1),
            vertical_index_rad=(-0.1, 0.1),
            collimation_rad=(-0.1, 0.1),
        )
        for factor in self.noise_scale:
            if not 1e-3 <= factor <= 1e3:
                raise ValueError(f"a factor of noise_scale is {factor}, expected 0.001 to 1000")
        check_rotation("T_station1_station", self.T_station1_station)
        check_coordinates("T_station1_station", (row[3] for row in self.T_station1_station))
