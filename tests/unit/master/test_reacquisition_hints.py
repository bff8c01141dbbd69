from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.drives.scene import SECOND, START, driving, stationary_scene
from hypothesis import given, settings
from hypothesis import strategies as st

from tsgt.config import ScenarioConfig
from tsgt.geometry import exp_so3, polar_to_cartesian
from tsgt.master.reacquisition_hints import (
    HINT_INTERVAL_NS,
    MAX_FREQUENT_HINTS,
    SLOW_HINT_INTERVAL_NS,
    ReacquisitionHints,
)
from tsgt.model import Status
from tsgt.simulation.world import scenario_world

if TYPE_CHECKING:
    from collections.abc import Callable

    from harness.drives.scene import Motion, Scene
    from numpy.typing import NDArray

    from tsgt.radio import Direction

STEP_S = 0.4
LOST_S = 10.0


def ns(time_s: float) -> int:
    """Return an instant of the scene on the master's Unix clock."""
    return START + round(time_s * SECOND)


def watch(
    hints: ReacquisitionHints,
    scene: Scene,
    *,
    since_s: float = 0.0,
    until_s: float = 12.5,
    sees: Callable[[int, float], Status | None] = lambda station, time_s: _loses(
        station, time_s, from_s=LOST_S
    ),
) -> None:
    """Let all stations measure for a while; by default the second one loses its prism; None: it is not received."""
    for step in range(math.ceil(since_s / STEP_S), math.ceil(until_s / STEP_S)):
        for station in (1, 2, 3):
            time_s = STEP_S * step + 0.01 * station
            status = sees(station, time_s)
            if status is not None:
                hints.measured(scene.measure(station, time_s, status=status))


def beside_rad(scene: Scene, towards: Direction, time_s: float, *, station: int = 2, prism: int = 0) -> float:
    """Return how far a direction is from where the station's prism is, or another one."""
    true = scene.measure(station, time_s, prism=prism)
    at = polar_to_cartesian(true.horizontal_angle_rad, true.zenith_angle_rad, 1.0)
    hinted = polar_to_cartesian(towards.horizontal_angle_rad, towards.zenith_angle_rad, 1.0)
    return math.acos(min(float(at @ hinted), 1.0))


def test_lost_prism_gives_a_hint() -> None:
    """After two seconds, with the spread of the layout: 0.8 m in 38 m, plus half a metre."""
    scene = stationary_scene()
    hints = ReacquisitionHints(scene.parameters)
    watch(hints, scene)
    assert hints.direction(2, ns(12.0)) is None
    towards = hints.direction(2, ns(12.5))
    assert towards is not None
    assert beside_rad(scene, towards, 12.5) < towards.spread_rad < math.radians(2.5)
    assert hints.direction(1, ns(12.5)) is None


def test_angle_only_status_is_a_lost_prism() -> None:
    """An instrument that has lost the prism may still report angles."""
    scene = stationary_scene()
    hints = ReacquisitionHints(scene.parameters)
    watch(hints, scene, sees=lambda s, t: Status.ANGLE_ONLY if s == 2 and t > LOST_S else Status.OK)
    assert hints.direction(2, ns(12.5)) is not None


@pytest.mark.parametrize("status", [Status.TILT, Status.ERROR, Status.WRONG_DISTANCE, Status.LOW_ACCURACY])
def test_other_errors_give_no_hint(status: Status) -> None:
    """A search does not level an instrument."""
    scene = stationary_scene()
    hints = ReacquisitionHints(scene.parameters)
    watch(hints, scene, sees=lambda s, t: status if s == 2 and t > LOST_S else Status.OK)
    assert hints.direction(2, ns(12.5)) is None


def motion(
    speed_mps: float, yaw_rate_radps: float, heading_rad: float, tilt_rad: float
) -> Callable[[float], Motion]:
    """Return a robot that leans and drives a bend; after 12.5 s it is 50 m away."""

    def along_m(time_s: float) -> NDArray[np.float64]:
        """Return the path from its position after 12.5 s, as a sum of small steps."""
        turned = heading_rad + yaw_rate_radps * (12.5 + (time_s - 12.5) * (np.arange(200) + 0.5) / 200)
        mean = np.array([np.cos(turned).mean(), np.sin(turned).mean(), 0.0])
        return speed_mps * (time_s - 12.5) * mean

    def at(time_s: float) -> Motion:
        yaw = exp_so3(np.array([0.0, 0.0, heading_rad + yaw_rate_radps * time_s]))
        lean = exp_so3(np.array([tilt_rad, -tilt_rad, 0.0]))
        return yaw @ lean, np.array([45.0, 25.0, 1.0]) + along_m(time_s)

    return at


