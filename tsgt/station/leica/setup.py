"""How a Leica instrument is set: each setting is read, written where it differs, and read again."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

from tsgt.errors import InstrumentError
from tsgt.station.geocom import Rpc, Verdict, name_of, verdict
from tsgt.station.instrument import Atmosphere
from tsgt.station.leica.identity import done, numbers

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.config import LeicaInstrumentConfig
    from tsgt.station.geocom import GeoComConnection, Parameter, Reply
    from tsgt.station.leica.identity import Identity, Numbers

DECIMALS: Final = 10
"""1e-10 rad and 1e-10 m: nothing is lost, and a reply has two thirds of the bytes that it has with all 15."""

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
"""Number of each type, and what the instrument adds for it, in m; the user's own type has the user's constant."""

_NAMES: Final = {number: name for name, (number, _) in PRISM_TYPES.items()}
_USER: Final = 9
_OWN_PRISM: Final = "TSGT"

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
"""EDM modes for tracking, the best one first. Synchronous tracking is a program of its own."""

_TRIES: Final = 3
_SYNCHRO: Final = 10
_SAME: Final = 1e-6
_SAME_AIR: Final = 0.05


class Settings(NamedTuple):
    """How an instrument measures distances, as read from it; None or empty where it does not say."""

    prism_type: str
    prism_constant_m: float | None
    ppm: float | None
    atmospheric_ppm: float | None
    atmosphere: Atmosphere | None
    distance_mode: str


# --- Settings -----------------------------------------------------------------------------------------------------


class Setting(NamedTuple):
    """Something that an instrument is set to.

    Attributes
    ----------
    name
        For people.
    read
        Procedure that reads it.
    size
        How many values that gives.
    is_right
        Whether these values are what is wanted.
    write
        Procedure that sets it.
    written
        Its parameters, from the values that were read.
    """

    name: str
    read: Rpc
    size: int
    is_right: Callable[[Numbers], bool]
    write: Rpc
    written: Callable[[Numbers], tuple[Parameter, ...]]


def plan(config: LeicaInstrumentConfig, identity: Identity) -> list[Setting]:
    """Return how an instrument is to be set, apart from reflector and distance mode, which change while it works."""
    settings = [
        Setting(
            "switching itself off",
            Rpc.SUP_GET_CONFIG,
            3,
            lambda now: now[1] == 0,
            Rpc.SUP_SET_CONFIG,
            lambda now: (int(now[0]), 0, int(now[2])),
        ),
        _switch("the compensator", Rpc.TMC_GET_INCLINE_SWITCH, Rpc.TMC_SET_INCLINE_SWITCH, 1),
        Setting(
            "the correction of angles",
            Rpc.TMC_GET_ANG_SWITCH,
            4,
            lambda now: now == (1, 1, 1, 1),
            Rpc.TMC_SET_ANG_SWITCH,
            lambda _: (1, 1, 1, 1),
        ),
    ]
    if config.atmosphere is not None:
        settings.append(
            air(
                Atmosphere(
                    temperature_c=config.atmosphere.temperature_c, pressure_hpa=config.atmosphere.pressure_hpa
                )
            )
        )
    if identity.robotic is not False and identity.atr:
        settings.append(
            _switch(
                "fine adjustment to moving prisms",
                Rpc.AUT_GET_FINE_ADJUST_MODE,
                Rpc.AUT_SET_FINE_ADJUST_MODE,
                1,
            )
        )
        if config.reduced_field_of_view:
            settings.append(_switch("the narrow view", Rpc.BAP_GET_RED_ATR_FOV, Rpc.BAP_SET_RED_ATR_FOV, 1))
    return settings


def air(atmosphere: Atmosphere) -> Setting:
    """Return the setting for some air. The wavelength stays as the instrument has it; humidity is taken as 60 %."""
    temperature_c, pressure_hpa = atmosphere.temperature_c, atmosphere.pressure_hpa
    return Setting(
        "the atmosphere",
        Rpc.TMC_GET_ATM_CORR,
        4,
        lambda now: abs(now[1] - pressure_hpa) < _SAME_AIR and abs(now[2] - temperature_c) < _SAME_AIR,
        Rpc.TMC_SET_ATM_CORR,
        lambda now: (now[0], pressure_hpa, temperature_c, wet_temperature_c(temperature_c)),
    )


def wet_temperature_c(temperature_c: float) -> float:
    """Return what a wet thermometer shows at 60 % relative humidity, which is what Leica's formula assumes.

    Notes
    -----
    R. Stull, "Wet-Bulb Temperature from Relative Humidity and Air Temperature", J. Appl. Meteorol. Climatol. 50, 2011,
    equation 1, which holds from -20 to 50 degrees.
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


