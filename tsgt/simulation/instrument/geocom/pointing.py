"""Procedures that move the telescope of a simulated total station and find prisms (AUT, AUS, MOT)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from tsgt.simulation.instrument.geocom.answers import OK, Answer, values
from tsgt.simulation.instrument.telescope import Lock
from tsgt.simulation.instrument.visibility import HEAD_SPEED_RADPS, apart_rad
from tsgt.station.geocom import ReturnCode, Rpc

if TYPE_CHECKING:
    from tsgt.simulation.instrument.geocom.answers import Job, Procedures
    from tsgt.simulation.instrument.total_station import SimulatedTotalStation
    from tsgt.simulation.instrument.visibility import Direction2

FINE_S: Final = (0.4, 0.9)
"""Fine pointing at a prism that is in the field of view; an assumption."""

LOCK_S: Final = (0.3, 0.8)
"""Locking in; an assumption."""

SETTLE_S: Final = 0.5
"""What a movement takes besides turning; an assumption."""

FINE_LIMIT_S: Final = 5.0
"""AUT_FineAdjust gives up after this, by the manual."""

SPIRAL_RADPS: Final = 0.04
"""How fast a search with the target recognition grows its window; an assumption."""

POINT_TOLERANCE: Final = 1
STILL_RADPS: Final = 0.005
"""A prism that moves faster can be pointed at finely only with point tolerance; the number is an assumption."""

CHANGE_FACE_S: Final = 4.0

SWING_RAD: Final = math.radians(9.0)
"""PowerSearch with a swing begins 10 gon the other way, by the manual."""


def _wait_s(station: SimulatedTotalStation, seconds: float) -> int:
    return station.now_ns() + round(seconds * 1e9)


def _drawn(station: SimulatedTotalStation, span_s: tuple[float, float]) -> int:
    return _wait_s(station, station.draw(span_s))


# --- Moving -------------------------------------------------------------------------------------------------------


def _turn(station: SimulatedTotalStation, direction: Direction2) -> Job:
    """Turn there; a lock is let go, and nothing is measured on the way."""
    station.advance()
    station.telescope.release()
    away_rad = max(apart_rad(station.telescope.direction(), direction))
    horizontal_rad = abs(math.remainder(direction[0] - station.telescope.direction()[0], math.tau))
    station.telescope.moving = True
    try:
        yield _wait_s(station, SETTLE_S + max(away_rad, horizontal_rad) / HEAD_SPEED_RADPS)
        station.advance()
        station.telescope.turn_to(station.nearly(direction))
    finally:
        station.telescope.moving = False
    return OK


def _make_positioning(
    station: SimulatedTotalStation,
    horizontal_rad: float,
    zenith_rad: float,
    _precise: int,
    recognise: int,
    _dummy: int,
) -> Job:
    if not (math.isfinite(horizontal_rad) and 0 <= zenith_rad <= math.tau):
        return Answer(ReturnCode.IVPARAM)
    target = station.true_direction((horizontal_rad, zenith_rad))
    face = int(zenith_rad > math.pi)
    if face != station.face:
        yield _wait_s(station, CHANGE_FACE_S)
    yield from _turn(station, target)
    station.face = face
    return (yield from _recognise(station)) if recognise else OK


def _change_face(station: SimulatedTotalStation, _precise: int, recognise: int, _dummy: int) -> Job:
    station.advance()
    station.telescope.release()
    station.telescope.moving = True
    try:
        yield _wait_s(station, CHANGE_FACE_S)
    finally:
        station.telescope.moving = False
    station.advance()
    station.face = 1 - station.face
    return (yield from _recognise(station)) if recognise else OK


def _recognise(station: SimulatedTotalStation) -> Job:
    """End a positioning to a target: point finely, and lock in where the user wants that."""
    answer = yield from _fine_adjust(station, 0.0, 0.0, 0)
    if answer.code == ReturnCode.OK and station.settings.lock:
        answer = yield from _lock_in(station)
    return answer


# --- Finding ------------------------------------------------------------------------------------------------------


def _fine_adjust(station: SimulatedTotalStation, across_rad: float, up_rad: float, _dummy: int) -> Job:
    return (yield from _spiral(station, across_rad, up_rad, FINE_LIMIT_S))


def _search(station: SimulatedTotalStation, across_rad: float, up_rad: float, _dummy: int) -> Job:
    return (yield from _spiral(station, across_rad, up_rad, station.settings.timeout_s[0] * 6))


def _search_target(station: SimulatedTotalStation, _dummy: int) -> Job:
    return (yield from _search(station, *station.settings.spiral_rad, 0))


def _spiral(station: SimulatedTotalStation, across_rad: float, up_rad: float, limit_s: float) -> Job:
    """Look in the field of view, then in a window that grows to the one given, full width and height."""
    if not station.settings.atr:
        return Answer(ReturnCode.AUT_NOT_ENABLED)
    station.advance()
    if station.telescope.lock is Lock.IN:
        yield _wait_s(station, LOCK_S[0])
        return OK
    station.telescope.release()
    begun_ns = station.now_ns()
    last_s = min(limit_s, 1.5 + max(across_rad, up_rad) / SPIRAL_RADPS)
    yield _drawn(station, FINE_S)
    while True:
        station.advance()
        passed_s = (station.now_ns() - begun_ns) / 1e9
        part = min(1.0, passed_s / last_s)
        prism = station.telescope.nearest(across_rad * part / 2, up_rad * part / 2)
        if prism is not None:
            still = station.point_at_prism(prism) < STILL_RADPS
            tolerant = station.settings.fine_adjust_mode == POINT_TOLERANCE
            return OK if tolerant or still else Answer(ReturnCode.AUT_ACCURACY)
        if passed_s >= last_s:
            return Answer(ReturnCode.AUT_NO_TARGET)
        yield _wait_s(station, min(0.5, last_s - passed_s + 1e-3))


def _lock_in(station: SimulatedTotalStation) -> Job:
    if not (station.settings.atr and station.settings.lock):
        return Answer(ReturnCode.AUT_NOT_ENABLED)
    yield _drawn(station, LOCK_S)
    station.advance()
    if station.telescope.lock is not Lock.IN:
        prism = station.telescope.nearest(0.0, 0.0)
        if prism is None:
            return Answer(ReturnCode.ATA_NO_TARGETS)
        station.telescope.follow(prism)
    return OK


def _power_search_window(station: SimulatedTotalStation) -> Job:
    centre, zenith, width, height, on = station.settings.search_area
    if not on or width <= 0 or height <= 0:
        return Answer(ReturnCode.AUT_NO_WORKING_AREA)
    middle = station.true_direction((centre, zenith))
    home = station.telescope.direction()
    border = (middle[0] - width / 2) % math.tau
    yield from _turn(station, (border, middle[1]))
    return (yield from _sweep(station, home, border, min(width, math.tau), (middle[1], height / 2)))


def _power_search_next(station: SimulatedTotalStation, way: int, swing: int) -> Job:
    station.advance()
    home = station.telescope.direction()
    start = home[0] - (SWING_RAD * way if swing else 0.0)
    yield from _turn(station, (start % math.tau, math.pi / 2))
    return (yield from _sweep(station, home, start, math.tau * way, (math.pi / 2, math.radians(20.0))))


def _sweep(
    station: SimulatedTotalStation,
    home: Direction2,
    start_rad: float,
    way_rad: float,
    height: tuple[float, float],
) -> Job:
    """Turn from a direction on (positive: clockwise), and stop at the first prism that lies within the height."""
    station.telescope.moving = True
    try:
        met = station.met_on_the_way(start_rad, way_rad, height)
        if met is None:
            yield _wait_s(station, abs(way_rad) / HEAD_SPEED_RADPS)
            yield from _turn(station, home)
            return Answer(ReturnCode.AUT_NO_TARGET)
        prism, until_rad = met
        yield _wait_s(station, until_rad / HEAD_SPEED_RADPS)
        yield _wait_s(station, 2 * SETTLE_S)
        station.advance()
        station.point_at_prism(prism)
    finally:
        station.telescope.moving = False
    if station.telescope.nearest(0.0, 0.0) is None:
        return Answer(ReturnCode.AUT_NO_TARGET)
    return OK


# --- Switches -----------------------------------------------------------------------------------------------------


def _set_recognition(station: SimulatedTotalStation, on: int) -> Answer:
    """Switch the target recognition; on while following, it lets the prism go."""
    station.advance()
    if on and station.settings.lock:
        station.settings.lock = False
        station.telescope.release()
    station.settings.atr = bool(on)
    return OK


def _set_following(station: SimulatedTotalStation, on: int) -> Answer:
    station.advance()
    station.settings.lock = bool(on)
    if on:
        station.settings.atr = True
    else:
        station.telescope.release()
    return OK


def _set_range(station: SimulatedTotalStation, least_m: int, most_m: int) -> Answer:
    if not (least_m >= 0 and most_m <= 400 and most_m >= least_m + 10):
        return Answer(ReturnCode.IVPARAM)
    station.settings.search_range_m = least_m, most_m
    return OK


def _enable_range(station: SimulatedTotalStation, on: int) -> Answer:
    station.settings.search_range_on = bool(on)
    return OK


def _set_area(
    station: SimulatedTotalStation,
    horizontal_rad: float,
    zenith_rad: float,
    width_rad: float,
    height_rad: float,
    on: int,
) -> Answer:
    station.settings.search_area = (horizontal_rad, zenith_rad, width_rad, height_rad, on)
    return OK


def _set_spiral(station: SimulatedTotalStation, width_rad: float, height_rad: float) -> Answer:
    station.settings.spiral_rad = width_rad, height_rad
    return OK


def _set_fine_adjust_mode(station: SimulatedTotalStation, mode: int) -> Answer:
    if mode not in (0, 1, 2):
        return Answer(ReturnCode.IVPARAM)
    station.settings.fine_adjust_mode = mode
    return OK


def _set_tolerance(station: SimulatedTotalStation, horizontal_rad: float, zenith_rad: float) -> Answer:
    if not all(1.5e-6 <= tolerance <= 1.6e-4 for tolerance in (horizontal_rad, zenith_rad)):
        return Answer(ReturnCode.IVPARAM)
    station.settings.tolerance_rad = horizontal_rad, zenith_rad
    return OK


def _set_timeout(station: SimulatedTotalStation, horizontal_s: float, zenith_s: float) -> Answer:
    if not all(7.0 <= timeout_s <= 60.0 for timeout_s in (horizontal_s, zenith_s)):
        return Answer(ReturnCode.IVPARAM)
    station.settings.timeout_s = horizontal_s, zenith_s
    return OK


SEARCHING: Procedures = {
    Rpc.AUT_MAKE_POSITIONING: ("ddiii", _make_positioning),
    Rpc.AUT_CHANGE_FACE: ("iii", _change_face),
    Rpc.AUT_FINE_ADJUST: ("ddi", _fine_adjust),
    Rpc.AUT_SEARCH: ("ddi", _search),
    Rpc.BAP_SEARCH_TARGET: ("i", _search_target),
    Rpc.AUT_LOCK_IN: ("", _lock_in),
    Rpc.AUT_PS_SEARCH_WINDOW: ("", _power_search_window),
    Rpc.AUT_PS_SEARCH_NEXT: ("ii", _power_search_next),
    Rpc.AUT_PS_SET_RANGE: ("ii", _set_range),
    Rpc.AUT_PS_ENABLE_RANGE: ("i", _enable_range),
    Rpc.AUT_SET_SEARCH_AREA: ("ddddi", _set_area),
    Rpc.AUT_GET_SEARCH_AREA: ("", lambda station: values(*station.settings.search_area)),
    Rpc.AUT_SET_USER_SPIRAL: ("dd", _set_spiral),
    Rpc.AUT_GET_USER_SPIRAL: ("", lambda station: values(*station.settings.spiral_rad)),
    Rpc.AUT_SET_FINE_ADJUST_MODE: ("i", _set_fine_adjust_mode),
    Rpc.AUT_GET_FINE_ADJUST_MODE: ("", lambda station: values(station.settings.fine_adjust_mode)),
    Rpc.AUT_SET_TOL: ("dd", _set_tolerance),
    Rpc.AUT_READ_TOL: ("", lambda station: values(*station.settings.tolerance_rad)),
    Rpc.AUT_SET_TIMEOUT: ("dd", _set_timeout),
    Rpc.AUT_READ_TIMEOUT: ("", lambda station: values(*station.settings.timeout_s)),
    Rpc.AUT_SET_ATR_STATUS: ("i", _set_recognition),
    Rpc.AUT_GET_ATR_STATUS: ("", lambda station: values(station.settings.atr)),
    Rpc.AUT_SET_LOCK_STATUS: ("i", _set_following),
    Rpc.AUT_GET_LOCK_STATUS: ("", lambda station: values(station.settings.lock)),
    Rpc.AUS_SET_USER_ATR_STATE: ("i", _set_recognition),
    Rpc.AUS_GET_USER_ATR_STATE: ("", lambda station: values(station.settings.atr)),
    Rpc.AUS_SET_USER_LOCK_STATE: ("i", _set_following),
    Rpc.AUS_GET_USER_LOCK_STATE: ("", lambda station: values(station.settings.lock)),
    Rpc.MOT_SET_VELOCITY: ("dd", lambda _, _horizontal, _vertical: OK),
    Rpc.MOT_START_CONTROLLER: ("i", lambda _, _mode: OK),
    Rpc.MOT_STOP_CONTROLLER: ("i", lambda _, _mode: OK),
}
"""By number: parameters and work."""

LICENSED = frozenset(
    rpc
    for rpc in SEARCHING
    if rpc // 1000 == 9
    or rpc in (Rpc.BAP_SEARCH_TARGET, Rpc.AUS_SET_USER_ATR_STATE, Rpc.AUS_SET_USER_LOCK_STATE)
)
"""Those that need the option GeoCOM Robotic."""
