"""Tripods that sink, turn, are kicked or set up elsewhere, and robots that roll over: the truth changes as said."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.missions.missions import run_linear_drive

from tsgt.config import ScenarioConfig
from tsgt.simulation.checks import check_invariants
from tsgt.simulation.faults import Fault, FaultKind, inject_fault, rollovers
from tsgt.simulation.faults.tripods import KICK_M, KICK_RAD, SINK_FACTOR, SINK_MPS, SUN_RADPS
from tsgt.simulation.instrument.model import TILT_LIMIT_RAD
from tsgt.simulation.kernel import VirtualTimeline, run_virtual
from tsgt.simulation.mission import Mission
from tsgt.simulation.options import SimulationOptions
from tsgt.simulation.world import HIDDEN_ROLL_RAD, Rollover, scenario_world

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

STATION, AT_S, DURATION_S = 2, 1.0, 40.0


def _inject(
    folder: Path, kind: FaultKind, seed: int, duration_s: float = DURATION_S
) -> tuple[Mission, list[float]]:
    """Inject one fault into a mission without daemons; return it, and its instrument's tilt in every second."""
    timeline = VirtualTimeline()
    tilts_rad: list[float] = []

    async def run() -> Mission:
        options = SimulationOptions(duration_s=50.0, seed=1)
        mission = Mission(ScenarioConfig(), options, folder=folder, timeline=timeline)
        instrument = mission.instruments[STATION]
        for second in range(50):
            timeline.call_at(
                second * 10**9 + 500_000_000,
                lambda: tilts_rad.append(math.hypot(*instrument.tilt_rad)),
            )
        await inject_fault(mission, Fault(AT_S, kind, STATION, duration_s, seed))
        await mission.sleep_until(50.0)
        return mission

    return run_virtual(run, timeline), tilts_rad


def _displacement(mission: Mission) -> tuple[NDArray[np.float64], float]:
    """Return by how much the station was shifted in m along the axes of station 1, and turned in rad, in the end."""
    (before,) = (
        np.array(each.T_station1_station)
        for each in mission.first_parameters.stations
        if each.station == STATION
    )
    after = np.array(mission.moves[-1].T_station1_station)
    turn = before[:3, :3].T @ after[:3, :3]
    assert turn[2, 2] == pytest.approx(1.0)  # it is level
    return after[:3, 3] - before[:3, 3], math.atan2(turn[1, 0], turn[0, 0])


@pytest.mark.parametrize("kind", [FaultKind.TRIPOD_SINK, FaultKind.TRIPOD_SUN])
def test_slow_movement_of_a_fraction_of_a_nanosecond_ends(tmp_path: Path, kind: FaultKind) -> None:
    """A duration as it is drawn is no whole number of nanoseconds."""
    mission, _ = _inject(tmp_path, kind, 1, DURATION_S + 0.3e-9)
    assert len(mission.moves) == DURATION_S  # a step per second


@pytest.mark.parametrize("seed", [1, 2])
def test_tripod_sinks_slowly(tmp_path: Path, seed: int) -> None:
    """Straight down, by 5 mm in an hour at least and in a minute at most, in steps that no measurement shows."""
    mission, _ = _inject(tmp_path, FaultKind.TRIPOD_SINK, seed)
    shift_m, turn_rad = _displacement(mission)
    assert -SINK_FACTOR * SINK_MPS * DURATION_S <= shift_m[2] <= -SINK_MPS * DURATION_S
    assert (shift_m[0], shift_m[1], turn_rad) == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
    assert len(mission.moves) == DURATION_S
    assert {move.station for move in mission.moves} == {STATION}


@pytest.mark.parametrize("seed", [1, 2])
def test_sun_turns_a_tripod_about_the_vertical(tmp_path: Path, seed: int) -> None:
    """By 10 to 100 microradians per minute; it tilts as well, within what the compensator corrects."""
    mission, tilts_rad = _inject(tmp_path, FaultKind.TRIPOD_SUN, seed)
    shift_m, turn_rad = _displacement(mission)
    assert not shift_m.any()
    assert DURATION_S * SUN_RADPS[0] <= abs(turn_rad) <= DURATION_S * SUN_RADPS[1]
    assert tilts_rad[-2] != tilts_rad[0]
    assert max(tilts_rad) < TILT_LIMIT_RAD


def test_kicked_tripods_are_displaced_at_once(tmp_path: Path) -> None:
    """And for good; some are so oblique that the instrument gives nothing, until somebody levels them."""
    oblique = 0
    for seed in range(6):
        folder = tmp_path / str(seed)
        folder.mkdir()
        mission, tilts_rad = _inject(folder, FaultKind.TRIPOD_KICK, seed)
        shift_m, turn_rad = _displacement(mission)
        assert [move.from_s for move in mission.moves] == [AT_S]
        assert KICK_M[0] <= np.linalg.norm(shift_m) <= KICK_M[1]
        assert KICK_RAD[0] <= abs(turn_rad) <= KICK_RAD[1]
        is_oblique = [tilt_rad > TILT_LIMIT_RAD for tilt_rad in tilts_rad]
        oblique += any(is_oblique)
        assert not is_oblique[-1]
    assert 0 < oblique < 6


