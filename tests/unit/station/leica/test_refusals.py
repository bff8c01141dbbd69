"""Commands that the instrument refuses or fails to carry out: no other prism, no unaimed target, no forgotten problem."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, cast

import numpy as np
import pytest
from harness.instruments.leica import leica_bench, leica_config
from structlog.testing import capture_logs

from tsgt.config import MotionConfig
from tsgt.errors import InstrumentRefusedError
from tsgt.model import Status
from tsgt.radio import Direction
from tsgt.simulation.instrument.geocom import ForcedResponse
from tsgt.simulation.instrument.targets_in_view import direction_to
from tsgt.simulation.instrument.telescope import Lock
from tsgt.simulation.kernel import VirtualClock
from tsgt.station import Atmosphere
from tsgt.station.geocom import Reply, ReturnCode, Rpc
from tsgt.station.leica.reacquisition import SearchWindow
from tsgt.station.leica.search import TargetSearch
from tsgt.station.leica.target import measure_target

if TYPE_CHECKING:
    from collections.abc import Callable

    from harness.instruments.leica import LeicaBench

    from tsgt.station.geocom import GeoComConnection

STANDING = MotionConfig(speeds_mps=(0.0,), speed_weights=(1.0,))


def refuse(day: LeicaBench, rpc: Rpc, code: int, times: int = 1) -> None:
    """Make the instrument reply with this code instead of carrying out its next procedures of this kind."""
    day.station.server.forced.append(ForcedResponse(code=code, rpc=rpc, times=times))


def on_request(day: LeicaBench, rpc: Rpc, act: Callable[[], None]) -> None:
    """Act before the instrument receives its first request of this kind."""
    receive = day.station.receive

    def watching(data: bytes) -> None:
        if b"Q,%d," % rpc in data or b"Q,%d:" % rpc in data:
            day.station.receive = receive  # type: ignore[method-assign]
            act()
        receive(data)

    day.station.receive = watching  # type: ignore[method-assign]


def true_direction(day: LeicaBench, prism: int) -> Direction:
    """Return the direction of a prism now."""
    return Direction(*direction_to(day.station._targets.prisms[prism].point_at(day.now_s)), 0.03)


# --- The lock on the old prism --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "code", [ReturnCode.SYSBUSY, ReturnCode.MOT_BUSY, ReturnCode.TIME_OUT, ReturnCode.UNDEFINED]
)
async def test_release_of_old_prism_is_retried(code: ReturnCode) -> None:
    """One refusal, and the old prism would count as the new one."""
    async with leica_bench() as day:
        await day.begin()
        await day.read_for(3.0)
        refuse(day, Rpc.AUS_SET_USER_LOCK_STATE, code)
        await day.instrument.track(2)
        assert day.station.telescope.lock is Lock.OUT
        assert {reading.status for reading in await day.read_for(5.0)} == {Status.NO_TARGET}


async def test_prism_that_is_not_released_is_tracked_further() -> None:
    """Whatever the instrument says, its lock state counts; the command is refused, and a later one may succeed."""
    async with leica_bench() as day:
        await day.begin()
        await day.read_for(3.0)
        for code in (ReturnCode.TIME_OUT, ReturnCode.OK):
            refuse(day, Rpc.AUS_SET_USER_LOCK_STATE, code, times=9)
            with pytest.raises(InstrumentRefusedError, match="does not release the prism"):
                await day.instrument.track(2)
            day.station.server.forced.clear()
            readings = await day.read_for(3.0)
            assert {(reading.prism, reading.status) for reading in readings} == {(1, Status.OK)}
        await day.instrument.track(2)
        assert {reading.status for reading in await day.read_for(5.0)} == {Status.NO_TARGET}


async def test_refused_release_is_remembered_across_connections() -> None:
    """A prism change that was pending is still pending after the connection that could not carry it out."""
    async with leica_bench() as day:
        await day.begin()
        await day.instrument.track(2)
        await day.instrument.close()
        day.station.lock_manually(1)
        await day.instrument.connect()
        refuse(day, Rpc.AUS_SET_USER_LOCK_STATE, ReturnCode.TIME_OUT, times=9)
        with pytest.raises(InstrumentRefusedError):
            await day.instrument.track(2)
        day.station.server.forced.clear()
        await day.instrument.close()
        await day.begin(2)
        assert {reading.status for reading in await day.read_for(5.0)} == {Status.NO_TARGET}


@pytest.mark.parametrize("target", ["foil", "prism"])
async def test_direct_mode_requires_the_release(target: str) -> None:
    """A telescope that follows the robot would measure it instead of a target; tracking continues otherwise."""
    async with leica_bench(leica_config(target=target)) as day:
        await day.begin()
        await day.read_for(3.0)
        refuse(day, Rpc.AUS_SET_USER_LOCK_STATE, ReturnCode.SYSBUSY, times=9)
        with pytest.raises(InstrumentRefusedError, match="does not release the prism"):
            await day.instrument.direct()
        assert (await day.instrument.read()).status is Status.OK
        day.station.server.forced.clear()
        refuse(day, Rpc.AUS_SET_USER_LOCK_STATE, ReturnCode.SYSBUSY)
        await day.instrument.direct()
        assert day.station.telescope.lock is Lock.OUT


async def test_motion_of_the_robot_is_no_pointing() -> None:
    """Without the licence the lock cannot be released: the telescope follows the robot, until the operator takes over."""
    async with leica_bench() as day:
        day.station.robotic_licence = False
        await day.begin()
        await day.read_for(3.0)
        await day.instrument.track(2)
        waiting = await day.read_for(60.0)
        assert {reading.status for reading in waiting} == {Status.NO_TARGET}
        assert "release the lock, then point the telescope at prism 2" in day.instrument.condition.problem
        day.station.telescope.release()  # by the operator, who has not turned it yet
        assert {reading.status for reading in await day.read_for(5.0)} == {Status.NO_TARGET}
        day.station.lock_manually(2)
        found = await day.read_until(Status.OK, within_s=5.0)
        assert found.prism == day.station.telescope.prism == 2


async def test_lost_old_prism_is_not_the_new_one() -> None:
    """It disappears for a moment while the telescope, without the licence, is still locked on it."""
    async with leica_bench() as day:
        day.station.robotic_licence = False
        await day.begin()
        await day.read_for(3.0)
        await day.instrument.track(2)
        await day.read_for(2.0)
        day.station.blocked = True
        await day.read_for(1.0)
        day.station.blocked = False
        assert {reading.status for reading in await day.read_for(30.0)} == {Status.NO_TARGET}


@pytest.mark.parametrize("reports_lock", [True, False])
async def test_operator_may_point_without_a_lock(reports_lock: bool) -> None:  # noqa: FBT001
    """Neither licence nor lock: what counts is that the telescope was turned and rests."""
    async with leica_bench(motion=STANDING) as day:
        day.station.robotic_licence = False
        day.station.telescope.release()
        if not reports_lock:
            refuse(day, Rpc.MOT_READ_LOCK_STATUS, ReturnCode.NOT_IMPL, times=10_000)
        await day.begin()
        await day.instrument.track(2)
        assert {reading.status for reading in await day.read_for(5.0)} == {Status.NO_TARGET}
        day.station.telescope.turn_to((3.0, 1.5))
        await asyncio.sleep(0.5)
        day.station.aim_at_prism(2)
        assert (await day.read_until(Status.OK, within_s=10.0)).prism == 2


@pytest.mark.parametrize("interval_s", [5.0, 2.0, 1.5])
async def test_frequent_commands_do_not_prevent_lock_on(interval_s: float) -> None:
    """Of a new prism, too: a search that only has to lock on is not interrupted."""
    async with leica_bench() as day:
        await day.begin()
        await day.read_for(3.0)
        day.station._select_target(2)
        statuses: set[Status] = set()
        while Status.OK not in statuses:
            assert day.now_s < 30.0
            await day.instrument.track(2, true_direction(day, 2))
            statuses |= {reading.status for reading in await day.read_for(interval_s)}
        assert day.station.telescope.prism == 2


# --- Searches and settings ------------------------------------------------------------------------------------------


class WithoutAngles:
    """A line to an instrument that has no angles now."""

    def __init__(self) -> None:
        self.called: list[Rpc] = []

    async def call(self, rpc: Rpc, *_: object, **__: object) -> Reply:
        """Reply as that instrument does."""
        self.called.append(rpc)
        return Reply(ReturnCode.TMC_ANGLE_ERROR if rpc is Rpc.TMC_GET_ANGLE5 else ReturnCode.OK, (), 0, 1)


async def test_search_without_a_pointing_is_given_up() -> None:
    """It would turn the telescope to the zero of the circle."""
    line = WithoutAngles()
    target_search = TargetSearch(cast("GeoComConnection", line), power_search=True)
    assert not await target_search.search(
        SearchWindow("searching", sweep=True, centre=None, width_rad=0.1, height_rad=0.1)
    )
    assert not {Rpc.AUT_SET_SEARCH_AREA, Rpc.AUT_PS_SEARCH_WINDOW, Rpc.AUT_MAKE_POSITIONING} & {*line.called}


async def test_problem_ends_with_its_cause() -> None:
    """A setting that is refused once and set at the next occasion."""
    async with leica_bench() as day:
        refuse(day, Rpc.TMC_SET_ATM_CORR, ReturnCode.TIME_OUT)
        await day.begin()
        await day.read_for(1.0)
        refuse(day, Rpc.TMC_SET_EDM_MODE, ReturnCode.TIME_OUT)
        await day.instrument.direct()
        assert "distance mode single_tape cannot be set" in day.instrument.condition.problem
        day.station.aim_at_target(1)
        await day.instrument.measure()
        assert day.instrument.condition.problem == ""


async def test_atmosphere_that_is_set_later_is_no_problem() -> None:
    """The one of the configuration was refused at the connection."""
    air = {"temperature_c": 20.0, "pressure_hpa": 1000.0}
    async with leica_bench(leica_config(atmosphere=air)) as day:
        refuse(day, Rpc.TMC_SET_ATM_CORR, ReturnCode.TIME_OUT)
        await day.begin()
        assert "the atmosphere cannot be set" in day.instrument.condition.problem
        await day.instrument.set_atmosphere(Atmosphere(**air))
        assert day.instrument.condition.problem == ""


async def test_battery_warning_survives_a_failed_query() -> None:
    """Low and empty are both logged, once each."""
    async with leica_bench() as day:
        with capture_logs() as logs:
            await day.begin()
            for percent in (12.0, 2.0):
                day.station.battery_percent = percent
                await day.read_for(125.0)
            assert "switches off within a minute" in day.instrument.condition.problem
            refuse(day, Rpc.CSV_CHECK_POWER, ReturnCode.SYSBUSY, times=9)
            await day.read_for(62.0)
        assert "switches off within a minute" in day.instrument.condition.problem
        assert day.instrument.condition.battery_percent == 2
    low = [entry["percent"] for entry in logs if entry["event"] == "instrument_battery_low"]
    assert low == [12, 2]


async def test_power_check_does_not_wait_for_a_search() -> None:
    """It would stop the readings until the search has ended."""
    async with leica_bench(leica_config(search_window_deg=360)) as day:
        await day.begin()
        await day.read_for(3.0)
        day.station.blocked = True
        times = []
        while day.now_s < 150.0:
            await day.instrument.read()
            times.append(day.now_s)
    assert max(np.diff(times)) < 2.0


# --- Single measurements --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "code",
    [
        ReturnCode.AUT_NO_TARGET,
        ReturnCode.AUT_MULTIPLE_TARGETS,
        ReturnCode.AUT_NOT_ENABLED,
        ReturnCode.AUT_ACCURACY,
    ],
)
async def test_prism_that_is_not_aimed_at_is_not_measured(code: ReturnCode) -> None:
    """The operator's aim is 6 cm off; what is measured there has a good status."""
    async with leica_bench(leica_config(target="prism"), motion=STANDING) as day:
        await day.begin()
        await day.instrument.direct()
        point = day.station._targets.prisms[1].point_at(0.0)
        horizontal_rad, zenith_rad = direction_to(point)
        day.station.telescope.turn_to((horizontal_rad + 0.06 / float(np.linalg.norm(point)), zenith_rad))
        refuse(day, Rpc.AUT_FINE_ADJUST, code)
        missed = await day.instrument.measure()
        assert (missed.status, missed.raw_status, missed.slope_distance_m) == (Status.NO_TARGET, code, None)
        assert (await day.instrument.measure()).status.usable


