"""Commands that measure angles and distances (TMC, and related ones)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from tsgt.simulation.instrument.edm import CONTINUOUS_MODES
from tsgt.simulation.instrument.geocom.commands import INVALID_PARAMETER, OK, Command, Response, values
from tsgt.simulation.instrument.model import ReportedDistance
from tsgt.simulation.instrument.settings import ANGLE_SIGMA_RAD, COMPENSATOR_SIGMA_RAD
from tsgt.simulation.instrument.telescope import Lock
from tsgt.station.geocom import ReturnCode, Rpc

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.simulation.instrument.geocom.commands import Commands, Job
    from tsgt.simulation.instrument.model import TotalStationModel

    Report = Callable[["TotalStationModel", "ReportedDistance | ReturnCode"], Response]

_NEW_DISTANCE_NS: Final = 5_000_000_000
_RAPID, _RAPID_WITHOUT_PRISM = 7, 8


# --- Starting and stopping ---------------------------------------------------------------------------------------


def _do_measure(station: TotalStationModel, program: int, _inclination: int) -> Response:
    now_ns = station.advance()
    if program == 0:
        station.edm.stop(now_ns)
    elif program == 3:
        station.edm.clear()
    elif program in (1, 6, 8, 10):
        if program in (8, 10):
            station.settings.edm_mode = _RAPID if program == 8 else _RAPID_WITHOUT_PRISM
        station.start_measuring(now_ns, continuous=station.settings.edm_mode in CONTINUOUS_MODES)
    elif program not in (4, 11):
        return INVALID_PARAMETER
    return OK


# --- Distances ----------------------------------------------------------------------------------------------------


def _with_wait(report: Report) -> Callable[[TotalStationModel, int, int], Response | Job]:
    """Report the stored distance at once, or wait for one."""

    def execute(station: TotalStationModel, wait_ms: int, _inclination: int) -> Response | Job:
        now_ns = station.advance()
        if station.exceeds_tilt_range():
            return Response(ReturnCode.TMC_ANGLE_ERROR)
        result = station.result()
        if isinstance(result, ReportedDistance) or result is ReturnCode.TMC_DIST_PPM:
            return report(station, result)
        return _wait(station, now_ns + wait_ms * 1_000_000, report)

    return execute


def _wait(station: TotalStationModel, until_ns: int, report: Report) -> Job:
    now_ns = station.advance()
    result = station.result()
    while now_ns < until_ns and not isinstance(result, ReportedDistance):
        next_ns = station.edm.next_after(now_ns)
        if next_ns is None and station.edm.newest(now_ns) is not None:
            break  # the single measurement has failed
        yield until_ns if next_ns is None else min(until_ns, next_ns)
        now_ns = station.advance()
        if station.exceeds_tilt_range():
            return Response(ReturnCode.TMC_ANGLE_ERROR)
        result = station.result()
    return report(station, result)


def _quick_distance(station: TotalStationModel) -> Job:
    """Start rapid measurement if necessary and wait for a distance newer than the request."""
    now_ns = station.advance()
    if not station.edm.running:
        station.settings.edm_mode = _RAPID
        station.start_measuring(now_ns, continuous=True)
    until_ns = now_ns + _NEW_DISTANCE_NS
    while now_ns < until_ns:
        next_ns = station.edm.next_after(now_ns)
        if next_ns is None:
            break
        yield next_ns
        now_ns = station.advance()
        if isinstance(station.result(), ReportedDistance):
            break
    return _simple(station, station.result())


def _full(station: TotalStationModel, result: ReportedDistance | ReturnCode) -> Response:
    if result is ReturnCode.TMC_DIST_ERROR:
        return Response(result)
    across, along = station.inclination_rad()
    inclination = (ANGLE_SIGMA_RAD, across, along, COMPENSATOR_SIGMA_RAD)
    if isinstance(result, ReportedDistance):
        angles = result.horizontal_angle_rad, result.zenith_angle_rad
        return Response(
            result.code, (*angles, *inclination, result.distance_m, result.instrument_ms), distance=result
        )
    return Response(result, (*station.angles_rad(), *inclination, 0.0, 0))


def _simple(station: TotalStationModel, result: ReportedDistance | ReturnCode) -> Response:
    if isinstance(result, ReportedDistance):
        angles = result.horizontal_angle_rad, result.zenith_angle_rad
        return Response(result.code, (*angles, result.distance_m), distance=result)
    return Response(result, (*station.angles_rad(), 0.0))


def _cartesian(station: TotalStationModel, result: ReportedDistance | ReturnCode) -> Response:
    now_ns = station.advance()
    east, north, height, _ = station.settings.station_m
    newest = station.angles_rad()
    if not isinstance(result, ReportedDistance):
        return Response(result)
    first, later = (
        (
            east + result.distance_m * math.sin(zenith) * math.sin(horizontal),
            north + result.distance_m * math.sin(zenith) * math.cos(horizontal),
            height + result.distance_m * math.cos(zenith),
        )
        for horizontal, zenith in ((result.horizontal_angle_rad, result.zenith_angle_rad), newest)
    )
    return Response(
        result.code,
        (*first, result.instrument_ms, *later, station.instrument_ms(now_ns)),
        distance=result,
    )


def _simple_cartesian(station: TotalStationModel, result: ReportedDistance | ReturnCode) -> Response:
    whole = _cartesian(station, result)
    return Response(whole.code, whole.values[:3] or (0.0, 0.0, 0.0), distance=whole.distance)


def _distance_and_angle(station: TotalStationModel, mode: int) -> Job:
    """Take a single measurement; BAP_MeasDistanceAngle does not work on a tracked prism."""
    now_ns = station.advance()
    station.start_measuring(now_ns, continuous=False)
    done_ns = station.edm.next_after(now_ns)
    assert done_ns is not None  # noqa: S101 (it has just been started)
    yield done_ns
    station.advance()
    response = _simple(station, station.result())
    return Response(response.code, (*response.values, mode), distance=response.distance)


# --- Angles -------------------------------------------------------------------------------------------------------


def _angle_code(station: TotalStationModel) -> int:
    if not station.settings.incline:
        return ReturnCode.TMC_ANGLE_NOT_FULL_CORR
    return ReturnCode.TMC_ANGLE_NO_ACC_GUARANTY if station.turns_fast() else ReturnCode.OK


def _angle1(station: TotalStationModel, _inclination: int) -> Response:
    now_ns = station.advance()
    if station.exceeds_tilt_range():
        return Response(ReturnCode.TMC_ANGLE_ERROR)
    at_ms = station.instrument_ms(now_ns)
    across, along = station.inclination_rad()
    return Response(
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


def _angle5(station: TotalStationModel, _inclination: int) -> Response:
    station.advance()
    if station.exceeds_tilt_range():
        return Response(ReturnCode.TMC_ANGLE_ERROR)
    return Response(_angle_code(station), station.angles_rad())


def _correction_missing(station: TotalStationModel) -> Response:
    return values(not station.settings.incline)


def _lock_status(station: TotalStationModel) -> Response:
    station.advance()
    lock = station.telescope.lock if station.settings.lock else Lock.OUT
    return values(int(lock))


MEASURING_COMMANDS: Commands = {
    Rpc.TMC_DO_MEASURE: Command("ii", _do_measure),
    Rpc.TMC_GET_FULL_MEAS: Command("ii", _with_wait(_full)),
    Rpc.TMC_GET_SIMPLE_MEA: Command("ii", _with_wait(_simple)),
    Rpc.TMC_GET_COORDINATE: Command("ii", _with_wait(_cartesian)),
    Rpc.TMC_GET_SIMPLE_COORD: Command("ii", _with_wait(_simple_cartesian)),
    Rpc.TMC_QUICK_DIST: Command("", _quick_distance),
    Rpc.BAP_MEAS_DISTANCE_ANGLE: Command("i", _distance_and_angle),
    Rpc.TMC_GET_ANGLE1: Command("i", _angle1),
    Rpc.TMC_GET_ANGLE5: Command("i", _angle5),
    Rpc.TMC_GET_FACE: Command("", lambda station: values(station.face)),
    Rpc.TMC_GET_SIGNAL: Command("", lambda _: values(70.0, 0)),
    Rpc.TMC_IF_DATA_AZE_CORR_ERROR: Command("", lambda _: values(False)),
    Rpc.TMC_IF_DATA_INC_CORR_ERROR: Command("", _correction_missing),
    Rpc.EDM_IS_CONT_MEAS_ACTIVE: Command("", lambda station: values(station.edm.running)),
    Rpc.MOT_READ_LOCK_STATUS: Command("", _lock_status),
}
