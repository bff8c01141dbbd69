"""Commands that turn the telescope and find prisms (AUT, AUS, MOT)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from tsgt.simulation.instrument.geocom.commands import (
    INVALID_PARAMETER,
    OK,
    Command,
    Response,
    getter,
    setter,
)
from tsgt.simulation.instrument.telescope import Lock
from tsgt.simulation.instrument.visibility import MAX_TURN_RATE_RADPS, angular_separation_rad
from tsgt.station.geocom import ReturnCode, Rpc

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.simulation.instrument.geocom.commands import Commands, Job
    from tsgt.simulation.instrument.model import TotalStationModel
    from tsgt.simulation.instrument.visibility import PolarDirection

FINE_S: Final = (0.4, 0.9)
"""Duration of fine pointing at a prism in the field of view; an assumption."""

LOCK_S: Final = (0.3, 0.8)
"""Duration of locking in; an assumption."""

POSITIONING_OVERHEAD_S: Final = 0.5
"""Duration of a movement in addition to turning; an assumption."""

FINE_LIMIT_S: Final = 5.0
"""Timeout of AUT_FineAdjust, by the manual."""

SPIRAL_RADPS: Final = 0.04
"""Growth of the ATR search window; an assumption."""

POINT_TOLERANCE: Final = 1
STILL_RADPS: Final = 0.005
"""Fine pointing at a faster prism requires point tolerance; the number is an assumption."""

CHANGE_FACE_S: Final = 4.0

SWING_RAD: Final = math.radians(9.0)
"""PowerSearch with swing starts 10 gon in the opposite direction, by the manual."""


def _resume_after_s(station: TotalStationModel, seconds: float) -> int:
    return station.now_ns() + round(seconds * 1e9)


def _resume_after_random_s(station: TotalStationModel, span_s: tuple[float, float]) -> int:
    return _resume_after_s(station, station.draw(span_s))


# --- Positioning -------------------------------------------------------------------------------------------------------


def _turn(station: TotalStationModel, direction: PolarDirection) -> Job:
    """Release the lock and turn; no measurement while turning."""
    station.advance()
    station.telescope.release()
    away_rad = max(angular_separation_rad(station.telescope.direction(), direction))
    horizontal_rad = abs(math.remainder(direction[0] - station.telescope.direction()[0], math.tau))
    station.telescope.moving = True
    try:
        yield _resume_after_s(
            station, POSITIONING_OVERHEAD_S + max(away_rad, horizontal_rad) / MAX_TURN_RATE_RADPS
        )
        station.advance()
        station.telescope.turn_to(station.with_positioning_error(direction))
    finally:
        station.telescope.moving = False
    return OK


def _make_positioning(
    station: TotalStationModel,
    horizontal_rad: float,
    zenith_rad: float,
    _precise: int,
    recognise: int,
    _dummy: int,
) -> Job:
    if not (math.isfinite(horizontal_rad) and 0 <= zenith_rad <= math.tau):
        return INVALID_PARAMETER
    target = station.true_direction((horizontal_rad, zenith_rad))
    face = int(zenith_rad > math.pi)
    if face != station.face:
        yield _resume_after_s(station, CHANGE_FACE_S)
    yield from _turn(station, target)
    station.face = face
    return (yield from _find_target(station)) if recognise else OK


def _change_face(station: TotalStationModel, _precise: int, recognise: int, _dummy: int) -> Job:
    station.advance()
    station.telescope.release()
    station.telescope.moving = True
    try:
        yield _resume_after_s(station, CHANGE_FACE_S)
    finally:
        station.telescope.moving = False
    station.advance()
    station.face = 1 - station.face
    return (yield from _find_target(station)) if recognise else OK


def _find_target(station: TotalStationModel) -> Job:
    """Finish a positioning: fine pointing, and lock-in if enabled."""
    response = yield from _fine_adjust(station, 0.0, 0.0, 0)
    if response.code == ReturnCode.OK and station.settings.lock:
        response = yield from _lock_in(station)
    return response


# --- Searching ------------------------------------------------------------------------------------------------------


def _fine_adjust(station: TotalStationModel, across_rad: float, up_rad: float, _dummy: int) -> Job:
    return (yield from _spiral(station, across_rad, up_rad, FINE_LIMIT_S))


def _search(station: TotalStationModel, across_rad: float, up_rad: float, _dummy: int) -> Job:
    return (yield from _spiral(station, across_rad, up_rad, station.settings.timeout_s[0] * 6))


def _search_target(station: TotalStationModel, _dummy: int) -> Job:
    return (yield from _search(station, *station.settings.spiral_rad, 0))


def _spiral(station: TotalStationModel, across_rad: float, up_rad: float, limit_s: float) -> Job:
    """Search the field of view, then a window growing to the given full width and height."""
    if not station.settings.atr:
        return Response(ReturnCode.AUT_NOT_ENABLED)
    station.advance()
    if station.telescope.lock is Lock.IN:
        yield _resume_after_s(station, LOCK_S[0])
        return OK
    station.telescope.release()
    start_ns = station.now_ns()
    last_s = min(limit_s, 1.5 + max(across_rad, up_rad) / SPIRAL_RADPS)
    yield _resume_after_random_s(station, FINE_S)
    while True:
        station.advance()
        passed_s = (station.now_ns() - start_ns) / 1e9
        part = min(1.0, passed_s / last_s)
        prism = station.telescope.nearest_prism(across_rad * part / 2, up_rad * part / 2)
        if prism is not None:
            still = station.point_at_prism(prism) < STILL_RADPS
            tolerant = station.settings.fine_adjust_mode == POINT_TOLERANCE
            return OK if tolerant or still else Response(ReturnCode.AUT_ACCURACY)
        if passed_s >= last_s:
            return Response(ReturnCode.AUT_NO_TARGET)
        yield _resume_after_s(station, min(0.5, last_s - passed_s + 1e-3))


def _lock_in(station: TotalStationModel) -> Job:
    if not (station.settings.atr and station.settings.lock):
        return Response(ReturnCode.AUT_NOT_ENABLED)
    yield _resume_after_random_s(station, LOCK_S)
    station.advance()
    if station.telescope.lock is not Lock.IN:
        prism = station.telescope.nearest_prism(0.0, 0.0)
        if prism is None:
            return Response(ReturnCode.ATA_NO_TARGETS)
        station.telescope.follow(prism)
    return OK


def _power_search_window(station: TotalStationModel) -> Job:
    centre, zenith, width, height, on = station.settings.search_area
    if not on or width <= 0 or height <= 0:
        return Response(ReturnCode.AUT_NO_WORKING_AREA)
    middle = station.true_direction((centre, zenith))
    home = station.telescope.direction()
    border = (middle[0] - width / 2) % math.tau
    yield from _turn(station, (border, middle[1]))
    return (yield from _sweep(station, home, border, min(width, math.tau), (middle[1], height / 2)))


def _power_search_next(station: TotalStationModel, direction: int, swing: int) -> Job:
    station.advance()
    home = station.telescope.direction()
    start = home[0] - (SWING_RAD * direction if swing else 0.0)
    yield from _turn(station, (start % math.tau, math.pi / 2))
    return (yield from _sweep(station, home, start, math.tau * direction, (math.pi / 2, math.radians(20.0))))


def _sweep(
    station: TotalStationModel,
    home: PolarDirection,
    start_rad: float,
    turn_rad: float,
    height: tuple[float, float],
) -> Job:
    """Turn from a direction (positive: clockwise) and stop at the first prism within the strip."""
    station.telescope.moving = True
    try:
        met = station.power_search(start_rad, turn_rad, height)
        if met is None:
            yield _resume_after_s(station, abs(turn_rad) / MAX_TURN_RATE_RADPS)
            yield from _turn(station, home)
            return Response(ReturnCode.AUT_NO_TARGET)
        prism, turn_rad = met
        yield _resume_after_s(station, turn_rad / MAX_TURN_RATE_RADPS)
        yield _resume_after_s(station, 2 * POSITIONING_OVERHEAD_S)
        station.advance()
        station.point_at_prism(prism)
    finally:
        station.telescope.moving = False
    if station.telescope.nearest_prism(0.0, 0.0) is None:
        return Response(ReturnCode.AUT_NO_TARGET)
    return OK


# --- Settings -----------------------------------------------------------------------------------------------------


def _set_atr(station: TotalStationModel, on: int) -> Response:
    """Switch target recognition; switching it on ends the lock."""
    station.advance()
    if on and station.settings.lock:
        station.settings.lock = False
        station.telescope.release()
    station.settings.atr = bool(on)
    return OK


def _set_lock(station: TotalStationModel, on: int) -> Response:
    station.advance()
    station.settings.lock = bool(on)
    if on:
        station.settings.atr = True
    else:
        station.telescope.release()
    return OK


def _search_range_is_valid(nearest_m: int, farthest_m: int) -> bool:
    return nearest_m >= 0 and farthest_m <= 400 and farthest_m >= nearest_m + 10


def _both_within(low: float, high: float) -> Callable[[float, float], bool]:
    return lambda horizontal, zenith: low <= horizontal <= high and low <= zenith <= high


POINTING_COMMANDS: Commands = {
    Rpc.AUT_MAKE_POSITIONING: Command("ddiii", _make_positioning),
    Rpc.AUT_CHANGE_FACE: Command("iii", _change_face),
    Rpc.AUT_FINE_ADJUST: Command("ddi", _fine_adjust),
    Rpc.AUT_SEARCH: Command("ddi", _search),
    Rpc.BAP_SEARCH_TARGET: Command("i", _search_target),
    Rpc.AUT_LOCK_IN: Command("", _lock_in),
    Rpc.AUT_PS_SEARCH_WINDOW: Command("", _power_search_window),
    Rpc.AUT_PS_SEARCH_NEXT: Command("ii", _power_search_next),
    Rpc.AUT_PS_SET_RANGE: setter("ii", "search_range_m", _search_range_is_valid),
    Rpc.AUT_PS_ENABLE_RANGE: setter("i", "search_range_on"),
    Rpc.AUT_SET_SEARCH_AREA: setter("ddddi", "search_area"),
    Rpc.AUT_GET_SEARCH_AREA: getter("search_area"),
    Rpc.AUT_SET_USER_SPIRAL: setter("dd", "spiral_rad"),
    Rpc.AUT_GET_USER_SPIRAL: getter("spiral_rad"),
    Rpc.AUT_SET_FINE_ADJUST_MODE: setter("i", "fine_adjust_mode", lambda mode: mode in (0, 1, 2)),
    Rpc.AUT_GET_FINE_ADJUST_MODE: getter("fine_adjust_mode"),
    Rpc.AUT_SET_TOL: setter("dd", "tolerance_rad", _both_within(1.5e-6, 1.6e-4)),
    Rpc.AUT_READ_TOL: getter("tolerance_rad"),
    Rpc.AUT_SET_TIMEOUT: setter("dd", "timeout_s", _both_within(7.0, 60.0)),
    Rpc.AUT_READ_TIMEOUT: getter("timeout_s"),
    Rpc.AUT_SET_ATR_STATUS: Command("i", _set_atr),
    Rpc.AUT_GET_ATR_STATUS: getter("atr"),
    Rpc.AUT_SET_LOCK_STATUS: Command("i", _set_lock),
    Rpc.AUT_GET_LOCK_STATUS: getter("lock"),
    Rpc.AUS_SET_USER_ATR_STATE: Command("i", _set_atr),
    Rpc.AUS_GET_USER_ATR_STATE: getter("atr"),
    Rpc.AUS_SET_USER_LOCK_STATE: Command("i", _set_lock),
    Rpc.AUS_GET_USER_LOCK_STATE: getter("lock"),
    Rpc.MOT_SET_VELOCITY: Command("dd", lambda _, _horizontal, _vertical: OK),
    Rpc.MOT_START_CONTROLLER: Command("i", lambda _, _mode: OK),
    Rpc.MOT_STOP_CONTROLLER: Command("i", lambda _, _mode: OK),
}

LICENSED_RPCS = frozenset(
    rpc
    for rpc in POINTING_COMMANDS
    if rpc // 1000 == 9
    or rpc in (Rpc.BAP_SEARCH_TARGET, Rpc.AUS_SET_USER_ATR_STATE, Rpc.AUS_SET_USER_LOCK_STATE)
)
"""Commands that need the option GeoCOM Robotic."""
