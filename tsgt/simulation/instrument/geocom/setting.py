"""Procedures that ask a simulated total station who it is and set how it measures (COM, CSV, BAP, TMC, SUP, ...)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from tsgt.simulation.instrument.edm import CONTINUOUS, atmospheric_ppm
from tsgt.simulation.instrument.geocom.answers import OK, Answer, values
from tsgt.simulation.instrument.settings import EDM_MODES, MODE_OF_PROGRAM, PRISM_CONSTANTS_M, USER_PRISM
from tsgt.simulation.instrument.visibility import FIELD_RAD, NARROW_FIELD_RAD
from tsgt.station.geocom import ReturnCode, Rpc

if TYPE_CHECKING:
    from tsgt.simulation.instrument.geocom.answers import Procedures
    from tsgt.simulation.instrument.total_station import SimulatedTotalStation

_MOTORS, _RECOGNITION, _REFLECTORLESS, _POWER_SEARCH, _SIMULATOR = 0x4, 0x8, 0x400, 0x800, 0x4000
_LOW_PERCENT, _EMPTY_PERCENT = 15.0, 3.0
_CLASS_TPS1201: Final = 100
_DATE: Final = (2026, 7, 1, 8, 0, 0, 0)


# --- Who it is ----------------------------------------------------------------------------------------------------


def _power(station: SimulatedTotalStation) -> Answer:
    """How it is fed; the codes that warn come with the values."""
    code = ReturnCode.OK
    if not station.external_power:
        if station.battery_percent <= _EMPTY_PERCENT:
            code = ReturnCode.BATT_EMPTY
        elif station.battery_percent <= _LOW_PERCENT:
            code = ReturnCode.LOW_POWER
    source = 1 if station.external_power else 2
    return Answer(code, (round(station.battery_percent), source, source))


def _set_decimals(station: SimulatedTotalStation, decimals: int) -> Answer:
    if not 0 <= decimals <= 15:
        return Answer(ReturnCode.IVPARAM)
    station.settings.decimals = decimals
    return OK


def _date_time(_station: SimulatedTotalStation) -> Answer:
    year, *rest = _DATE[:6]
    return values(year, *(bytes([part]) for part in rest))


def _set_power(station: SimulatedTotalStation, _reserved: int, mode: int, timeout_ms: int) -> Answer:
    if mode not in (0, 1, 2) or not 60_000 <= timeout_ms <= 6_000_000:
        return Answer(ReturnCode.IVPARAM)
    station.settings.power_mode, station.settings.power_timeout_ms = mode, timeout_ms
    return OK


def _beep(station: SimulatedTotalStation) -> Answer:
    station.beeps.append(station.now_ns())
    return OK


# --- How it measures ----------------------------------------------------------------------------------------------


def _set_edm_mode(station: SimulatedTotalStation, mode: int) -> Answer:
    if mode not in EDM_MODES:
        return Answer(ReturnCode.IVPARAM)
    now_ns = station.advance()
    if mode not in CONTINUOUS:
        station.meter.stop(now_ns)
    station.settings.edm_mode = mode
    return OK


def _set_program(station: SimulatedTotalStation, program: int) -> Answer:
    mode = MODE_OF_PROGRAM.get(program)
    if mode is None:
        return Answer(ReturnCode.IVPARAM)
    station.settings.program = program
    return _set_edm_mode(station, mode)


def _set_prism_type(station: SimulatedTotalStation, prism_type: int, _name: str = "") -> Answer:
    """Set the type, and with it the constant."""
    settings = station.settings
    if prism_type == USER_PRISM:
        settings.prism_constant_m = settings.user_constant_m
    elif prism_type in PRISM_CONSTANTS_M:
        settings.prism_constant_m = PRISM_CONSTANTS_M[prism_type]
    else:
        return Answer(ReturnCode.IVPARAM)
    station.advance()
    settings.prism_type = prism_type
    return OK


def _prism_definition(_station: SimulatedTotalStation, prism_type: int) -> Answer:
    if prism_type not in PRISM_CONSTANTS_M:
        return Answer(ReturnCode.IVPARAM)
    return values(f"type {prism_type}", PRISM_CONSTANTS_M[prism_type], 0)


def _set_user_prism(
    station: SimulatedTotalStation, name: str, constant_m: float, _kind: int, _creator: str
) -> Answer:
    station.settings.user_prism, station.settings.user_constant_m = name, constant_m
    return OK


def _user_prism(station: SimulatedTotalStation, _name: str) -> Answer:
    return values(station.settings.user_constant_m, 0, "tsgt")


def _set_prism_constant(station: SimulatedTotalStation, constant_m: float) -> Answer:
    if _occupied(station):
        return Answer(ReturnCode.TMC_BUSY)
    station.settings.prism_constant_m = constant_m
    return OK


def _set_target_type(station: SimulatedTotalStation, target_type: int) -> Answer:
    if target_type not in (0, 1):
        return Answer(ReturnCode.IVPARAM)
    station.settings.target_type = target_type
    return OK


def _set_air(
    station: SimulatedTotalStation, wavelength_m: float, pressure_hpa: float, dry_c: float, wet_c: float
) -> Answer:
    if not (1e-7 < wavelength_m < 2e-6 and 300 <= pressure_hpa <= 1300 and -60 <= dry_c <= 70):
        return Answer(ReturnCode.IVPARAM)
    station.advance()
    station.settings.air = wavelength_m, pressure_hpa, dry_c, wet_c
    station.settings.atmospheric_ppm = atmospheric_ppm(dry_c, pressure_hpa)
    return OK


def _set_ppm(station: SimulatedTotalStation, ppm: float) -> Answer:
    station.advance()
    station.settings.atmospheric_ppm = ppm
    return OK


def _set_geometric_ppm(
    station: SimulatedTotalStation,
    on: int,
    _scale: float,
    _offset_m: float,
    _height_ppm: float,
    own_ppm: float,
) -> Answer:
    station.advance()
    station.settings.geometric_ppm = own_ppm if on else 0.0
    return OK


def _occupied(station: SimulatedTotalStation) -> bool:
    """Tell whether a distance is stored or being measured: settings that it hangs on cannot be changed then."""
    station.advance()
    return station.meter.holds


def _set_incline(station: SimulatedTotalStation, on: int) -> Answer:
    if _occupied(station):
        return Answer(ReturnCode.TMC_BUSY)
    station.settings.incline = bool(on)
    return OK


def _set_switches(
    station: SimulatedTotalStation, incline: int, axis: int, collimation: int, tilting: int
) -> Answer:
    if _occupied(station):
        return Answer(ReturnCode.TMC_BUSY)
    station.settings.angle_switches = incline, axis, collimation, tilting
    return OK


def _set_orientation(station: SimulatedTotalStation, horizontal_rad: float) -> Answer:
    if _occupied(station):
        return Answer(ReturnCode.TMC_BUSY)
    shown = station.reading(station.telescope.direction())[0]
    station.settings.orientation_rad += horizontal_rad - shown
    return OK


def _set_station(
    station: SimulatedTotalStation, east_m: float, north_m: float, height_m: float, instrument_m: float
) -> Answer:
    if _occupied(station):
        return Answer(ReturnCode.TMC_BUSY)
    station.settings.station_m = east_m, north_m, height_m, instrument_m
    return OK


def _set_height(station: SimulatedTotalStation, height_m: float) -> Answer:
    station.settings.reflector_height_m = height_m
    return OK


def _set_refraction(station: SimulatedTotalStation, on: int, radius_m: float, coefficient: float) -> Answer:
    station.settings.refraction = on, radius_m, coefficient
    return OK


def _set_refraction_method(station: SimulatedTotalStation, method: int) -> Answer:
    station.settings.refraction_method = method
    return OK


def _set_guide_light(station: SimulatedTotalStation, intensity: int) -> Answer:
    if not 0 <= intensity <= 3:
        return Answer(ReturnCode.IVPARAM)
    station.settings.guide_light = intensity
    return OK


def _set_laser(station: SimulatedTotalStation, on: int) -> Answer:
    station.settings.laser = bool(on)
    return OK


def _set_recognition_setting(station: SimulatedTotalStation, setting: int) -> Answer:
    if not 0 <= setting <= 4:
        return Answer(ReturnCode.IVPARAM)
    station.settings.atr_setting = setting
    return OK


def _set_narrow_view(station: SimulatedTotalStation, on: int) -> Answer:
    station.advance()
    station.settings.reduced_field_of_view = bool(on)
    station.telescope.field_rad = NARROW_FIELD_RAD if on else FIELD_RAD
    return OK


SETTING: Procedures = {
    Rpc.COM_NULL_PROC: ("", lambda _: OK),
    Rpc.COM_SET_DOUBLE_PRECISION: ("i", _set_decimals),
    Rpc.COM_GET_DOUBLE_PRECISION: ("", lambda s: values(s.settings.decimals)),
    Rpc.COM_GET_SW_VERSION: ("", lambda _: values(1, 20, 0)),
    Rpc.COM_SWITCH_ON_TPS: ("i", lambda _, _mode: Answer(ReturnCode.NOT_IMPL)),
    Rpc.CSV_GET_INSTRUMENT_NO: ("", lambda s: values(s.serial_number)),
    Rpc.CSV_GET_INSTRUMENT_NAME: ("", lambda s: values(s.name)),
    Rpc.CSV_GET_DATE_TIME: ("", _date_time),
    Rpc.CSV_GET_DATE_TIME_CENTI_SEC: ("", lambda _: values(*_DATE)),
    Rpc.CSV_GET_INT_TEMP: ("", lambda s: values(s.air[0] + 9.0)),
    Rpc.CSV_GET_SW_VERSION: ("", lambda _: values(5, 50, 0)),
    Rpc.CSV_GET_DEVICE_CONFIG: (
        "",
        lambda _: values(
            _CLASS_TPS1201, _MOTORS | _RECOGNITION | _REFLECTORLESS | _POWER_SEARCH | _SIMULATOR
        ),
    ),
    Rpc.CSV_GET_REFLECTORLESS_CLASS: ("", lambda _: values(300)),
    Rpc.CSV_CHECK_POWER: ("", _power),
    Rpc.CTL_GET_UP_COUNTER: ("", lambda _: values(1, 0)),
    Rpc.SUP_GET_CONFIG: ("", lambda s: values(0, s.settings.power_mode, s.settings.power_timeout_ms)),
    Rpc.SUP_SET_CONFIG: ("iii", _set_power),
    Rpc.BMM_BEEP_NORMAL: ("", _beep),
    Rpc.BMM_BEEP_ALARM: ("", _beep),
    Rpc.IOS_BEEP_ON: ("i", lambda s, _volume: _beep(s)),
    Rpc.IOS_BEEP_OFF: ("", lambda _: OK),
    Rpc.EDM_LASERPOINTER: ("i", _set_laser),
    Rpc.EDM_GET_EGL_INTENSITY: ("", lambda s: values(s.settings.guide_light)),
    Rpc.EDM_SET_EGL_INTENSITY: ("i", _set_guide_light),
    Rpc.TMC_SET_EDM_MODE: ("i", _set_edm_mode),
    Rpc.TMC_GET_EDM_MODE: ("", lambda s: values(s.settings.edm_mode)),
    Rpc.BAP_SET_MEAS_PRG: ("i", _set_program),
    Rpc.BAP_GET_MEAS_PRG: ("", lambda s: values(s.settings.program)),
    Rpc.BAP_SET_PRISM_TYPE: ("i", _set_prism_type),
    Rpc.BAP_GET_PRISM_TYPE: ("", lambda s: values(s.settings.prism_type)),
    Rpc.BAP_SET_PRISM_TYPE2: ("is", _set_prism_type),
    Rpc.BAP_GET_PRISM_TYPE2: ("", lambda s: values(s.settings.prism_type, s.settings.user_prism)),
    Rpc.BAP_GET_PRISM_DEF: ("i", _prism_definition),
    Rpc.BAP_SET_USER_PRISM_DEF: ("sdis", _set_user_prism),
    Rpc.BAP_GET_USER_PRISM_DEF: ("s", _user_prism),
    Rpc.BAP_SET_TARGET_TYPE: ("i", _set_target_type),
    Rpc.BAP_GET_TARGET_TYPE: ("", lambda s: values(s.settings.target_type)),
    Rpc.BAP_GET_ATR_SETTING: ("", lambda s: values(s.settings.atr_setting)),
    Rpc.BAP_SET_ATR_SETTING: ("i", _set_recognition_setting),
    Rpc.BAP_GET_RED_ATR_FOV: ("", lambda s: values(s.settings.reduced_field_of_view)),
    Rpc.BAP_SET_RED_ATR_FOV: ("i", _set_narrow_view),
    Rpc.TMC_GET_PRISM_CORR: ("", lambda s: values(s.settings.prism_constant_m)),
    Rpc.TMC_SET_PRISM_CORR: ("d", _set_prism_constant),
    Rpc.TMC_GET_SLOPE_DIST_CORR: ("", lambda s: values(s.settings.ppm(), s.settings.prism_constant_m)),
    Rpc.TMC_GET_ATM_CORR: ("", lambda s: values(*s.settings.air)),
    Rpc.TMC_SET_ATM_CORR: ("dddd", _set_air),
    Rpc.TMC_GET_ATM_PPM: ("", lambda s: values(s.settings.atmospheric_ppm)),
    Rpc.TMC_SET_ATM_PPM: ("d", _set_ppm),
    Rpc.TMC_GET_GEO_PPM: ("", lambda s: values(0, 1.0, 0.0, 0.0, s.settings.geometric_ppm)),
    Rpc.TMC_SET_GEO_PPM: ("idddd", _set_geometric_ppm),
    Rpc.TMC_GET_REFRACTIVE_CORR: ("", lambda s: values(*s.settings.refraction)),
    Rpc.TMC_SET_REFRACTIVE_CORR: ("idd", _set_refraction),
    Rpc.TMC_GET_REFRACTIVE_METHOD: ("", lambda s: values(s.settings.refraction_method)),
    Rpc.TMC_SET_REFRACTIVE_METHOD: ("i", _set_refraction_method),
    Rpc.TMC_GET_INCLINE_SWITCH: ("", lambda s: values(s.settings.incline)),
    Rpc.TMC_SET_INCLINE_SWITCH: ("i", _set_incline),
    Rpc.TMC_GET_ANG_SWITCH: ("", lambda s: values(*s.settings.angle_switches)),
    Rpc.TMC_SET_ANG_SWITCH: ("iiii", _set_switches),
    Rpc.TMC_SET_ORIENTATION: ("d", _set_orientation),
    Rpc.TMC_GET_STATION: ("", lambda s: values(*s.settings.station_m)),
    Rpc.TMC_SET_STATION: ("dddd", _set_station),
    Rpc.TMC_GET_HEIGHT: ("", lambda s: values(s.settings.reflector_height_m)),
    Rpc.TMC_SET_HEIGHT: ("d", _set_height),
}
"""By number: parameters and work."""
