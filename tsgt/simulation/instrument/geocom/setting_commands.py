"""Commands that identify a simulated total station and configure its measurements (COM, CSV, BAP, TMC, SUP, ...)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from tsgt.simulation.instrument.edm import CONTINUOUS_MODES, atmospheric_ppm
from tsgt.simulation.instrument.geocom.commands import (
    INVALID_PARAMETER,
    OK,
    Command,
    Response,
    getter,
    setter,
    values,
)
from tsgt.simulation.instrument.settings import MODE_OF_PROGRAM, PRISM_CONSTANTS_M, USER_PRISM
from tsgt.simulation.instrument.visibility import HALF_FIELD_OF_VIEW_RAD, REDUCED_HALF_FIELD_OF_VIEW_RAD
from tsgt.station.geocom import ReturnCode, Rpc

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.simulation.instrument.geocom.commands import Commands
    from tsgt.simulation.instrument.model import TotalStationModel

_LOW_PERCENT, _EMPTY_PERCENT = 15.0, 3.0
_CLASS_TPS1201: Final = 100
_DATE: Final = (2026, 7, 1, 8, 0, 0, 0)


def _check_power(station: TotalStationModel) -> Response:
    """Report battery level and power source; the warning codes come with values."""
    code = ReturnCode.OK
    if not station.external_power:
        if station.battery_percent <= _EMPTY_PERCENT:
            code = ReturnCode.BATT_EMPTY
        elif station.battery_percent <= _LOW_PERCENT:
            code = ReturnCode.LOW_POWER
    source = 1 if station.external_power else 2
    return Response(code, (round(station.battery_percent), source, source))


def _get_date_time(_station: TotalStationModel) -> Response:
    year, *rest = _DATE[:6]
    return values(year, *(bytes([part]) for part in rest))


def _set_power(station: TotalStationModel, _reserved: int, mode: int, timeout_ms: int) -> Response:
    if mode not in (0, 1, 2) or not 60_000 <= timeout_ms <= 6_000_000:
        return INVALID_PARAMETER
    station.settings.power_mode, station.settings.power_timeout_ms = mode, timeout_ms
    return OK


def _beep(station: TotalStationModel, *_volume: int) -> Response:
    station.beeps.append(station.now_ns())
    return OK


def _set_edm_mode(station: TotalStationModel, mode: int) -> Response:
    if mode not in station.generation.edm_modes:
        return INVALID_PARAMETER
    now_ns = station.advance()
    if mode not in CONTINUOUS_MODES:
        station.edm.stop(now_ns)
    station.settings.edm_mode = mode
    return OK


def _set_program(station: TotalStationModel, program: int) -> Response:
    if program not in station.generation.programs:
        return INVALID_PARAMETER
    mode = MODE_OF_PROGRAM[program]
    station.settings.program = program
    return _set_edm_mode(station, mode)


def _set_prism_type(station: TotalStationModel, prism_type: int, _name: str = "") -> Response:
    """Set the prism type and its prism constant."""
    settings = station.settings
    if prism_type not in station.generation.prism_types:
        return INVALID_PARAMETER
    if prism_type == USER_PRISM:
        settings.prism_constant_m = settings.user_constant_m
    else:
        settings.prism_constant_m = PRISM_CONSTANTS_M[prism_type]
    station.advance()
    settings.prism_type = prism_type
    return OK


def _get_prism_definition(_station: TotalStationModel, prism_type: int) -> Response:
    if prism_type not in PRISM_CONSTANTS_M:
        return INVALID_PARAMETER
    return values(f"type {prism_type}", PRISM_CONSTANTS_M[prism_type], 0)


def _set_user_prism(
    station: TotalStationModel, name: str, constant_m: float, reflector: int, _creator: str
) -> Response:
    """Define the user's prism; whether a real instrument refuses an undefined reflector, 0, is not known."""
    if reflector not in (1, 2):
        return INVALID_PARAMETER
    settings = station.settings
    settings.user_prism, settings.user_constant_m, settings.user_reflector = name, constant_m, reflector
    return OK