def test_station_that_is_set_up_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is measured while it is carried; some are calibrated again, and their true frames are those in force then."""
    restarts: list[float] = []

    async def restart(mission: Mission, _station: int | None, at_s: float) -> None:
        assert mission.now_s == at_s
        restarts.append(at_s)

    monkeypatch.setattr(Mission, "restart", restart)
    calibrated = []
    for seed in range(5):
        folder = tmp_path / str(seed)
        folder.mkdir()
        mission, _ = _inject(folder, FaultKind.STATION_MOVED, seed)
        shift_m, turn_rad = _displacement(mission)
        assert np.linalg.norm(shift_m) > 0.3
        assert abs(turn_rad) > 0.01
        assert AT_S + 4.0 <= mission.moves[0].from_s <= AT_S + 15.0
        assert not mission.instruments[STATION].blocked
        frames = [each.T_station1_station for each in mission.parameters.stations if each.station == STATION]
        calibrated.append(frames == [mission.moves[-1].T_station1_station])
    assert restarts == [AT_S + DURATION_S] * sum(calibrated)
    assert 0 < sum(calibrated) < 5


@pytest.mark.slow
def test_turned_tripod_is_reported_until_it_is_calibrated(tmp_path: Path) -> None:
    """By 2 mrad: an event names it, and without that event a check does; with its new frame poses are right again."""

    async def turn(mission: Mission) -> None:
        await mission.sleep_until(8.0)
        mission.move_station(STATION, (0.0, 0.0, 0.0), 0.002)
        await mission.sleep_until(48.0)
        await mission.recalibrate()

    result = run_linear_drive(tmp_path, turn, 64.0)
    assert check_invariants(result, replay=False) == []
    before, after = result.master_logs
    layout = [event for event in before.events if event.event.startswith("layout")]
    assert layout
    assert not any(event.event.startswith("layout") for event in after.events)
    errors_m = (
        after.valid_poses().position_m
        - result.true_poses((after.valid_poses().stamp_ns - result.start_ns) / 1e9)[:, :3, 3]
    )
    assert len(errors_m) > 150
    assert np.median(np.linalg.norm(errors_m, axis=1)) < 0.02
    before.events = [event for event in before.events if event not in layout]
    assert "event" in {violation.check for violation in check_invariants(result, replay=False)}


def test_robot_rolls_over_and_drives_on() -> None:
    """It stands still while it lies, no prism is below the ground, and all are hidden from all stations."""
    scenario = ScenarioConfig()
    plain, rolled = (scenario_world(scenario, 60.0, np.random.default_rng(3)) for _ in range(2))
    over = Rollover(20.0, 1.5, 35.0, math.radians(-120.0))
    rolled.roll_over([over], [1, 2, 3])
    times_s = np.arange(0.0, 60.0, 0.05)
    poses, before = rolled.pose_at(times_s), plain.pose_at(times_s)
    driving = (times_s < 18.9) | (times_s > 36.1)
    assert poses[times_s < 18.9] == pytest.approx(before[times_s < 18.9], abs=1e-6)
    assert (poses[driving, 2, 2] > 0.9).all()
    lying = (times_s > 21.5) & (times_s < 33.5)
    assert np.degrees(np.arccos(poses[lying, 2, 2])) == pytest.approx(120.0, abs=6.0)  # it lies obliquely
    assert np.ptp(poses[lying, :3, 3], axis=0) == pytest.approx(0.0, abs=1e-3)
    heights_m = np.stack([rolled.prism_at(times_s, row)[:, 2] for row in range(3)])
    assert heights_m[:, lying].min() > poses[driving, 2, 3].min() - 0.2
    for station in (1, 2, 3):
        from_s, to_s = rolled.occlusions_s[station][-1]
        hidden = poses[(times_s > from_s + 0.1) & (times_s < to_s - 0.1), 2, 2]
        assert (hidden < math.cos(HIDDEN_ROLL_RAD) + 0.15).all()
        assert 20.0 < from_s < 21.5
        assert 33.5 < to_s < 35.0
    assert np.abs(np.diff(poses[:, :3, 3], axis=0)).max() < 0.2


def test_rollovers_do_not_overlap() -> None:
    """One that begins before the last one is over, or has no time to end, is left out; the roll is a right angle at least."""
    kind = FaultKind.ROBOT_ROLLOVER
    times_s = ((10.0, 20.0), (25.0, 10.0), (40.0, 3.0), (50.0, 12.0))
    faults = [Fault(at_s, kind, None, duration_s, seed) for seed, (at_s, duration_s) in enumerate(times_s)]
    found = rollovers([*faults, Fault(60.0, FaultKind.LOSS, 1, 9.0, 1)])
    assert [each.at_s for each in found] == [10.0, 50.0]
    assert [each.until_s for each in found] == [30.0, 62.0]
    assert all(math.pi / 2 <= abs(each.angle_rad) <= math.pi for each in found)