async def test_operator_aims_without_licence() -> None:
    """No fine adjustment can fail."""
    async with leica_bench(leica_config(target="prism"), motion=STANDING) as day:
        day.station.robotic_licence = False
        await day.begin()
        await day.instrument.direct()
        assert (await day.instrument.measure()).status.usable


@pytest.mark.parametrize("reconnects", [False, True])
async def test_reflector_of_a_prism_target_is_set(reconnects: bool) -> None:  # noqa: FBT001
    """Somebody has changed it at the instrument since: the distance would be 30 mm short."""
    config = leica_config(prism_type="mini_360", prism_constant_mm=None, target="prism")
    async with leica_bench(config, motion=STANDING) as day:
        await day.begin()
        await day.instrument.direct()
        before = await day.instrument.measure()
        if reconnects:
            await day.instrument.close()
        day.station.settings.prism_type, day.station.settings.prism_constant_m = 0, 0.0
        if reconnects:
            await day.instrument.connect()
            await day.instrument.direct()
        after = await day.instrument.measure()
        assert before.slope_distance_m is not None
        assert after.slope_distance_m == pytest.approx(before.slope_distance_m, abs=0.01)
        assert day.instrument.record is not None
        assert day.instrument.record.prism_constant_m == 0.03


async def test_refused_mode_of_a_prism_target_is_a_problem() -> None:
    """The continuous mode of tracking is used then."""
    async with leica_bench(leica_config(target="prism")) as day:
        await day.begin()
        refuse(day, Rpc.TMC_SET_EDM_MODE, ReturnCode.TIME_OUT, times=99)
        await day.instrument.direct()
        assert "distance mode single_standard cannot be set" in day.instrument.condition.problem