def _set_atmosphere(
    station: TotalStationModel, wavelength_m: float, pressure_hpa: float, dry_c: float, wet_c: float
) -> Response:
    if not (1e-7 < wavelength_m < 2e-6 and 300 <= pressure_hpa <= 1300 and -60 <= dry_c <= 70):
        return INVALID_PARAMETER
    station.advance()
    station.settings.atmosphere = wavelength_m, pressure_hpa, dry_c, wet_c
    station.settings.atmospheric_ppm = atmospheric_ppm(dry_c, pressure_hpa)
    return OK


def _set_geometric_ppm(
    station: TotalStationModel,
    on: int,
    _scale: float,
    _offset_m: float,
    _height_ppm: float,
    own_ppm: float,
) -> Response:
    station.advance()
    station.settings.geometric_ppm = own_ppm if on else 0.0
    return OK


def _set_orientation(station: TotalStationModel, horizontal_rad: float) -> Response:
    if station.has_distance():
        return Response(ReturnCode.TMC_BUSY)
    shown_rad = station.circle_reading(station.telescope.direction())[0]
    station.settings.orientation_rad += horizontal_rad - shown_rad
    return OK


def _set_reduced_field_of_view(station: TotalStationModel, on: int) -> Response:
    station.advance()
    station.settings.reduced_field_of_view = bool(on)
    station.telescope.field_rad = REDUCED_HALF_FIELD_OF_VIEW_RAD if on else HALF_FIELD_OF_VIEW_RAD
    return OK


def _within(low: float, high: float) -> Callable[[float], bool]:
    return lambda value: low <= value <= high


_SETTINGS: Commands = {
    Rpc.COM_SET_DOUBLE_PRECISION: setter("i", "decimals", _within(0, 15)),
    Rpc.COM_GET_DOUBLE_PRECISION: getter("decimals"),
    Rpc.EDM_LASERPOINTER: setter("i", "laser"),
    Rpc.EDM_SET_EGL_INTENSITY: setter("i", "guide_light", _within(0, 3)),
    Rpc.EDM_GET_EGL_INTENSITY: getter("guide_light"),
    Rpc.BAP_SET_TARGET_TYPE: setter("i", "target_type", _within(0, 1)),
    Rpc.BAP_GET_TARGET_TYPE: getter("target_type"),
    Rpc.BAP_SET_ATR_SETTING: setter("i", "atr_setting", _within(0, 4)),
    Rpc.BAP_GET_ATR_SETTING: getter("atr_setting"),
    Rpc.TMC_SET_PRISM_CORR: setter("d", "prism_constant_m", idle_only=True),
    Rpc.TMC_GET_PRISM_CORR: getter("prism_constant_m"),
    Rpc.TMC_SET_ATM_PPM: setter("d", "atmospheric_ppm", advance=True),
    Rpc.TMC_GET_ATM_PPM: getter("atmospheric_ppm"),
    Rpc.TMC_SET_REFRACTIVE_CORR: setter("idd", "refraction"),
    Rpc.TMC_GET_REFRACTIVE_CORR: getter("refraction"),
    Rpc.TMC_SET_REFRACTIVE_METHOD: setter("i", "refraction_method"),
    Rpc.TMC_GET_REFRACTIVE_METHOD: getter("refraction_method"),
    Rpc.TMC_SET_INCLINE_SWITCH: setter("i", "incline", idle_only=True),
    Rpc.TMC_GET_INCLINE_SWITCH: getter("incline"),
    Rpc.TMC_SET_ANG_SWITCH: setter("iiii", "angle_switches", idle_only=True),
    Rpc.TMC_GET_ANG_SWITCH: getter("angle_switches"),
    Rpc.TMC_SET_STATION: setter("dddd", "station_m", idle_only=True),
    Rpc.TMC_GET_STATION: getter("station_m"),
    Rpc.TMC_SET_HEIGHT: setter("d", "reflector_height_m"),
    Rpc.TMC_GET_HEIGHT: getter("reflector_height_m"),
    Rpc.TMC_GET_EDM_MODE: getter("edm_mode"),
    Rpc.TMC_GET_ATM_CORR: getter("atmosphere"),
    Rpc.BAP_GET_MEAS_PRG: getter("program"),
    Rpc.BAP_GET_PRISM_TYPE: getter("prism_type"),
    Rpc.BAP_GET_RED_ATR_FOV: getter("reduced_field_of_view"),
}

