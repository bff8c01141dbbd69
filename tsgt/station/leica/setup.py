"""Settings of a Leica instrument: each is read, written where it differs, and read back.

Every call raises InstrumentError when the instrument does not respond.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

from tsgt.errors import InstrumentError
from tsgt.recording.journal import InstrumentRecord
from tsgt.station.geocom import Outcome, Rpc, name_of, outcome_of
from tsgt.station.instrument import Atmosphere
from tsgt.station.leica.identity import numeric_values, succeeded

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.config import LeicaInstrumentConfig
    from tsgt.station.geocom import GeoComConnection, Parameter, Reply
    from tsgt.station.leica.identity import Identity, Numbers

DECIMALS: Final = 10
"""1e-10 rad and 1e-10 m: lossless, and a reply has two thirds of the bytes that it has with all 15 decimals."""

PRISM_TYPES: Final = {
    "round": (0, 0.0),
    "mini": (1, 0.0175),
    "tape": (2, 0.0344),
    "360": (3, 0.0231),
    "mini_360": (7, 0.0300),
    "mini_zero": (8, 0.0),
    "user": (9, None),
    "grz121": (11, 0.0231),
    "mpr122": (12, 0.0281),
}
"""GeoCOM number and prism constant (m) of each type; the user-defined type has the user's constant."""

_PRISM_TYPE_NAMES: Final = {number: name for name, (number, _) in PRISM_TYPES.items()}
_USER_TYPE: Final = 9
_USER_PRISM_NAME: Final = "TSGT"
_REFLECTOR_PRISM: Final = 1  # BAP_REFLTYPE; 0 is undefined
_REFLECTOR_TAPE: Final = 2

EDM_MODES: Final = {
    1: "single_tape",
    2: "single_standard",
    3: "single_fast",
    5: "reflectorless",
    6: "continuous_standard",
    7: "continuous_dynamic",
    9: "continuous_fast",
    14: "single_precise_tape",
}

TRACKING_MODES: Final = {
    "auto": (9, 7, 6),
    "continuous_fast": (9,),
    "continuous_dynamic": (7,),
    "synchro": (),
}
"""EDM modes for tracking, in order of preference. Synchronous tracking is a measurement program of its own."""

ATMOSPHERE: Final = "the atmosphere"

_TRIES: Final = 3
_SYNCHRO: Final = 10
_CONSTANT_TOLERANCE_M: Final = 1e-6
_ATMOSPHERE_TOLERANCE: Final = 0.05  # hPa and degrees Celsius


class Setting(NamedTuple):
    """A setting and its required value.

    Attributes
    ----------
    name
        For the operator.
    read, size
        Procedure that reads it, and the number of values it returns.
    is_met
        Whether these values are as required.
    write, parameters
        Procedure that writes it, and its parameters given the values that were read.
    """

    name: str
    read: Rpc
    size: int
    is_met: Callable[[Numbers], bool]
    write: Rpc
    parameters: Callable[[Numbers], tuple[Parameter, ...]]


def _constant(name: str, read: Rpc, write: Rpc, *required: int) -> Setting:
    """Return a setting whose values have to be these."""
    return Setting(name, read, len(required), lambda now: now == required, write, lambda _: required)


def required_settings(config: LeicaInstrumentConfig, identity: Identity) -> list[Setting]:
    """Return the required settings but for reflector and distance mode, which change during operation."""
    settings = [
        Setting(
            "switching itself off",
            Rpc.SUP_GET_CONFIG,
            3,
            lambda now: now[1] == 0,
            Rpc.SUP_SET_CONFIG,
            lambda now: (int(now[0]), 0, int(now[2])),
        ),
        _constant("the compensator", Rpc.TMC_GET_INCLINE_SWITCH, Rpc.TMC_SET_INCLINE_SWITCH, 1),
        _constant("the correction of angles", Rpc.TMC_GET_ANG_SWITCH, Rpc.TMC_SET_ANG_SWITCH, 1, 1, 1, 1),
    ]
    if config.atmosphere is not None:
        air = config.atmosphere
        settings.append(
            atmospheric_correction(Atmosphere(temperature_c=air.temperature_c, pressure_hpa=air.pressure_hpa))
        )
    if identity.robotic is not False and identity.atr:
        settings.append(
            _constant(
                "fine adjustment to moving prisms",
                Rpc.AUT_GET_FINE_ADJUST_MODE,
                Rpc.AUT_SET_FINE_ADJUST_MODE,
                1,
            )
        )
        if config.reduced_field_of_view:
            settings.append(
                _constant("the reduced field of view", Rpc.BAP_GET_RED_ATR_FOV, Rpc.BAP_SET_RED_ATR_FOV, 1)
            )
    return settings