def _switch(name: str, read: Rpc, write: Rpc, wanted: int) -> Setting:
    return Setting(name, read, 1, lambda now: now[0] == wanted, write, lambda _: (wanted,))


async def ensure(line: GeoComConnection, setting: Setting) -> str:
    """Bring an instrument to a setting.

    Returns
    -------
    str
        Why it is not set, for people; empty when it is.

    Raises
    ------
    InstrumentError
        It does not answer.
    """
    reply = await line.call(setting.read)
    before = numbers(reply, setting.size)
    if before is None:
        return f"{setting.name} cannot be read: {name_of(reply.code)}"
    if setting.is_right(before):
        return ""
    reply = await write(line, setting.write, *setting.written(before))
    after = numbers(await line.call(setting.read), setting.size)
    if after is not None and setting.is_right(after):
        return ""
    return f"{setting.name} cannot be set: {name_of(reply.code)}"


async def write(line: GeoComConnection, rpc: Rpc, *parameters: Parameter) -> Reply:
    """Set something; where a stored distance is in the way, clear that first."""
    reply = await line.call(rpc, *parameters)
    if verdict(reply.code, has_values=False) is Verdict.BUSY:
        await clear(line)
        reply = await line.call(rpc, *parameters)
    return reply


async def clear(line: GeoComConnection) -> None:
    """Stop measuring and forget the distance."""
    await line.call(Rpc.TMC_DO_MEASURE, 3, 1)


async def set_up(line: GeoComConnection, config: LeicaInstrumentConfig, identity: Identity) -> list[str]:
    """Set an instrument up, apart from reflector and distance mode; its measurement is stopped.

    Returns
    -------
    list
        What could not be set, and why; for people.

    Raises
    ------
    InstrumentError
        It does not answer.
    """
    await line.call(Rpc.COM_SET_DOUBLE_PRECISION, DECIMALS)
    await clear(line)
    problems = [problem for setting in plan(config, identity) if (problem := await ensure(line, setting))]
    if identity.robotic is not False and identity.power_search:
        nearest_m, farthest_m = config.search_distance_m
        await line.call(Rpc.AUT_PS_SET_RANGE, nearest_m, max(farthest_m, nearest_m + 10))
        await line.call(Rpc.AUT_PS_ENABLE_RANGE, 1)
    return problems


async def set_reflector(line: GeoComConnection, prism_type: str, constant_m: float | None) -> str:
    """Set type and constant.

    Returns
    -------
    str
        Why it is not known whether they are set, for people; empty when they are.

    Raises
    ------
    InstrumentError
        It does not answer, or has another constant: all distances would be wrong by the difference.
    """
    for _ in range(_TRIES):
        problem, now_m = await _set_reflector(line, prism_type, constant_m)
        if not problem:
            return ""
    wanted_m = PRISM_TYPES[prism_type][1] if constant_m is None else constant_m
    if now_m is not None and not _is_constant(now_m, wanted_m):
        raise InstrumentError(
            f"{line.port.name}: {problem}; the instrument adds {now_m[0] * 1e3:.1f} mm. Set the reflector there by hand, or"
            " prism_type and prism_constant_mm in the configuration to what it shows"
        )
    return problem