@settings(max_examples=60)
@given(
    speed_mps=st.floats(0.0, 1.5),
    yaw_rate_radps=st.floats(-0.5, 0.5),
    heading_rad=st.floats(-math.pi, math.pi),
    tilt_rad=st.floats(-0.4, 0.4),
    lost=st.sampled_from([(2,), (2, 3), (1, 2)]),
)
@pytest.mark.slow
def test_prism_is_within_the_spread(
    speed_mps: float, yaw_rate_radps: float, heading_rad: float, tilt_rad: float, lost: tuple[int, ...]
) -> None:
    """However the robot moves, with one other prism and with two, for the next second and a half."""
    scene = stationary_scene().moving(motion(speed_mps, yaw_rate_radps, heading_rad, tilt_rad))
    hints = ReacquisitionHints(scene.parameters)
    watch(hints, scene, sees=lambda s, t: Status.NO_TARGET if s in lost and t > LOST_S else Status.OK)
    towards = hints.direction(2, ns(12.6))
    assert towards is not None
    for ahead_s in (0.0, 0.5, 1.0, 1.5):
        assert beside_rad(scene, towards, 12.6 + ahead_s) <= towards.spread_rad
    assert towards.spread_rad < math.asin((1.0 + 0.5 + 1.1 * speed_mps + 0.5) / 40.0)


@pytest.mark.slow
def test_prism_is_within_the_spread_in_the_reference_scenario() -> None:
    """The robot starts, stops and turns: always when the command is given, mostly when the telescope arrives."""
    world = scenario_world(ScenarioConfig(), 600.0, np.random.default_rng(0))

    def motion(time_s: float) -> Motion:
        T_station1_robot = world.pose_at(np.array([time_s]))[0]
        return T_station1_robot[:3, :3], T_station1_robot[:3, 3]

    scene = stationary_scene().moving(motion)
    inside = []
    for begin_s in range(0, 590, 5):
        hints = ReacquisitionHints(scene.parameters)
        lost = partial(_loses, from_s=begin_s + 0.5)
        watch(hints, scene, since_s=begin_s, until_s=begin_s + 3.0, sees=lost)
        now_s = begin_s + 3.1
        towards = hints.direction(2, ns(now_s))
        assert towards is not None
        inside.append(
            [beside_rad(scene, towards, now_s + ahead_s) <= towards.spread_rad for ahead_s in (0.0, 1.0, 2.0)]
        )
    shares = np.mean(inside, axis=0)
    assert shares[0] == 1.0
    assert shares[1] >= 0.98
    assert shares[2] >= 0.93


def _loses(station: int, time_s: float, *, from_s: float) -> Status:
    """Let the second station lose its prism."""
    return Status.NO_TARGET if station == 2 and time_s >= from_s else Status.OK


def test_no_hint_without_recent_points() -> None:
    """All stations have lost their prism, or their points are too old."""
    scene = stationary_scene()
    hints = ReacquisitionHints(scene.parameters)
    watch(hints, scene, sees=lambda _, t: Status.NO_TARGET if t > LOST_S else Status.OK)
    assert hints.direction(2, ns(12.5)) is None
    hints = ReacquisitionHints(scene.parameters)
    watch(hints, scene, until_s=12.0)
    assert hints.direction(2, ns(12.5)) is not None
    hints = ReacquisitionHints(scene.parameters)
    watch(hints, scene, until_s=12.0)
    assert hints.direction(2, ns(13.3)) is None


def test_no_hint_from_a_single_point() -> None:
    """The speed is unknown."""
    scene = stationary_scene()
    hints = ReacquisitionHints(scene.parameters)
    watch(hints, scene, sees=lambda s, t: Status.NO_TARGET if s == 2 else (Status.OK if t > 12.3 else None))
    assert hints.direction(2, ns(12.5)) is None


def test_no_hint_for_a_very_near_robot() -> None:
    """No direction is useful when the robot's size is comparable to its distance."""
    near = stationary_scene().moving(lambda _: (np.eye(3), np.array([2.5, -2.0, -1.0])))
    hints = ReacquisitionHints(near.parameters)
    watch(hints, near)
    assert hints.direction(2, ns(12.5)) is None