def atmospheric_correction(atmosphere: Atmosphere) -> Setting:
    """Return the setting of the atmospheric correction; the wavelength is kept, the relative humidity is taken as 60 %."""
    temperature_c, pressure_hpa = atmosphere.temperature_c, atmosphere.pressure_hpa
    return Setting(
        ATMOSPHERE,
        Rpc.TMC_GET_ATM_CORR,
        4,
        lambda now: (
            abs(now[1] - pressure_hpa) < _ATMOSPHERE_TOLERANCE
            and abs(now[2] - temperature_c) < _ATMOSPHERE_TOLERANCE
        ),
        Rpc.TMC_SET_ATM_CORR,
        lambda now: (now[0], pressure_hpa, temperature_c, wet_bulb_temperature_c(temperature_c)),
    )


def wet_bulb_temperature_c(temperature_c: float) -> float:
    """Return the wet-bulb temperature at 60 % relative humidity, which Leica's formula assumes.

    R. Stull, J. Appl. Meteorol. Climatol. 50, 2011, equation 1, valid from -20 to 50 degrees Celsius.
    """
    t = min(max(temperature_c, -20.0), 50.0)
    humidity = 60.0
    wet = (
        t * math.atan(0.151977 * math.sqrt(humidity + 8.313659))
        + math.atan(t + humidity)
        - math.atan(humidity - 1.676331)
        + 0.00391838 * math.pow(humidity, 1.5) * math.atan(0.023101 * humidity)
        - 4.686035
    )
    return round(temperature_c + min(wet - t, 0.0), 2)


async def apply_setting(line: GeoComConnection, setting: Setting) -> str:
    """Apply a setting; return the reason why it is not set, empty when it is."""
    reply = await line.call(setting.read)
    before = numeric_values(reply, setting.size)
    if before is None:
        return f"{setting.name} cannot be read: {name_of(reply.code)}"
    if setting.is_met(before):
        return ""
    reply = await _write(line, setting.write, *setting.parameters(before))
    after = numeric_values(await line.call(setting.read), setting.size)
    if after is not None and setting.is_met(after):
        return ""
    return f"{setting.name} cannot be set: {name_of(reply.code)}"


async def _write(line: GeoComConnection, rpc: Rpc, *parameters: Parameter) -> Reply:
    """Write a setting; clear a stored distance that prevents it."""
    reply = await line.call(rpc, *parameters)
    if outcome_of(reply.code, has_values=False) is Outcome.BUSY:
        await clear_distance(line)
        reply = await line.call(rpc, *parameters)
    return reply


async def clear_distance(line: GeoComConnection) -> None:
    """Stop measuring and clear the stored distance."""
    await line.call(Rpc.TMC_DO_MEASURE, 3, 1)


async def set_up(line: GeoComConnection, config: LeicaInstrumentConfig, identity: Identity) -> dict[str, str]:
    """Stop the measurement and apply all settings but reflector and distance mode; return why each is not set, empty if it is."""
    await line.call(Rpc.COM_SET_DOUBLE_PRECISION, DECIMALS)
    await clear_distance(line)
    settings = required_settings(config, identity)
    problems = {setting.name: await apply_setting(line, setting) for setting in settings}
    if identity.robotic is not False and identity.power_search:
        min_m, max_m = config.search_distance_m
        await line.call(Rpc.AUT_PS_SET_RANGE, min_m, max_m)
        await line.call(Rpc.AUT_PS_ENABLE_RANGE, 1)
    return problems


async def set_reflector(line: GeoComConnection, prism_type: str, constant_m: float | None) -> str:
    """Set prism type and constant; return the reason why they are not known to be set, empty when they are.

    Raises InstrumentError if the instrument does not respond, or has another constant: all distances would be off by
    the difference.
    """
    for _ in range(_TRIES):
        problem, now_m = await _set_reflector(line, prism_type, constant_m)
        if not problem:
            return ""
    required_m = PRISM_TYPES[prism_type][1] if constant_m is None else constant_m
    if now_m is not None and not _has_constant(now_m, required_m):
        raise InstrumentError(
            f"{line.port.name}: {problem}; the instrument adds {now_m[0] * 1e3:.1f} mm. Set the reflector at the instrument,"
            " or prism_type and prism_constant_mm in the configuration to what it shows"
        )
    return problem