async def _set_reflector(
    line: GeoComConnection, prism_type: str, constant_m: float | None
) -> tuple[str, Numbers | None]:
    """Set the type and then the constant, for a type brings its own; return why not, and the constant now."""
    number, own_m = PRISM_TYPES[prism_type]
    wanted_m = own_m if constant_m is None else constant_m
    await ensure(line, _switch("the reflector", Rpc.BAP_GET_TARGET_TYPE, Rpc.BAP_SET_TARGET_TYPE, 0))
    own = constant_m is not None and constant_m != own_m
    now_type = numbers(await line.call(Rpc.BAP_GET_PRISM_TYPE), 1)
    now_m = numbers(await line.call(Rpc.TMC_GET_PRISM_CORR), 1)
    types = (number, _USER) if own else (number,)  # a constant of one's own makes it a type of one's own
    if now_type is not None and now_type[0] in types and _is_constant(now_m, wanted_m):
        return "", now_m
    reply = await write(line, Rpc.BAP_SET_PRISM_TYPE, number)
    now_m = numbers(await line.call(Rpc.TMC_GET_PRISM_CORR), 1)
    if wanted_m is not None and not _is_constant(now_m, wanted_m):
        reply = await write(line, Rpc.TMC_SET_PRISM_CORR, wanted_m)
        if not done(reply):  # the TPS1200 has user prisms instead
            await write(line, Rpc.BAP_SET_USER_PRISM_DEF, _OWN_PRISM, wanted_m, 0, _OWN_PRISM)
            reply = await write(line, Rpc.BAP_SET_PRISM_TYPE2, _USER, _OWN_PRISM)
        now_m = numbers(await line.call(Rpc.TMC_GET_PRISM_CORR), 1)
    if done(reply) and (now_m is None or _is_constant(now_m, wanted_m)):
        return "", now_m
    return f"reflector {prism_type} cannot be set: {name_of(reply.code)}", now_m


def _is_constant(now_m: Numbers | None, wanted_m: float | None) -> bool:
    return now_m is not None and (wanted_m is None or abs(now_m[0] - wanted_m) < _SAME)


async def set_distance_mode(line: GeoComConnection, modes: tuple[int, ...]) -> str:
    """Set the first EDM mode that the instrument accepts, or synchronous tracking without any; return why not."""
    now = numbers(await line.call(Rpc.TMC_GET_EDM_MODE), 1)
    if modes and now is not None and now[0] == modes[0]:
        return ""
    if not modes:
        reply = await write(line, Rpc.BAP_SET_MEAS_PRG, _SYNCHRO)
        return "" if done(reply) else f"synchronous tracking cannot be set: {name_of(reply.code)}"
    for mode in modes:
        reply = await write(line, Rpc.TMC_SET_EDM_MODE, mode)
        if done(reply):
            return ""
    return f"distance mode {EDM_MODES[modes[0]]} cannot be set: {name_of(reply.code)}"


async def read_settings(line: GeoComConnection) -> Settings:
    """Read back how an instrument measures distances."""
    prism = numbers(await line.call(Rpc.BAP_GET_PRISM_TYPE), 1)
    total = numbers(await line.call(Rpc.TMC_GET_SLOPE_DIST_CORR), 2)
    constant = (total[1],) if total is not None else numbers(await line.call(Rpc.TMC_GET_PRISM_CORR), 1)
    ppm = numbers(await line.call(Rpc.TMC_GET_ATM_PPM), 1)
    air_now = numbers(await line.call(Rpc.TMC_GET_ATM_CORR), 4)
    mode = numbers(await line.call(Rpc.TMC_GET_EDM_MODE), 1)
    return Settings(
        prism_type=_NAMES.get(int(prism[0]), f"type {prism[0]:.0f}") if prism is not None else "",
        prism_constant_m=constant[0] if constant is not None else None,
        ppm=total[0] if total is not None else None,
        atmospheric_ppm=ppm[0] if ppm is not None else None,
        atmosphere=Atmosphere(temperature_c=air_now[2], pressure_hpa=air_now[1])
        if air_now is not None
        else None,
        distance_mode=EDM_MODES.get(int(mode[0]), f"mode {mode[0]:.0f}") if mode is not None else "",
    )
