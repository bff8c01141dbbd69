"""The simulated total station: measurement, tracking, target loss and search, manual operation."""

from __future__ import annotations

import asyncio
import math

import numpy as np
import pytest
from harness.instruments.total_stations import SETUP, SILENT, STANDING, Bench, RawReply, with_station

from tsgt.config import MotionConfig, ScenarioConfig, scenario_parameters
from tsgt.config.scenario import StatusFaultConfig
from tsgt.errors import InstrumentError
from tsgt.geometry import corrected_distance, polar_to_cartesian, transform_points
from tsgt.simulation.world import World

NO_TARGETS, NO_TARGET, NOT_ENABLED, NO_LICENCE, NO_AREA, INACCURATE = 517, 8710, 8714, 27, 8720, 8716


def numbers(response: RawReply) -> list[float]:
    """Return the values of a measurement."""
    return [float(value) for value in response.values]


async def full(bench: Bench, count: int, wait_ms: int = 1000) -> list[RawReply]:
    """Poll until this many different distances have been reported."""
    found: dict[str, RawReply] = {}
    while len(found) < count:
        response = await bench.ask(2167, wait_ms, 1)
        assert response.code in (0, 1284)
        found[response.values[7]] = response
    return list(found.values())


# --- Measuring ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("station", [1, 2, 3])
async def test_zero_noise_measures_the_truth(station: int) -> None:
    """Angles, distance and constant give the prism's position at the time of the measurement."""
    bench = Bench(with_station(ScenarioConfig(), noise=SILENT), station=station)
    await bench.do(*SETUP)
    responses = await full(bench, 40)
    offered = {str(o.instrument_ms): o for o in bench.instrument.reported_distances}
    parameters = scenario_parameters(bench.scenario).stations[station - 1]
    for response in responses:
        horizontal, zenith, *_, distance_m, _ = numbers(response)
        distance = corrected_distance(distance_m, constant_m=0.010, ppm=0.0)
        point = transform_points(
            np.array(parameters.T_station1_station), polar_to_cartesian(horizontal, zenith, distance)
        )
        true = bench.world.prism_at(np.array([offered[response.values[7]].true_ns / 1e9]), station - 1)[0]
        np.testing.assert_allclose(point, true, atol=1e-9)


async def test_noise_matches_the_scenario() -> None:
    """The spread of distance and angles to a stationary prism is that of the configuration."""
    bench = Bench(with_station(rate_hz=20.0))
    await bench.do(*SETUP)
    responses = np.array([numbers(response) for response in await full(bench, 600)])
    distance_m, across = responses[:, 6], responses[:, 0] * responses[0, 6]
    assert distance_m.std() == pytest.approx(math.hypot(0.002, 0.001), rel=0.1)
    assert across.std() == pytest.approx(0.001, rel=0.15)


async def test_measurement_times_have_jitter_and_drift() -> None:
    """Timestamps are the instrument's ms, whose clock drifts; every measurement is reported if polled often enough."""
    scenario = with_station(instrument={"clock_drift_ppm": 500.0, "tick_jitter_ms": 3.0})
    bench = Bench(scenario)
    await bench.do(*SETUP)
    stamps = np.array([int(response.values[7]) for response in await full(bench, 200)])
    steps_ms = np.diff(stamps)
    assert steps_ms.mean() == pytest.approx(400 * (1 + 500e-6), abs=0.05)
    assert steps_ms.std() == pytest.approx(3.0 * math.sqrt(2), rel=0.15)
    assert len(bench.instrument.reported_distances) == 200


async def test_measurement_phase_is_random() -> None:
    """Each seed gives another phase within a period."""
    phases = set()
    for seed in (1, 2, 3):
        bench = Bench(with_station(instrument={"tick_jitter_ms": 0.0}), seed=seed)
        await bench.do(*SETUP)
        await full(bench, 1)
        phases.add(bench.instrument.reported_distances[0].true_ns % 400_000_000)
    assert len(phases) == 3