def test_other_station_on_the_same_prism_is_preferred() -> None:
    """With more stations than prisms; only a start of the robot remains uncertain."""
    scene = stationary_scene()
    hints = ReacquisitionHints(scene.parameters)
    watch(hints, scene)
    for step in range(25, 32):
        hints.measured(scene.measure(1, STEP_S * step + 0.05, prism=2))
    towards = hints.direction(2, ns(12.5))
    assert towards is not None
    assert beside_rad(scene, towards, 12.5) < 1e-4
    assert towards.spread_rad == pytest.approx(0.5 / 38, rel=0.1)


def test_hint_is_in_the_face_of_the_telescope() -> None:
    """An instrument in the second face need not transit."""
    scene = stationary_scene()
    hints, turned = ReacquisitionHints(scene.parameters), ReacquisitionHints(scene.parameters)
    watch(hints, scene)
    for step in range(32):
        for station in (1, 2, 3):
            time_s = STEP_S * step + 0.01 * station
            lost = station == 2 and time_s > LOST_S
            first = scene.measure(station, time_s, status=Status.NO_TARGET if lost else Status.OK)
            turned.measured(
                replace(
                    first,
                    horizontal_angle_rad=first.horizontal_angle_rad + math.pi,
                    zenith_angle_rad=math.tau - first.zenith_angle_rad,
                )
            )
    one, two = hints.direction(2, ns(12.5)), turned.direction(2, ns(12.5))
    assert one is not None
    assert two is not None
    assert two.zenith_angle_rad == pytest.approx(math.tau - one.zenith_angle_rad)
    apart_rad = math.remainder(two.horizontal_angle_rad - one.horizontal_angle_rad, math.tau)
    assert abs(apart_rad) == pytest.approx(math.pi)


def test_hint_is_renewed_every_five_seconds() -> None:
    """From the latest points; after six of them every half minute, and none in between."""
    scene = stationary_scene().moving(driving)
    hints = ReacquisitionHints(scene.parameters)
    hinted: list[tuple[float, Direction | None]] = [(0.0, None)]
    for tenth in range(1000):
        time_s = 0.1 * tenth
        watch(hints, scene, since_s=time_s, until_s=time_s + 0.1)
        towards = hints.direction(2, ns(time_s + 0.2))
        if towards is not hinted[-1][1]:
            hinted.append((time_s + 0.2, towards))
    changes_s = [round(time_s - hinted[1][0], 6) for time_s, _ in hinted[1:]]
    again_s, seldom_s = HINT_INTERVAL_NS / SECOND, SLOW_HINT_INTERVAL_NS / SECOND
    assert changes_s == pytest.approx(
        [
            *(again_s * number for number in range(MAX_FREQUENT_HINTS + 1)),
            again_s * (MAX_FREQUENT_HINTS - 1) + seldom_s,
            again_s * MAX_FREQUENT_HINTS + seldom_s,
            again_s * (MAX_FREQUENT_HINTS - 1) + 2 * seldom_s,
        ],
        abs=0.11,
    )
    assert [towards is None for _, towards in hinted[1:]] == [False] * MAX_FREQUENT_HINTS + [
        True,
        False,
        True,
        False,
    ]
    for time_s, towards in hinted:
        assert towards is None or beside_rad(scene, towards, time_s) <= towards.spread_rad


def test_reacquired_prism_ends_the_hints() -> None:
    """At once; the next loss gives a hint after two seconds."""
    scene = stationary_scene()
    hints = ReacquisitionHints(scene.parameters)
    watch(hints, scene)
    first = hints.direction(2, ns(12.5))
    assert first is not None
    watch(hints, scene, since_s=12.5, until_s=14.0, sees=lambda _s, _t: Status.OK)
    assert hints.direction(2, ns(14.0)) is None
    watch(hints, scene, since_s=14.0, until_s=16.0)
    assert hints.direction(2, ns(16.0)) is None
    watch(hints, scene, since_s=16.0, until_s=16.5)
    again = hints.direction(2, ns(16.5))
    assert again is not None
    assert again is not first


def _follow_another_robot(
    hints: ReacquisitionHints, scene: Scene, *, since_s: float, until_s: float, away_m: float
) -> None:
    """Let the second station follow a prism that is nearer than its own by this."""
    for step in range(math.ceil(since_s / STEP_S), math.ceil(until_s / STEP_S)):
        for station in (1, 2, 3):
            measured = scene.measure(station, STEP_S * step + 0.01 * station)
            if station == 2:
                turned_rad = measured.horizontal_angle_rad + away_m / 38
                measured = replace(measured, horizontal_angle_rad=turned_rad)
            hints.measured(measured)


