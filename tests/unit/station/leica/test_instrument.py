"""The Leica driver with a simulated instrument on a simulated line."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, cast

import numpy as np
import pytest
from harness.instruments.leica import leica_bench, leica_config

from tsgt.config import InstrumentModelConfig
from tsgt.config.scenario import StatusFaultConfig
from tsgt.errors import InstrumentError, InstrumentRefusedError
from tsgt.model import Status
from tsgt.radio import Direction
from tsgt.simulation.instrument.geocom import ForcedResponse
from tsgt.station import Atmosphere
from tsgt.station.geocom import Reply, ReturnCode, Rpc
from tsgt.station.instrument_supervisor import InstrumentSupervisor
from tsgt.station.leica.reacquisition import Pointing, SearchWindow
from tsgt.station.leica.search import TargetSearch
from tsgt.station.session import ClientSession

if TYPE_CHECKING:
    from tsgt.station.geocom import GeoComConnection


def occlusion(start_s: float, end_s: float) -> StatusFaultConfig:
    """Return an occlusion."""
    return StatusFaultConfig(station=1, status="no_target", start_s=start_s, end_s=end_s)


# --- Tracking -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [2.5, 7.0, 20.0])
@pytest.mark.slow
async def test_every_offered_distance_is_read_once(rate_hz: float) -> None:
    """At any rate: no repeats, no gaps, unchanged values."""
    async with leica_bench(rate_hz=rate_hz) as day:
        await day.begin()
        readings = await day.read_for(60.0)
    offered = day.station.reported_distances
    assert 0 <= len(offered) - len(readings) <= 1
    for reading, source in zip(readings, offered, strict=False):
        assert reading.instrument_time_ns == source.instrument_ms * 1_000_000
        assert reading.slope_distance_m == pytest.approx(source.distance_m, abs=1e-9)


@pytest.mark.slow
async def test_fast_instrument_is_polled_fast_enough() -> None:
    """At 20 Hz with short replies nearly every distance is read."""
    model = InstrumentModelConfig(processing_min_ms=5.0, processing_max_ms=10.0)
    async with leica_bench(rate_hz=20.0, model=model) as day:
        await day.begin()
        readings = await day.read_for(60.0)
    assert len(readings) > 0.97 * 60 * 20


async def test_timestamps_match_distances() -> None:
    """After half a minute, with the minimum latency of 20 ms subtracted."""
    async with leica_bench(leica_config(latency_ms=20.0)) as day:
        await day.begin()
        await day.read_for(30.0)
        readings = await day.read_for(60.0)
    true_ns = {offered.instrument_ms: offered.true_ns for offered in day.station.reported_distances}
    errors_ms = [(r.at_ns - true_ns[(r.instrument_time_ns or 0) // 1_000_000]) / 1e6 for r in readings]
    assert np.median(errors_ms) == pytest.approx(0.0, abs=0.9)
    assert max(errors_ms) - min(errors_ms) < 5
    assert all(r.received_ns is not None and r.received_ns > r.at_ns for r in readings)


async def test_slow_distances_are_polled_about_twice() -> None:
    """At intervals of 400 ms most polls in between would be useless."""
    async with leica_bench() as day:
        await day.begin()
        await day.read_for(20.0)
        asked = 0
        receive = day.station.receive

        def counting(data: bytes) -> None:
            nonlocal asked
            asked += b",2167," in data or b"Q,2167" in data
            receive(data)

        day.station.receive = counting  # type: ignore[method-assign]
        readings = await day.read_for(60.0)
    assert len(readings) > 145
    assert asked < 2.6 * len(readings)


async def test_cancelled_read_loses_no_reading() -> None:
    """The next calls return the same distances."""
    async with leica_bench() as day:
        await day.begin()
        times = []
        for _ in range(100):
            times += [reading.instrument_time_ns for reading in await day.read_for(0.13)]
    assert len(times) == len(set(times))
    assert [time // 1_000_000 for time in times if time] == [
        offered.instrument_ms for offered in day.station.reported_distances[: len(times)]
    ]


# --- The lock -----------------------------------------------------------------------------------------------------


async def test_lock_is_kept_across_connections() -> None:
    """Connecting and setting up do not release the prism, which would require the operator."""
    async with leica_bench() as day:
        await day.begin()
        await day.read_for(1.0)
        await day.instrument.close()
        await day.begin()
        assert (await day.instrument.read()).status is Status.OK
        assert day.instrument.condition.activity == "tracking prism 1"
        assert not day.station.beeps


async def test_short_occlusion_is_bridged_by_prediction() -> None:
    """No search starts meanwhile; readings report NO_TARGET once, and continue."""
    async with leica_bench(faults=[occlusion(20.0, 21.0)]) as day:
        await day.begin()
        await day.read_for(19.0 - day.now_s)
        during = await day.read_for(2.0)
        after = await day.read_until(Status.OK, within_s=2.0)
    assert Status.NO_TARGET in {reading.status for reading in during}
    assert after.prism == 1


async def test_lost_target_is_reacquired() -> None:
    """After a long occlusion the telescope searches; readings report NO_TARGET at least every second."""
    async with leica_bench(faults=[occlusion(20.0, 40.0)]) as day:
        await day.begin()
        await day.read_for(22.0 - day.now_s)
        lost = await day.read_for(17.0)
        assert {reading.status for reading in lost} == {Status.NO_TARGET}
        assert 8 <= len(lost) <= 36
        assert max(np.diff([reading.at_ns for reading in lost])) < 1.5e9
        found = await day.read_until(Status.OK, within_s=60.0)
        assert found.prism == 1
        assert len(await day.read_for(10.0)) >= 24


async def test_target_is_reacquired_at_direction_from_master() -> None:
    """A prism that has moved elsewhere is found at once."""
    async with leica_bench(leica_config(search_window_deg=10.0)) as day:
        await day.begin()
        reading = await day.instrument.read()
        day.station.blocked = True
        await day.read_until(Status.NO_TARGET, within_s=5.0)
        day.station.telescope.turn_to((reading.horizontal_angle_rad + 1.5, math.pi / 2))
        await day.read_for(4.0)
        day.station.blocked = False
        towards = Direction(reading.horizontal_angle_rad, reading.zenith_angle_rad, 0.05)
        await day.instrument.track(1, towards)
        found = await day.read_until(Status.OK, within_s=12.0)
    assert found.prism == 1


async def test_command_does_not_interrupt_lock_on() -> None:
    """One that arrives while the instrument locks on does not turn the telescope elsewhere."""
    async with leica_bench(leica_config(search_window_deg=10.0)) as day:
        await day.begin()
        reading = await day.instrument.read()
        day.station.blocked = True
        await day.read_until(Status.NO_TARGET, within_s=5.0)
        await day.read_for(4.0)
        day.station.blocked = False
        elsewhere = Direction(reading.horizontal_angle_rad + 1.0, reading.zenith_angle_rad, 0.05)
        while (
            not day.instrument.condition.activity.startswith("recognising") or not day.station.settings.lock
        ):
            await day.read_for(0.05)
        await day.instrument.track(1, elsewhere)
        found = await day.read_until(Status.OK, within_s=2.0)
    assert found.prism == 1


async def test_manual_lock_during_failing_search_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """The next search would release it."""
    windows = []
    async with leica_bench() as day:

        async def fail(_: TargetSearch, window: SearchWindow) -> bool:
            windows.append(window)
            day.station.blocked = False
            day.station.lock_manually(1)
            return False

        monkeypatch.setattr(TargetSearch, "search", fail)
        await day.begin()
        await day.read_for(3.0)
        day.station.blocked = True
        await day.read_until(Status.NO_TARGET, within_s=5.0)
        await day.read_until(Status.OK, within_s=20.0)
    assert len(windows) == 1


async def test_manual_lock_ends_search() -> None:
    """The reply that it was aborted does not start another search."""
    async with leica_bench() as day:
        await day.begin()
        await day.read_for(3.0)
        day.station.blocked = True
        while not (
            day.instrument.condition.activity.startswith("searching") and day.station.telescope.moving
        ):
            await day.instrument.read()
        day.station.blocked = False
        day.station.lock_manually(1)
        await day.read_until(Status.OK, within_s=2.0)


@pytest.mark.parametrize(("misses", "called"), [(1, False), (3, True)])
async def test_sweep_is_repeated_for_moving_robot(misses: int, called: bool) -> None:  # noqa: FBT001
    """The robot is near, so the operator is called only after some sweeps."""
    async with leica_bench() as day:
        await day.begin()
        await day.read_for(3.0)
        day.station.blocked = True
        while not day.instrument.condition.activity.startswith("searching around"):
            await day.instrument.read()
        day.station.blocked = False
        day.station.server.forced.append(
            ForcedResponse(code=ReturnCode.AUT_NO_TARGET, rpc=Rpc.AUT_FINE_ADJUST, times=misses)
        )
        await day.read_until(Status.OK, within_s=60.0)
        assert bool(day.station.beeps) == called


class LockedByHand:
    """A line to an instrument whose sweep finds the prism, and whose fine adjustment the operator replaces by a manual lock."""

    def __init__(self) -> None:
        self.called: list[Rpc] = []

    async def call(self, rpc: Rpc, *_: object, **__: object) -> Reply:
        """Reply as that instrument does."""
        self.called.append(rpc)
        values = (int(Rpc.AUT_FINE_ADJUST in self.called),) if rpc is Rpc.MOT_READ_LOCK_STATUS else ()
        code = ReturnCode.ABORT if rpc is Rpc.AUT_FINE_ADJUST else ReturnCode.OK
        return Reply(code, values, 0, 1)


async def test_manual_lock_after_sweep_is_kept() -> None:
    """A sweep is repeated only while there is no lock."""
    line = LockedByHand()
    target_search = TargetSearch(cast("GeoComConnection", line), power_search=True)
    assert await target_search.search(
        SearchWindow("searching", sweep=True, centre=Pointing(1.0, 1.5), width_rad=0.1, height_rad=0.1)
    )
    assert line.called.count(Rpc.AUT_PS_SEARCH_WINDOW) == 1


async def test_operator_is_called_after_all_searches() -> None:
    """It beeps and reports the required action; after a manual lock it continues."""
    async with leica_bench(faults=[occlusion(5.0, 200.0)]) as day:
        await day.begin()
        await day.read_for(100.0)
        assert day.station.beeps
        assert "point the telescope at prism 1" in day.instrument.condition.problem
        await day.read_for(200.0 - day.now_s)
        day.station.lock_manually(1)
        await day.read_until(Status.OK, within_s=60.0)
        assert day.instrument.condition.problem == ""


async def test_prism_change_requires_operator() -> None:
    """Nothing tells prisms apart: there is no target until the operator has turned the telescope and lets it rest."""
    async with leica_bench() as day:
        await day.begin()
        await day.read_for(2.0)
        await day.instrument.track(2)
        waiting = await day.read_for(10.0)
        assert {reading.status for reading in waiting} == {Status.NO_TARGET}
        assert {reading.prism for reading in waiting} == {2}
        assert "point the telescope at prism 2" in day.instrument.condition.problem
        assert day.station.beeps
        day.station.telescope.turn_to((3.0, 1.5))
        await asyncio.sleep(0.5)
        day.station.aim_at_prism(2)
        found = await day.read_until(Status.OK, within_s=20.0)
        assert found.prism == 2
        assert day.station.telescope.prism == 2
        assert day.instrument.condition.problem == ""


async def test_operator_points_without_licence() -> None:
    """It is reported once; the target that the operator locks on is measured."""
    async with leica_bench() as day:
        day.station.robotic_licence = False
        await day.begin()
        readings = await day.read_for(10.0)
        assert {reading.status for reading in readings} == {Status.OK}
        assert "GeoCOM Robotic" in day.instrument.condition.problem


async def test_prism_change_survives_reconnection() -> None:
    """Unplugged while it waits for the operator, it still waits afterwards, and does not take the old prism for the new one."""
    async with leica_bench() as day:
        await day.begin()
        await day.read_for(2.0)
        await day.instrument.track(2)
        await day.read_for(2.0)
        day.line.plugged = False
        await day.instrument.close()
        day.line.plugged = True
        await day.begin(2)
        assert {reading.status for reading in await day.read_for(8.0)} == {Status.NO_TARGET}


async def test_new_prism_is_found_at_direction_from_master() -> None:
    """The operator is not required then."""
    async with leica_bench() as day:
        await day.begin()
        await day.read_for(1.0)
        day.station.aim_at_prism(3)
        horizontal_rad, zenith_rad = day.station.telescope.direction()
        day.station.aim_at_target(None)
        await day.instrument.track(3, Direction(horizontal_rad, zenith_rad, 0.002))
        found = await day.read_until(Status.OK, within_s=15.0)
        assert found.prism == 3
        assert not day.station.beeps


# --- Condition and settings ---------------------------------------------------------------------------------------


async def test_faults_are_reported_as_status() -> None:
    """Not level, a wrong correction, too close; tracking continues afterwards."""
    faults = [
        StatusFaultConfig(station=1, status="tilt", start_s=10.0, end_s=15.0),
        StatusFaultConfig(station=1, status="wrong_distance", start_s=20.0, end_s=25.0),
        StatusFaultConfig(station=1, status="angle_only", start_s=30.0, end_s=35.0),
    ]
    async with leica_bench(faults=faults) as day:
        await day.begin()
        readings = await day.read_for(45.0)
    seen = {reading.status for reading in readings}
    assert {Status.OK, Status.TILT, Status.WRONG_DISTANCE, Status.ANGLE_ONLY} <= seen
    assert readings[-1].status.usable
    assert all((reading.slope_distance_m is not None) == reading.status.usable for reading in readings)


async def test_settings_are_as_configured() -> None:
    """Reflector, constant, mode, atmosphere and the rest are read back into the record."""
    config = leica_config(
        prism_type="360",
        prism_constant_mm=None,
        atmosphere={"temperature_c": 25.0, "pressure_hpa": 900.0},
        reduced_field_of_view=True,
        angle_delay_ms=3.0,
    )
    async with leica_bench(config) as day:
        day.station.settings.incline = False
        await day.begin()
        record = day.instrument.record
    settings = day.station.settings
    assert (settings.prism_type, settings.prism_constant_m) == (3, 0.0231)
    assert (settings.edm_mode, settings.power_mode, settings.incline) == (9, 0, True)
    assert settings.atmosphere[:3] == (6.58e-7, 900.0, 25.0)
    assert settings.reduced_field_of_view
    assert record is not None
    assert (record.make, record.prism_type, record.prism_constant_m) == ("Leica", "360", 0.0231)
    assert record.atmospheric_ppm == pytest.approx(43.0, abs=0.1)
    assert (record.temperature_c, record.distance_mode) == (25.0, "continuous_fast")
    assert record.angle_delay_ns == 3_000_000


async def test_atmosphere_is_set_while_tracking() -> None:
    """The lock is kept and the record updated; invalid values are refused and tracking continues."""
    async with leica_bench() as day:
        await day.begin()
        await day.instrument.read()
        await day.instrument.set_atmosphere(Atmosphere(temperature_c=30.0, pressure_hpa=950.0))
        assert day.station.settings.atmosphere[1:3] == (950.0, 30.0)
        record = day.instrument.record
        assert record is not None
        assert record.pressure_hpa == 950.0
        with pytest.raises(InstrumentRefusedError, match="atmosphere"):
            await day.instrument.set_atmosphere(Atmosphere(temperature_c=30.0, pressure_hpa=100.0))
        assert (await day.instrument.read()).status is Status.OK


async def test_low_battery_is_reported() -> None:
    """With its charge."""
    async with leica_bench() as day:
        day.station.battery_percent = 9.0
        await day.begin()
        await day.instrument.read()
        assert day.instrument.condition.battery_percent == 9
        assert "battery" in day.instrument.condition.problem


# --- Single measurements ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("faces", [1, 2])
async def test_single_measurement_of_reflective_tape(faces: int) -> None:
    """The true distance in one face or two; NO_TARGET without a target; tracking resumes afterwards."""
    async with leica_bench(leica_config(target_faces=faces)) as day:
        await day.begin()
        await day.read_for(3.0)
        await day.instrument.direct()
        day.station.aim_at_target(None)
        assert (await day.instrument.measure()).status is Status.NO_TARGET
        day.station.aim_at_target(1)
        measured = await day.instrument.measure()
        assert measured.status.usable
        assert measured.slope_distance_m == pytest.approx(20.6216, abs=0.01)
        assert measured.horizontal_angle_rad == pytest.approx(math.tau - math.atan2(5, 20), abs=5e-4)
        assert measured.zenith_angle_rad < math.pi
        await day.instrument.track(1)
        assert (await day.read_until(Status.OK, within_s=30.0)).prism == 1
        assert day.station.settings.prism_constant_m == 0.0


@pytest.mark.parametrize("code", [ReturnCode.TMC_BUSY, ReturnCode.FATAL])
async def test_stored_distance_is_not_reported_again(code: ReturnCode) -> None:
    """An instrument that fails to clear it still has it, wherever it points."""
    async with leica_bench() as day:
        await day.begin()
        await day.instrument.direct()
        day.station.aim_at_target(1)
        first = await day.instrument.measure()
        day.station.server.forced.append(ForcedResponse(code=code, rpc=Rpc.TMC_DO_MEASURE, times=1))
        second = await day.instrument.measure()
        assert second.instrument_time_ns != first.instrument_time_ns
        day.station.server.forced.append(ForcedResponse(code=code, rpc=Rpc.TMC_DO_MEASURE, times=20))
        with pytest.raises(InstrumentRefusedError, match="does not start a new measurement"):
            await day.instrument.measure()


async def test_single_measurement_is_set_up_after_power_cycle() -> None:
    """The instrument has lost its target settings, and nothing reported the power cycle."""
    async with leica_bench() as day:
        await day.begin()
        await day.instrument.direct()
        day.station.aim_at_target(1)
        before = await day.instrument.measure()
        day.station.switch_off()
        day.station.switch_on()
        await asyncio.sleep(6.0)
        day.station.settings.prism_type, day.station.settings.prism_constant_m = 0, 0.0
        day.station.aim_at_target(1)
        after = await day.instrument.measure()
    assert before.slope_distance_m is not None
    assert after.slope_distance_m == pytest.approx(before.slope_distance_m, abs=0.01)


async def test_wrap_of_instrument_time_is_handled() -> None:
    """After 24.8 days its milliseconds are negative: timestamps stay as good as before."""
    async with leica_bench() as day:
        day.station._on_since_ns = day.clock.monotonic_ns() - (2**31 - 15_000) * 1_000_000
        await day.begin()
        readings = [reading for reading in await day.read_for(40.0) if reading.status.usable]
        truths = {each.instrument_ms: each.true_ns for each in day.station.reported_distances}
        errors_ms = [
            (reading.at_ns - truths[reading.instrument_time_ns // 1_000_000]) / 1e6
            for reading in readings
            if reading.instrument_time_ns is not None
        ]
    assert any((reading.instrument_time_ns or 0) < 0 for reading in readings)
    assert len(errors_ms) > 85
    assert all(15.0 < error < 30.0 for error in errors_ms)


async def test_calls_in_wrong_mode_are_refused() -> None:
    """A single measurement while tracking, a reading while not, anything while disconnected."""
    async with leica_bench() as day:
        with pytest.raises(InstrumentError, match="not connected"):
            await day.instrument.read()
        await day.instrument.connect()
        with pytest.raises(InstrumentRefusedError, match="call track first"):
            await day.instrument.read()
        await day.instrument.track(1)
        with pytest.raises(InstrumentRefusedError, match="direct"):
            await day.instrument.measure()
        assert (await day.instrument.read()).status is Status.OK


# --- Lines and power ----------------------------------------------------------------------------------------------


async def test_first_reading_follows_reconnection_within_two_seconds() -> None:
    """With the lock kept, and with consistent timestamps."""
    async with leica_bench() as day:
        await day.begin()
        before = (await day.read_for(20.0))[-1]
        day.line.plugged = False
        with pytest.raises(InstrumentError):
            await day.read_for(5.0)
        await day.instrument.close()
        await asyncio.sleep(10.0)
        day.line.plugged = True
        start_s = day.now_s
        await day.begin()
        reading = await day.instrument.read()
        took_s = day.now_s - start_s
    assert reading.status.usable
    assert took_s < 2.0
    assert before.instrument_time_ns is not None
    assert reading.instrument_time_ns is not None
    drift_ns = (reading.at_ns - before.at_ns) - (reading.instrument_time_ns - before.instrument_time_ns)
    assert abs(drift_ns) < 5_000_000


async def test_power_cycle_resets_instrument_clock() -> None:
    """Its count is near zero then: no timestamp is wrong, and readings continue after a manual lock."""
    async with leica_bench(leica_config(latency_ms=20.0)) as day:
        await day.begin()
        await day.read_for(20.0)
        day.station.switch_off()
        with pytest.raises(InstrumentError):
            await day.read_for(20.0)
        await day.instrument.close()
        day.station.switch_on()
        await asyncio.sleep(6.0)
        day.station.lock_manually(1)
        start = len(day.station.reported_distances)
        await day.begin()
        readings = [r for r in await day.read_for(20.0) if r.status.usable]
    true_ns = {offered.instrument_ms: offered.true_ns for offered in day.station.reported_distances[start:]}
    assert len(readings) > 40
    for reading in readings:
        assert reading.instrument_time_ns is not None
        assert abs(reading.at_ns - true_ns[reading.instrument_time_ns // 1_000_000]) < 20_000_000


@pytest.mark.slow
async def test_times_of_a_slowing_instrument() -> None:
    """An instrument that becomes four times as slow within two minutes does not pass for one whose clock runs slower."""
    async with leica_bench(leica_config(latency_ms=20.0)) as day:
        await day.begin()
        errors_ms = []
        for second in range(150):
            day.station.slow_down(4.0 ** max((second - 30) / 120, 0.0))
            readings = await day.read_for(1.0)
            offered = {each.instrument_ms: each.true_ns for each in day.station.reported_distances}
            errors_ms += [
                (reading.at_ns - offered[reading.instrument_time_ns // 1_000_000]) / 1e6
                for reading in readings
                if reading.instrument_time_ns is not None
            ]
    assert len(errors_ms) > 130
    assert np.abs(errors_ms).max() < 8.0


async def test_close_aborts_search() -> None:
    """At the instrument too, and no task is left."""
    async with leica_bench(faults=[occlusion(3.0, 60.0)]) as day:
        await day.begin()
        while "searching" not in day.instrument.condition.activity:
            await day.instrument.read()
        await day.instrument.close()
        await day.begin()
        assert (await day.instrument.read()).status is Status.NO_TARGET


@pytest.mark.parametrize("away_s", [0.5, 7.3, 60.0])
async def test_client_reads_within_three_seconds_of_recovery(away_s: float) -> None:
    """At any phase of the client's retry delay."""
    readings: list[tuple[float, Status]] = []
    async with leica_bench() as day:
        supervisor = InstrumentSupervisor(
            day.instrument,
            ClientSession(1, 1),
            day.clock,
            on_reading=lambda reading: readings.append((day.now_s, reading.status)),
            on_record=lambda _: None,
            on_result=lambda _: None,
        )
        task = asyncio.create_task(supervisor.run())
        await asyncio.sleep(20.0)
        day.line.plugged = False
        await asyncio.sleep(away_s)
        day.line.plugged = True
        back_s = day.now_s
        await asyncio.sleep(10.0)
        task.cancel()
        await asyncio.wait({task})
    after = [(at_s, status) for at_s, status in readings if at_s > back_s]
    assert after[0][0] - back_s < 3.0
    assert all(status.usable for _, status in after)