async def test_world_is_constant_after_its_end() -> None:
    """The instrument can be read for longer than the ground truth."""
    bench = Bench(with_station(ScenarioConfig(), noise=SILENT), duration_s=2.0)
    await bench.do(*SETUP)
    responses = await full(bench, 12)
    assert len({response.values[6] for response in responses[6:]}) == 1


async def test_target_below_the_minimum_range_gives_angles_only() -> None:
    """Below a metre."""
    still = MotionConfig(speeds_mps=(0.0,), speed_weights=(1.0,), area_centre_m=(0.5, 0.0, -1.0))
    bench = Bench(ScenarioConfig(motion=still))
    bench.instrument.aim_at_prism(1)
    await bench.do(*SETUP)
    await asyncio.sleep(1.0)
    response = await bench.ask(2167, 1000, 1)
    assert (response.code, float(response.values[6])) == (1285, 0.0)


async def test_stored_distance_is_repeated() -> None:
    """Polled before the next measurement, it repeats the distance with its timestamp; it counts as reported once."""
    bench = Bench(with_station(rate_hz=1.0))
    await bench.do(*SETUP)
    await bench.ask(2167, 2000, 1)
    before = bench.instrument.reported_distances[-1]
    first, second = [await bench.ask(2167, 2000, 1) for _ in range(2)]
    assert first.values[6:] == second.values[6:]
    assert float(first.values[6]) == before.distance_m
    assert len(bench.instrument.reported_distances) == 1


async def test_processing_time() -> None:
    """Between request and response is a time within the model's limits."""
    bench = Bench(with_station(instrument={"processing_min_ms": 20.0, "processing_max_ms": 60.0}))
    delays = []
    for _ in range(200):
        sent_ns = bench.timeline.now_ns()
        response = await bench.ask(0)
        request = len(f"%R1Q,0,{response.transaction}:\r\n")
        line_ns = (request + len(response.chunk.data)) * 10e9 / 115_200
        delays.append((response.chunk.at_ns - sent_ns - line_ns) / 1e6)
    assert 20.0 <= min(delays) < 22.0
    assert 58.0 < max(delays) <= 60.001


async def test_stalls() -> None:
    """Occasionally a response takes 300 to 700 ms."""
    bench = Bench(with_station(instrument={"stalls_per_min": 30.0}))
    slow = 0
    while bench.timeline.now_ns() < 60e9:
        sent_ns = bench.timeline.now_ns()
        await bench.ask(0)
        slow += bench.timeline.now_ns() - sent_ns > 250e6
    assert 15 < slow < 45


async def test_angle_delay() -> None:
    """With an angle delay, a moving prism's angles are those of a later instant."""
    early, late = [
        Bench(
            with_station(
                ScenarioConfig(), noise=SILENT, instrument={"angle_delay_ms": delay, "tick_jitter_ms": 0.0}
            )
        )
        for delay in (0.0, 50.0)
    ]
    for bench in (early, late):
        await bench.do(*SETUP)
        await full(bench, 30)
    for one, other in zip(
        early.instrument.reported_distances, late.instrument.reported_distances, strict=False
    ):
        assert one.true_ns % 400_000_000 == other.true_ns % 400_000_000
    apart = [
        o.horizontal_angle_rad - _horizontal(late, (o.true_ns + 50_000_000) / 1e9)
        for o in late.instrument.reported_distances
    ]
    assert max(map(abs, apart)) < 1e-9