_IDENTITY: Commands = {
    Rpc.COM_NULL_PROC: Command("", lambda _: OK),
    Rpc.COM_GET_SW_VERSION: Command("", lambda _: values(1, 20, 0)),
    Rpc.COM_SWITCH_ON_TPS: Command("i", lambda _, _mode: Response(ReturnCode.NOT_IMPL)),
    Rpc.CSV_GET_INSTRUMENT_NO: Command("", lambda s: values(s.serial_number)),
    Rpc.CSV_GET_INSTRUMENT_NAME: Command("", lambda s: values(s.name)),
    Rpc.CSV_GET_DATE_TIME: Command("", _get_date_time),
    Rpc.CSV_GET_DATE_TIME_CENTI_SEC: Command("", lambda _: values(*_DATE)),
    Rpc.CSV_GET_INT_TEMP: Command("", lambda s: values(s.air[0] + 9.0)),
    Rpc.CSV_GET_SW_VERSION: Command("", lambda _: values(5, 50, 0)),
    Rpc.CSV_GET_DEVICE_CONFIG: Command("", lambda s: values(_CLASS_TPS1201, s.generation.devices)),
    Rpc.CSV_GET_REFLECTORLESS_CLASS: Command("", lambda _: values(300)),
    Rpc.CSV_CHECK_POWER: Command("", _check_power),
    Rpc.CTL_GET_UP_COUNTER: Command("", lambda _: values(1, 0)),
}

SETTING_COMMANDS: Commands = {
    **_IDENTITY,
    **_SETTINGS,
    Rpc.SUP_GET_CONFIG: Command("", lambda s: values(0, s.settings.power_mode, s.settings.power_timeout_ms)),
    Rpc.SUP_SET_CONFIG: Command("iii", _set_power),
    Rpc.BMM_BEEP_NORMAL: Command("", _beep),
    Rpc.BMM_BEEP_ALARM: Command("", _beep),
    Rpc.IOS_BEEP_ON: Command("i", _beep),
    Rpc.IOS_BEEP_OFF: Command("", lambda _: OK),
    Rpc.TMC_SET_EDM_MODE: Command("i", _set_edm_mode),
    Rpc.BAP_SET_MEAS_PRG: Command("i", _set_program),
    Rpc.BAP_SET_PRISM_TYPE: Command("i", _set_prism_type),
    Rpc.BAP_SET_PRISM_TYPE2: Command("is", _set_prism_type),
    Rpc.BAP_GET_PRISM_TYPE2: Command("", lambda s: values(s.settings.prism_type, s.settings.user_prism)),
    Rpc.BAP_GET_PRISM_DEF: Command("i", _get_prism_definition),
    Rpc.BAP_SET_USER_PRISM_DEF: Command("sdis", _set_user_prism),
    Rpc.BAP_GET_USER_PRISM_DEF: Command(
        "s", lambda s, _name: values(s.settings.user_constant_m, s.settings.user_reflector, "tsgt")
    ),
    Rpc.BAP_SET_RED_ATR_FOV: Command("i", _set_reduced_field_of_view),
    Rpc.TMC_GET_SLOPE_DIST_CORR: Command("", lambda s: values(s.settings.ppm(), s.settings.prism_constant_m)),
    Rpc.TMC_SET_ATM_CORR: Command("dddd", _set_atmosphere),
    Rpc.TMC_GET_GEO_PPM: Command("", lambda s: values(0, 1.0, 0.0, 0.0, s.settings.geometric_ppm)),
    Rpc.TMC_SET_GEO_PPM: Command("idddd", _set_geometric_ppm),
    Rpc.TMC_SET_ORIENTATION: Command("d", _set_orientation),
}