def test_station_on_another_robots_prism_gets_a_hint() -> None:
    """Where the others see the robot, while they agree; the hint stays for as long as any, and two are enough."""
    scene = stationary_scene()
    hints = ReacquisitionHints(scene.parameters)
    watch(hints, scene, until_s=LOST_S)
    _follow_another_robot(hints, scene, since_s=LOST_S, until_s=11.5, away_m=4.0)
    assert hints.direction(2, ns(11.5)) is None
    _follow_another_robot(hints, scene, since_s=11.6, until_s=12.5, away_m=4.0)
    towards = hints.direction(2, ns(12.5))
    assert towards is not None
    assert beside_rad(scene, towards, 12.5) < towards.spread_rad
    assert hints.direction(1, ns(12.5)) is hints.direction(3, ns(12.5)) is None
    _follow_another_robot(hints, scene, since_s=12.8, until_s=13.3, away_m=4.0)
    assert hints.direction(2, ns(13.3)) is towards
    _follow_another_robot(hints, scene, since_s=13.6, until_s=40.0, away_m=4.0)
    second = hints.direction(2, ns(40.0))
    assert second is not None
    assert second is not towards
    _follow_another_robot(hints, scene, since_s=40.0, until_s=80.0, away_m=4.0)
    assert hints.direction(2, ns(80.0)) is None


@pytest.mark.parametrize(("consistent_until_s", "away_m"), [(LOST_S, 0.3), (0.0, 4.0)])
def test_station_that_was_never_consistent_or_nearly_is_gets_no_hint(
    consistent_until_s: float, away_m: float
) -> None:
    """A wrong frame is no reason to release a prism, and neither is what a turning robot leaves uncertain."""
    scene = stationary_scene()
    hints = ReacquisitionHints(scene.parameters)
    watch(hints, scene, until_s=consistent_until_s)
    _follow_another_robot(hints, scene, since_s=consistent_until_s, until_s=20.0, away_m=away_m)
    assert hints.direction(2, ns(20.0)) is None


def test_own_prism_after_another_robots_ends_the_hints() -> None:
    """After two measurements that fit: its velocity is known again."""
    scene = stationary_scene()
    hints = ReacquisitionHints(scene.parameters)
    watch(hints, scene, until_s=LOST_S)
    _follow_another_robot(hints, scene, since_s=LOST_S, until_s=12.5, away_m=4.0)
    assert hints.direction(2, ns(12.5)) is not None
    watch(hints, scene, since_s=12.8, until_s=14.1, sees=lambda _station, _time_s: Status.OK)
    assert hints.direction(2, ns(14.1)) is None


def test_without_set_up_targets_are_not_compared() -> None:
    """There is no layout, and the measurements are recorded nevertheless."""
    scene = stationary_scene()
    hints = ReacquisitionHints(replace(scene.parameters, prisms=(), no_poses="no layout"))
    watch(hints, scene)
    assert hints.direction(2, ns(12.5)) is None


def test_driving_robot_is_no_other_robot() -> None:
    """Stations measure at different times, and the robot turns."""
    scene = stationary_scene().moving(driving)
    hints = ReacquisitionHints(scene.parameters)
    watch(hints, scene, until_s=20.0, sees=lambda _station, _time_s: Status.OK)
    assert all(hints.direction(station, ns(20.0)) is None for station in (1, 2, 3))


def test_late_measurements_are_ordered_by_time() -> None:
    """One from before the loss changes nothing; one from within it shows that the prism was there."""
    scene = stationary_scene()
    before, within = ReacquisitionHints(scene.parameters), ReacquisitionHints(scene.parameters)
    for hints in (before, within):
        watch(hints, scene)
    before.measured(scene.measure(2, 9.0))
    within.measured(scene.measure(2, 11.5))
    assert before.direction(2, ns(12.6)) is not None
    assert within.direction(2, ns(12.6)) is None
    for hints in (before, within):
        watch(hints, scene, since_s=12.5, until_s=13.5)
    assert within.direction(2, ns(13.6)) is not None


def test_unknown_station_and_future_measurement_are_ignored() -> None:
    """Unknown station and future measurement are ignored."""
    scene = stationary_scene()
    hints = ReacquisitionHints(scene.parameters)
    hints.measured(replace(scene.measure(1, 1.0), station=9))
    tomorrow = replace(scene.measure(2, 1.0), stamp_ns=ns(86_400.0))
    hints.measured(tomorrow)
    watch(hints, scene)
    towards = hints.direction(2, ns(12.5))
    assert towards is not None