async def test_lock_drifts_before_a_loss_and_settles_after_it() -> None:
    """The angles move away from the prism in the last second before an occlusion; after it their error decays."""
    hidden = StatusFaultConfig(station=1, status="no_target", start_s=4.0, end_s=5.0)
    scenario = ScenarioConfig(motion=STANDING, faults=(hidden,))
    bench = Bench(
        with_station(
            scenario,
            noise=SILENT,
            rate_hz=10.0,
            instrument={"lock_drift_mmps": 50.0, "relock_error_mm": 20.0, "tick_jitter_ms": 0.0},
        )
    )
    await bench.do(*SETUP)
    while bench.timeline.now_ns() < 9e9:
        await bench.ask(2167, 200, 1)
    reported = bench.instrument.reported_distances
    x, y, z = bench.world.prism_at(np.array([0.0]), 0)[0]
    distance_m = math.sqrt(x * x + y * y + z * z)
    error_mm = [
        1e3
        * distance_m
        * math.hypot(
            (r.horizontal_angle_rad - math.atan2(-y, x) % math.tau) * math.hypot(x, y) / distance_m,
            r.zenith_angle_rad - math.acos(z / distance_m),
        )
        for r in reported
    ]
    time_s = [r.true_ns / 1e9 for r in reported]
    for at_s, error in zip(time_s, error_mm, strict=True):
        if at_s < 4.0:
            assert error == pytest.approx(50.0 * max(at_s - 3.0, 0.0), abs=1.1)
        else:
            assert error == pytest.approx(20.0 * math.exp(-(at_s - 5.0) / 0.3), abs=1.5)
    assert max(error for at_s, error in zip(time_s, error_mm, strict=True) if at_s < 4.0) > 40.0
    assert max(error for at_s, error in zip(time_s, error_mm, strict=True) if at_s > 4.0) > 10.0


def _horizontal(bench: Bench, world_s: float) -> float:
    x, y, _ = bench.world.prism_at(np.array([world_s]), 0)[0]
    return math.atan2(-y, x) % math.tau


async def test_atmospheric_correction_scales_the_distance() -> None:
    """Set to 20 degrees instead of 12 it reports 8 ppm more; set to the true values, the true distance."""
    bench = Bench(with_station(noise=SILENT))
    await bench.do(*SETUP)
    (response,) = await full(bench, 1)
    right_m = float(response.values[6])
    await bench.do((2028, 6.58e-7, 1013.25, 20.0, 15.0))
    wrong_m = float((await full(bench, 2))[1].values[6])
    assert (wrong_m - right_m) / right_m * 1e6 == pytest.approx(7.9, abs=0.1)
    bench.instrument.air = (20.0, 1013.25)
    assert float((await full(bench, 2))[1].values[6]) == pytest.approx(right_m, abs=1e-9)


async def test_prism_type_sets_the_prism_constant() -> None:
    """The distance includes the constant that is set."""
    bench = Bench(with_station(noise=SILENT))
    await bench.do(*SETUP)
    (zero,) = await full(bench, 1)
    await bench.do((2008, 3, 1), (17008, 7))
    assert (await bench.ask(2023)).values == ["0.03"]
    await bench.do((2008, 1, 1))
    (response,) = await full(bench, 1)
    assert float(response.values[6]) - float(zero.values[6]) == pytest.approx(0.030, abs=1e-9)


async def test_fast_turn_gives_accuracy_warning() -> None:
    """A prism that moves across gives code 1284, a stationary one does not."""
    near = with_station(ScenarioConfig(), position_m=(50.0, 35.0, 0.0))
    moving, standing = Bench(near), Bench()
    codes = []
    for bench in (moving, standing):
        await bench.do(*SETUP)
        codes.append({response.code for response in await full(bench, 60)})
    assert 1284 in codes[0]
    assert codes[1] == {0}


@pytest.mark.parametrize(
    ("status", "code"), [("tilt", 1290), ("wrong_distance", 1291), ("angle_only", 1285), ("no_target", 1285)]
)
async def test_scenario_faults(status: str, code: int) -> None:
    """Each has its return code, gives no distance, and ends."""
    fault = StatusFaultConfig(station=1, status=status, start_s=3.0, end_s=4.0)  # type: ignore[arg-type]
    bench = Bench(ScenarioConfig(motion=STANDING, faults=(fault,)))
    await bench.do(*SETUP)
    seen: dict[int, list[RawReply]] = {}
    await full(bench, 1)
    while bench.timeline.now_ns() < 8e9:
        response = await bench.ask(2167, 100, 1)
        seen.setdefault(response.code, []).append(response)
    assert set(seen) - {1285} == {0, code} - {1285}
    assert code in seen
    assert all(not response.values or float(response.values[6]) == 0 for response in seen[code])
    true_s = [offered.true_ns / 1e9 for offered in bench.instrument.reported_distances]
    assert not [at_s for at_s in true_s if 3.0 <= at_s < 4.0]
    assert true_s[-1] > 7