class SlowDistance:
    """A line to an instrument that measures for a while, and replies without values until it has a distance."""

    def __init__(self, *pending: Reply) -> None:
        self._replies = [*pending, Reply(0, (1.5, 1.6, 1e-6, 0.0, 0.0, 1e-6, 50.5, 12_345), 0, 1)]

    async def call(self, rpc: Rpc, *_: object, **__: object) -> Reply:
        """Reply as that instrument does."""
        return self._replies.pop(0) if rpc is Rpc.TMC_GET_FULL_MEAS else Reply(0, (), 0, 1)


@pytest.mark.parametrize("code", [1283, 1284, 1285, 1288, 1289])
@pytest.mark.parametrize("values", [(), (0.0,) * 8])
async def test_angles_without_values_are_no_result(code: int, values: tuple[float, ...]) -> None:
    """The EDM is still measuring."""
    line = SlowDistance(*[Reply(code, values, 0, 1)] * 3)
    measured = await measure_target(cast("GeoComConnection", line), VirtualClock(0))
    assert (measured.status, measured.distance_m) == (Status.OK, 50.5)


async def test_telescope_returns_from_a_face_that_cannot_be_measured() -> None:
    """The next measurement begins in the first face, too."""
    async with leica_bench(leica_config(target="prism", target_faces=2), motion=STANDING) as day:
        await day.begin()
        await day.instrument.direct()
        on_request(
            day, Rpc.AUT_CHANGE_FACE, lambda: refuse(day, Rpc.TMC_DO_MEASURE, ReturnCode.SYSBUSY, times=9)
        )
        with pytest.raises(InstrumentRefusedError, match="does not start a new measurement"):
            await day.instrument.measure()
        assert day.station.face == 0
        day.station.server.forced.clear()
        assert (await day.instrument.measure()).status.usable


async def test_prism_that_is_not_found_in_the_second_face_is_named() -> None:
    """The face has been changed then; where it could not be changed, the telescope stays."""
    async with leica_bench(leica_config(target="prism", target_faces=2), motion=STANDING) as day:
        await day.begin()
        await day.instrument.direct()
        on_request(day, Rpc.AUT_CHANGE_FACE, lambda: setattr(day.station, "blocked", True))
        with pytest.raises(InstrumentRefusedError, match="does not find the prism in the other face"):
            await day.instrument.measure()
        assert day.station.face == 0
        day.station.blocked = False
        refuse(day, Rpc.AUT_CHANGE_FACE, ReturnCode.MOT_BUSY)
        with pytest.raises(InstrumentRefusedError, match="does not change its face"):
            await day.instrument.measure()
        assert day.station.face == 0
        await asyncio.sleep(1.0)
        assert (await day.instrument.measure()).status.usable
