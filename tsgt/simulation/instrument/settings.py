"""Settings of a simulated total station, and constants of its manual."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from tsgt.model import ARCSECOND_RAD
from tsgt.simulation.instrument.edm import atmospheric_ppm

ANGLE_SIGMA_RAD: Final = 1.0 * ARCSECOND_RAD
"""Angle accuracy that it reports."""

COMPENSATOR_SIGMA_RAD: Final = 0.5 * ARCSECOND_RAD

TAPE: Final = 2
USER_PRISM: Final = 9

OFF: Final = 2
"""Power mode: switch off when idle."""

PRISM_CONSTANTS_M: Final = {
    0: 0.0,
    1: 0.0175,
    TAPE: 0.0344,
    3: 0.0231,
    7: 0.0300,
    8: 0.0,
    10: 0.0344,
    11: 0.0231,
    12: 0.0281,
}
"""Leica prism constants by prism type; user-defined types have their own."""

MODE_OF_PROGRAM: Final = {0: 2, 1: 3, 2: 4, 3: 5, 4: 7, 6: 8, 7: 10, 8: 11, 9: 12, 10: 9}
"""EDM mode by BAP measuring program."""


@dataclass(slots=True)
class Settings:
    """GeoCOM settings, initially those of an instrument that an operator has set up.

    Attributes
    ----------
    atr, lock
        User switches: automatic target recognition, tracking.
    edm_mode, program, target_type
        Distance measurement: numbers of TMC and of BAP; target type 0 reflector, 1 reflectorless.
    prism_constant_m, user_constant_m
        Constant that is added; constant of the user-defined prism type.
    search_area
        PowerSearch window: centre and range of both angles in rad, and whether it is enabled.
    atmosphere
        Wavelength in m, pressure in hPa, dry and wet temperature in degrees Celsius (TMC_SetAtmCorr).
    geometric_ppm, atmospheric_ppm
        Scale corrections in 1e-6; the latter follows from ``atmosphere`` unless set directly.
    incline, angle_switches
        Compensator; corrections of tilt, standing axis, collimation and tilting axis.
    power_mode, power_timeout_ms
        Action after this idle time: 0 none, 2 off.
    """

    decimals: int = 15  # decimal places of doubles in requests and responses
    atr: bool = True
    lock: bool = True
    fine_adjust_mode: int = 0
    tolerance_rad: tuple[float, float] = (4.7e-6, 4.7e-6)
    timeout_s: tuple[float, float] = (10.0, 10.0)
    edm_mode: int = 2
    program: int = 0
    target_type: int = 0
    prism_type: int = 0
    prism_constant_m: float = 0.0
    user_constant_m: float = 0.0
    user_prism: str = ""
    user_reflector: int = 1  # 1 prism, 2 tape
    search_area: tuple[float, float, float, float, int] = (0.0, 0.0, 0.0, 0.0, 0)
    spiral_rad: tuple[float, float] = (0.07, 0.07)  # ATR search window, full width and height
    search_range_m: tuple[int, int] = (0, 400)  # nearest and farthest prism that PowerSearch accepts
    search_range_on: bool = False
    atr_setting: int = 0
    reduced_field_of_view: bool = False
    atmosphere: tuple[float, float, float, float] = (6.58e-7, 1013.25, 12.0, 8.6)
    atmospheric_ppm: float = field(default_factory=lambda: atmospheric_ppm(12.0, 1013.25))
    geometric_ppm: float = 0.0
    refraction: tuple[int, float, float] = (1, 6_378_000.0, 0.13)
    refraction_method: int = 1
    incline: bool = True
    angle_switches: tuple[int, int, int, int] = (1, 1, 1, 1)
    orientation_rad: float = 0.0  # horizontal circle reading of the true direction zero
    station_m: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    reflector_height_m: float = 0.0
    guide_light: int = 0
    laser: bool = False
    power_mode: int = 2
    power_timeout_ms: int = 900_000

    def power_cycle(self) -> None:
        """Reset the settings that do not survive power-off."""
        self.decimals = 15
        self.atr = self.lock = False
        self.timeout_s = (10.0, 10.0)
        self.laser = False

    def ppm(self) -> float:
        """Return the total scale correction of distances, in 1e-6."""
        return self.atmospheric_ppm + self.geometric_ppm