# --- The lock -------------------------------------------------------------------------------------------------------


async def test_locked_from_the_start() -> None:
    """The lock status says so."""
    bench = Bench(ScenarioConfig(), station=2)
    assert (await bench.ask(6021)).values == ["1"]
    await bench.do(*SETUP)
    await bench.ask(2167, 1000, 1)
    assert bench.instrument.reported_distances[0].prism == 2


async def test_occluded_prism_is_predicted_then_lost() -> None:
    """Two seconds of prediction, then unlocked without distances."""
    bench = Bench()
    await bench.do(*SETUP)
    await full(bench, 2)
    bench.instrument.blocked = True
    states = []
    while bench.timeline.now_ns() < 8e9:
        states.append((await bench.ask(6021)).values[0])
    assert list(dict.fromkeys(states)) == ["2", "0"]
    assert states.count("2") * 0.045 == pytest.approx(2.0, abs=0.4)
    response = await bench.ask(2167, 500, 1)
    assert (response.code, response.values) == (1292, [])


async def test_occlusion_of_the_world_stops_distances() -> None:
    """No distance is measured during an occlusion."""
    scenario = ScenarioConfig()
    prisms = np.array([prism.position_m for prism in scenario.prisms])
    spans_s = {1: np.array([[4.0, 5.0]])}
    bench = Bench(scenario, world=World(scenario.motion, prisms, 60.0, np.random.default_rng(1), spans_s))
    await bench.do(*SETUP)
    await full(bench, 20)
    true_s = [offered.true_ns / 1e9 for offered in bench.instrument.reported_distances]
    assert min(true_s) < 4.0
    assert not [at_s for at_s in true_s if 4.0 <= at_s < 5.0]


async def test_prism_is_reacquired_during_prediction() -> None:
    """Without any command."""
    bench = Bench(ScenarioConfig())
    await bench.do(*SETUP)
    bench.instrument.blocked = True
    await asyncio.sleep(1.0)
    assert (await bench.ask(6021)).values == ["2"]
    bench.instrument.blocked = False
    await asyncio.sleep(0.1)
    assert (await bench.ask(6021)).values == ["1"]


async def test_too_fast_prism_is_lost() -> None:
    """A robot that passes closely exceeds the maximum turn rate."""
    passing = with_station(ScenarioConfig(), position_m=(60.0, 45.0, 0.0))
    bench = Bench(passing)
    states = set()
    while bench.timeline.now_ns() < 60e9:
        states.add((await bench.ask(6021)).values[0])
    assert states & {"0", "2"}


async def test_fine_adjust_and_lock_in() -> None:
    """An unlocked instrument finds the prism in a window and locks on it."""
    bench = Bench()
    await bench.do((18007, 0))
    assert (await bench.ask(6021)).values == ["0"]
    await bench.do((9031, 1), (9037, 0.087, 0.087, 0), (18007, 1), (9013,))
    assert (await bench.ask(6021)).values == ["1"]


async def test_search_without_target_fails() -> None:
    """Fine adjustment fails with 8710 within 5 s, lock-in with 517."""
    bench = Bench()
    await bench.do((9027, 1.0, 1.5, 0, 0, 0))
    start_ns = bench.timeline.now_ns()
    assert await bench.code(9037, 0.5, 0.5, 0) == NO_TARGET
    assert 4.9e9 < bench.timeline.now_ns() - start_ns < 5.3e9
    assert await bench.code(9013) == NO_TARGETS


async def test_fine_adjustment_of_a_moving_prism_needs_point_tolerance() -> None:
    """With angle tolerance a moving prism cannot be pointed at accurately."""
    near = with_station(ScenarioConfig(), position_m=(50.0, 35.0, 0.0))
    bench = Bench(near)
    await asyncio.sleep(20.0)
    codes = set()
    for _ in range(30):
        await bench.do((18007, 0), (9031, 0))
        codes.add(await bench.code(9037, 0.1, 0.1, 0))
        await bench.do((9031, 1))
        bench.instrument.lock_manually(1)
    assert INACCURATE in codes


