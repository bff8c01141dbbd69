"""Procedures that measure angles and distances in a simulated total station (TMC, and what belongs to it)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from tsgt.simulation.instrument.edm import CONTINUOUS
from tsgt.simulation.instrument.geocom.answers import OK, Answer, Offered
from tsgt.simulation.instrument.settings import ANGLE_SIGMA_RAD, COMPENSATOR_SIGMA_RAD
from tsgt.simulation.instrument.telescope import Lock
from tsgt.station.geocom import ReturnCode, Rpc

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.simulation.instrument.geocom.answers import Job, Procedures
    from tsgt.simulation.instrument.total_station import SimulatedTotalStation

    MakeAnswer = Callable[["SimulatedTotalStation", "Offered | ReturnCode"], Answer]

_NEW_DISTANCE_NS: Final = 5_000_000_000
_RAPID, _RAPID_WITHOUT_PRISM = 7, 8


# --- Orders to measure ------------------------------------------------------------------------------------------


def _do_measure(station: SimulatedTotalStation, program: int, _inclination: int) -> Answer:
    now_ns = station.advance()
    if program == 0:
        station.meter.stop(now_ns)
    elif program == 3:
        station.meter.clear()
    elif program in (1, 6, 8, 10):
        if program in (8, 10):
            station.settings.edm_mode = _RAPID if program == 8 else _RAPID_WITHOUT_PRISM
        station.start_measuring(now_ns, continuous=station.settings.edm_mode in CONTINUOUS)
    elif program not in (4, 11):
        return Answer(ReturnCode.IVPARAM)
    return OK


# --- Distances ----------------------------------------------------------------------------------------------------


def _with_wait(make: MakeAnswer) -> Callable[[SimulatedTotalStation, int, int], Answer | Job]:
    """Answer with the stored distance, at once if there is one; wait for one otherwise."""

    def run(station: SimulatedTotalStation, wait_ms: int, _inclination: int) -> Answer | Job:
        now_ns = station.advance()
        if station.too_tilted():
            return Answer(ReturnCode.TMC_ANGLE_ERROR)
        result = station.result()
        if isinstance(result, Offered) or result is ReturnCode.TMC_DIST_PPM:
            return make(station, result)
        return _wait(station, now_ns + wait_ms * 1_000_000, make)

    return run


def _wait(station: SimulatedTotalStation, until_ns: int, make: MakeAnswer) -> Job:
    now_ns = station.advance()
    result = station.result()
    while now_ns < until_ns and not isinstance(result, Offered):
        next_ns = station.meter.next_after(now_ns)
        if next_ns is None and station.meter.newest(now_ns) is not None:
            break  # the only distance that was ordered has failed
        yield until_ns if next_ns is None else min(until_ns, next_ns)
        now_ns = station.advance()
        if station.too_tilted():
            return Answer(ReturnCode.TMC_ANGLE_ERROR)
        result = station.result()
    return make(station, result)


def _quick_distance(station: SimulatedTotalStation) -> Job:
    """Start fast measuring if need be, and wait for a distance that is newer than the question."""
    now_ns = station.advance()
    if not station.meter.running:
        station.settings.edm_mode = _RAPID
        station.start_measuring(now_ns, continuous=True)
    until_ns = now_ns + _NEW_DISTANCE_NS
    while now_ns < until_ns:
        next_ns = station.meter.next_after(now_ns)
        if next_ns is None:
            break
        yield next_ns
        now_ns = station.advance()
        if isinstance(station.result(), Offered):
            break
    return _simple(station, station.result())


def _full(station: SimulatedTotalStation, result: Offered | ReturnCode) -> Answer:
    if result is ReturnCode.TMC_DIST_ERROR:
        return Answer(result)
    across, along = station.inclination_rad()
    inclination = (ANGLE_SIGMA_RAD, across, along, COMPENSATOR_SIGMA_RAD)
    if isinstance(result, Offered):
        angles = result.horizontal_angle_rad, result.zenith_angle_rad
        return Answer(
            result.code, (*angles, *inclination, result.distance_m, result.instrument_ms), offered=result
        )
    return Answer(result, (*station.angles_rad(), *inclination, 0.0, 0))


def _simple(station: SimulatedTotalStation, result: Offered | ReturnCode) -> Answer:
    if isinstance(result, Offered):
        angles = result.horizontal_angle_rad, result.zenith_angle_rad
        return Answer(result.code, (*angles, result.distance_m), offered=result)
    return Answer(result, (*station.angles_rad(), 0.0))


def _cartesian(station: SimulatedTotalStation, result: Offered | ReturnCode) -> Answer:
    now_ns = station.advance()
    east, north, height, _ = station.settings.station_m
    newest = station.angles_rad()
    if not isinstance(result, Offered):
        return Answer(result)
    first, later = (
        (
            east + result.distance_m * math.sin(zenith) * math.sin(horizontal),
            north + result.distance_m * math.sin(zenith) * math.cos(horizontal),
            height + result.distance_m * math.cos(zenith),
        )
        for horizontal, zenith in ((result.horizontal_angle_rad, result.zenith_angle_rad), newest)
    )
    return Answer(
        result.code,
        (*first, result.instrument_ms, *later, station.instrument_ms(now_ns)),
        offered=result,
    )


def _simple_cartesian(station: SimulatedTotalStation, result: Offered | ReturnCode) -> Answer:
    whole = _cartesian(station, result)
    return Answer(whole.code, whole.values[:3] or (0.0, 0.0, 0.0), offered=whole.offered)


def _distance_and_angle(station: SimulatedTotalStation, mode: int) -> Job:
    """Measure once, as BAP_MeasDistanceAngle does: not for a prism that is followed."""
    now_ns = station.advance()
    station.start_measuring(now_ns, continuous=False)
    done_ns = station.meter.next_after(now_ns)
    assert done_ns is not None  # noqa: S101 (it has just been ordered)
    yield done_ns
    station.advance()
    answer = _simple(station, station.result())
    return Answer(answer.code, (*answer.values, mode), offered=answer.offered)


# --- Angles -------------------------------------------------------------------------------------------------------


def _angle_code(station: SimulatedTotalStation) -> int:
    if not station.settings.incline:
        return ReturnCode.TMC_ANGLE_NOT_FULL_CORR
    return ReturnCode.TMC_ANGLE_NO_ACC_GUARANTY if station.turning() else ReturnCode.OK


def _angle1(station: SimulatedTotalStation, _inclination: int) -> Answer:
    now_ns = station.advance()
    if station.too_tilted():
        return Answer(ReturnCode.TMC_ANGLE_ERROR)
    at_ms = station.instrument_ms(now_ns)
    across, along = station.inclination_rad()
    return Answer(
        _angle_code(station),
        (
            *station.angles_rad(),
            ANGLE_SIGMA_RAD,
            at_ms,
            across,
            along,
            COMPENSATOR_SIGMA_RAD,
            at_ms,
            station.face,
        ),
    )


def _angle5(station: SimulatedTotalStation, _inclination: int) -> Answer:
    station.advance()
    if station.too_tilted():
        return Answer(ReturnCode.TMC_ANGLE_ERROR)
    return Answer(_angle_code(station), station.angles_rad())


def _correction_missing(station: SimulatedTotalStation) -> Answer:
    return Answer(values=(not station.settings.incline,))


def _lock_status(station: SimulatedTotalStation) -> Answer:
    station.advance()
    lock = station.telescope.lock if station.settings.lock else Lock.OUT
    return Answer(values=(int(lock),))


MEASURING: Procedures = {
    Rpc.TMC_DO_MEASURE: ("ii", _do_measure),
    Rpc.TMC_GET_FULL_MEAS: ("ii", _with_wait(_full)),
    Rpc.TMC_GET_SIMPLE_MEA: ("ii", _with_wait(_simple)),
    Rpc.TMC_GET_COORDINATE: ("ii", _with_wait(_cartesian)),
    Rpc.TMC_GET_SIMPLE_COORD: ("ii", _with_wait(_simple_cartesian)),
    Rpc.TMC_QUICK_DIST: ("", _quick_distance),
    Rpc.BAP_MEAS_DISTANCE_ANGLE: ("i", _distance_and_angle),
    Rpc.TMC_GET_ANGLE1: ("i", _angle1),
    Rpc.TMC_GET_ANGLE5: ("i", _angle5),
    Rpc.TMC_GET_FACE: ("", lambda station: Answer(values=(station.face,))),
    Rpc.TMC_GET_SIGNAL: ("", lambda _: Answer(values=(70.0, 0))),
    Rpc.TMC_IF_DATA_AZE_CORR_ERROR: ("", lambda _: Answer(values=(False,))),
    Rpc.TMC_IF_DATA_INC_CORR_ERROR: ("", _correction_missing),
    Rpc.EDM_IS_CONT_MEAS_ACTIVE: ("", lambda station: Answer(values=(station.meter.running,))),
    Rpc.MOT_READ_LOCK_STATUS: ("", _lock_status),
}
"""By number: parameters and work."""