async def _set_reflector(
    line: GeoComConnection, prism_type: str, constant_m: float | None
) -> tuple[str, Numbers | None]:
    """Set the type, then the constant, as a type sets its own constant; return the problem, and the constant now."""
    number, type_constant_m = PRISM_TYPES[prism_type]
    required_m = type_constant_m if constant_m is None else constant_m
    await apply_setting(line, _constant("the reflector", Rpc.BAP_GET_TARGET_TYPE, Rpc.BAP_SET_TARGET_TYPE, 0))
    custom = constant_m is not None and constant_m != type_constant_m
    now_type = numeric_values(await line.call(Rpc.BAP_GET_PRISM_TYPE), 1)
    now_m = numeric_values(await line.call(Rpc.TMC_GET_PRISM_CORR), 1)
    types = (
        (number, _USER_TYPE) if custom else (number,)
    )  # a custom constant turns it into a user-defined type
    if now_type is not None and now_type[0] in types and _has_constant(now_m, required_m):
        return "", now_m
    reply = await _write(line, Rpc.BAP_SET_PRISM_TYPE, number)
    now_m = numeric_values(await line.call(Rpc.TMC_GET_PRISM_CORR), 1)
    if required_m is not None and not _has_constant(now_m, required_m):
        reply = await _write(line, Rpc.TMC_SET_PRISM_CORR, required_m)
        if not succeeded(reply):  # the TPS1200 has user-defined prisms instead
            reflector = _REFLECTOR_TAPE if prism_type == "tape" else _REFLECTOR_PRISM
            await _write(
                line, Rpc.BAP_SET_USER_PRISM_DEF, _USER_PRISM_NAME, required_m, reflector, _USER_PRISM_NAME
            )
            reply = await _write(line, Rpc.BAP_SET_PRISM_TYPE2, _USER_TYPE, _USER_PRISM_NAME)
        now_m = numeric_values(await line.call(Rpc.TMC_GET_PRISM_CORR), 1)
    if succeeded(reply) and (now_m is None or _has_constant(now_m, required_m)):
        return "", now_m
    return f"reflector {prism_type} cannot be set: {name_of(reply.code)}", now_m


def _has_constant(now_m: Numbers | None, required_m: float | None) -> bool:
    return now_m is not None and (required_m is None or abs(now_m[0] - required_m) < _CONSTANT_TOLERANCE_M)


async def set_tracking_mode(line: GeoComConnection, mode: str) -> str:
    """Set a mode of ``TRACKING_MODES``; where the instrument lacks it, use the fastest that it has, and return the problem."""
    problem = await set_distance_mode(line, TRACKING_MODES[mode])
    if problem and mode != "auto" and not await set_distance_mode(line, TRACKING_MODES["auto"]):
        now = numeric_values(await line.call(Rpc.TMC_GET_EDM_MODE), 1)
        used = EDM_MODES.get(int(now[0]), "") if now is not None else ""
        problem += f"; {used or 'another mode'} is used"
    return problem


async def set_distance_mode(line: GeoComConnection, modes: tuple[int, ...]) -> str:
    """Set the first EDM mode that the instrument accepts, or synchronous tracking if there is none; return the problem."""
    now = numeric_values(await line.call(Rpc.TMC_GET_EDM_MODE), 1)
    if modes and now is not None and now[0] == modes[0]:
        return ""
    if not modes:
        reply = await _write(line, Rpc.BAP_SET_MEAS_PRG, _SYNCHRO)
        return "" if succeeded(reply) else f"synchronous tracking cannot be set: {name_of(reply.code)}"
    for mode in modes:
        reply = await _write(line, Rpc.TMC_SET_EDM_MODE, mode)
        if succeeded(reply):
            return ""
    return f"distance mode {EDM_MODES[modes[0]]} cannot be set: {name_of(reply.code)}"


async def read_settings(line: GeoComConnection) -> tuple[InstrumentRecord, float | None]:
    """Read the settings of distance measurement back; return also the geometric ppm, None where it is unknown."""
    prism = numeric_values(await line.call(Rpc.BAP_GET_PRISM_TYPE), 1)
    total = numeric_values(await line.call(Rpc.TMC_GET_SLOPE_DIST_CORR), 2)
    constant = (
        (total[1],) if total is not None else numeric_values(await line.call(Rpc.TMC_GET_PRISM_CORR), 1)
    )
    ppm = numeric_values(await line.call(Rpc.TMC_GET_ATM_PPM), 1)
    air = numeric_values(await line.call(Rpc.TMC_GET_ATM_CORR), 4)
    mode = numeric_values(await line.call(Rpc.TMC_GET_EDM_MODE), 1)
    atmospheric_ppm = ppm[0] if ppm is not None else None
    total_ppm = total[0] if total is not None else None
    record = InstrumentRecord(
        make="Leica",
        prism_type=_PRISM_TYPE_NAMES.get(int(prism[0]), f"type {prism[0]:.0f}") if prism is not None else "",
        prism_constant_m=constant[0] if constant is not None else None,
        atmospheric_ppm=atmospheric_ppm if total_ppm is None else total_ppm,
        temperature_c=air[2] if air is not None else None,
        pressure_hpa=air[1] if air is not None else None,
        distance_mode=EDM_MODES.get(int(mode[0]), f"mode {mode[0]:.0f}") if mode is not None else "",
    )
    if total_ppm is None or atmospheric_ppm is None:
        return record, None
    return record, total_ppm - atmospheric_ppm