async def test_atr_on_releases_the_lock() -> None:
    """Without target recognition nothing is found."""
    bench = Bench()
    await bench.do((18005, 1))
    assert (await bench.ask(18008)).values == ["0"]
    assert (await bench.ask(6021)).values == ["0"]
    await bench.do((18005, 0))
    assert await bench.code(9037, 0.1, 0.1, 0) == NOT_ENABLED


async def test_positioning_releases_the_lock() -> None:
    """It takes the turning time and ends within its tolerance."""
    bench = Bench()
    horizontal, zenith = [float(value) for value in (await bench.ask(2107, 1)).values]
    start_ns = bench.timeline.now_ns()
    await bench.do((9027, (horizontal + math.pi) % math.tau, zenith, 0, 0, 0))
    assert 4.5e9 < bench.timeline.now_ns() - start_ns < 5.0e9
    assert (await bench.ask(6021)).values == ["0"]
    there = float((await bench.ask(2107, 1)).values[0])
    assert math.remainder(there - horizontal - math.pi, math.tau) == pytest.approx(0.0, abs=5e-5)


async def test_power_search_in_a_window() -> None:
    """It finds the first prism in the window, and fails without a window or a prism in it."""
    bench = Bench()
    horizontal, zenith = [float(value) for value in (await bench.ask(2107, 1)).values]
    await bench.do((18007, 0), (9031, 1))
    assert await bench.code(9052) == NO_AREA
    await bench.do((9043, horizontal + 2.0, zenith, 0.5, 0.3, 1))
    assert await bench.code(9052) == NO_TARGET
    await bench.do((9043, horizontal + 0.1, zenith, 0.5, 0.3, 1), (9052,), (18007, 1), (9013,))
    assert (await bench.ask(6021)).values == ["1"]


async def test_power_search_respects_its_range() -> None:
    """Prisms outside the range are ignored."""
    bench = Bench()
    await bench.do((9047, 10, 60), (9048, 1))
    assert await bench.code(9051, 1, 1) == NO_TARGET
    await bench.do((9048, 0), (9051, -1, 0))


async def test_missing_licence() -> None:
    """Search and lock commands are rejected; an existing lock keeps measuring."""
    bench = Bench()
    bench.instrument.robotic_licence = False
    for request in ((9037, 0.1, 0.1, 0), (9013,), (18007, 1), (18005, 1), (9027, 1.0, 1.5, 0, 0, 0)):
        assert await bench.code(*request) == NO_LICENCE
    await bench.do(*SETUP)
    assert len(await full(bench, 3)) == 3


# --- What a person does ---------------------------------------------------------------------------------------------


async def test_foil_target() -> None:
    """It is measured in tape mode with the tape's constant, not in prism mode."""
    bench = Bench(ScenarioConfig(motion=STANDING, targets_m=((20.0, 5.0, 0.5),)))
    await bench.do((18007, 0), (2008, 3, 1), (17008, 2), (2020, 1))
    bench.instrument.aim_at_target(1)
    start_ns = bench.timeline.now_ns()
    await bench.do((2008, 1, 1))
    shot = await bench.ask(2167, 5000, 1)
    assert 1e9 < bench.timeline.now_ns() - start_ns < 2.2e9
    assert float(shot.values[6]) == pytest.approx(20.6216, abs=0.005)
    await bench.do((2008, 3, 1), (2020, 2), (2008, 1, 1))
    assert await bench.code(2167, 5000, 1) == 1292


async def test_two_face_measurement() -> None:
    """In the second face the zenith angle is above pi, and the circle is turned by pi."""
    bench = Bench(ScenarioConfig(motion=STANDING, targets_m=((20.0, 5.0, 0.5),)))
    await bench.do((18007, 0), (2008, 3, 1), (17008, 2), (2020, 1))
    bench.instrument.aim_at_target(1)
    shots = []
    for _ in range(2):
        await bench.do((2008, 1, 1))
        shots.append(numbers(await bench.ask(2167, 5000, 1)))
        await bench.do((2008, 3, 1), (9028, 0, 0, 0))
    (h1, v1, *_), (h2, v2, *_) = shots
    assert math.remainder(h2 - h1 - math.pi, math.tau) == pytest.approx(0.0, abs=5e-5)
    assert v1 + v2 == pytest.approx(math.tau, abs=5e-5)


async def test_unknown_target_is_rejected() -> None:
    """The scenario has no targets."""
    with pytest.raises(InstrumentError, match="no target 1"):
        Bench().instrument.aim_at_target(1)


async def test_another_prism_can_be_aimed_at_manually() -> None:
    """It is measured, and tracked after lock-in."""
    bench = Bench()
    await bench.do(*SETUP)
    bench.instrument.aim_at_prism(3)
    assert (await bench.ask(6021)).values == ["0"]
    await asyncio.sleep(1.0)
    await bench.ask(2167, 1000, 1)
    assert bench.instrument.reported_distances[-1].prism == 3
    await bench.do((9037, 0.05, 0.05, 0), (9013,))
    await full(bench, 3)
    assert bench.instrument.reported_distances[-1].prism == 3


async def test_power_cycle() -> None:
    """No responses until it has booted; its time restarts at zero, and it is not locked."""
    bench = Bench()
    await bench.do(*SETUP)
    (before,) = await full(bench, 1)
    bench.instrument.switch_off()
    await bench.send(b"%R1Q,0,1:\r\n")
    assert await bench.quiet(2.0)
    bench.instrument.switch_on()
    await asyncio.sleep(4.0)
    await bench.send(b"%R1Q,0,1:\r\n")
    assert await bench.quiet(0.9)
    await asyncio.sleep(0.5)
    assert (await bench.ask(6021)).values == ["0"]
    assert (await bench.ask(18008)).values == ["0"]
    after_ms = int((await bench.ask(2003, 1)).values[3])
    assert after_ms == pytest.approx(5500, abs=300)
    assert after_ms < int(before.values[7])


async def test_instrument_time_wraps() -> None:
    """After 24.8 days the milliseconds wrap to negative values."""
    bench = Bench(with_station(instrument={"clock_drift_ppm": 0.0}))
    bench.instrument._on_since_ns = bench.timeline.now_ns() - (2**31 - 1000) * 1_000_000
    assert int((await bench.ask(2003, 1)).values[3]) > 0
    await asyncio.sleep(2.0)
    assert int((await bench.ask(2003, 1)).values[3]) < 0


async def test_automatic_power_off() -> None:
    """After the idle timeout it switches off, and the next bytes wake it up; unless this is disabled."""
    bench = Bench()
    await bench.do((14002, 0, 2, 60_000))
    await asyncio.sleep(61.0)
    await bench.send(b"%R1Q,0,1:\r\n")
    assert await bench.quiet(5.0)
    await bench.do((0,), (14002, 0, 0, 60_000))
    await asyncio.sleep(1000.0)
    await bench.do((0,))


@pytest.mark.parametrize(("percent", "external", "code"), [(85, 0, 0), (10, 0, 16), (2, 0, 18), (2, 1, 0)])
async def test_battery_levels(percent: int, external: int, code: int) -> None:
    """A low battery is a return code with values."""
    bench = Bench()
    bench.instrument.battery_percent, bench.instrument.external_power = percent, bool(external)
    response = await bench.ask(5039)
    assert (response.code, response.values[0]) == (code, str(percent))


async def test_compensator_off() -> None:
    """Return codes report the missing correction; it cannot be switched while a distance is stored."""
    bench = Bench()
    await bench.do(*SETUP)
    await full(bench, 1)
    assert await bench.code(2006, 0) == 1293
    await bench.do((2008, 3, 1), (2006, 0), (2008, 1, 1))
    assert await bench.code(2167, 1000, 1) == 1283
    assert (await bench.ask(2115)).values == ["1"]
