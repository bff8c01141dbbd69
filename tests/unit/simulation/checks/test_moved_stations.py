"""What stations that have moved show, and the event that has to say so."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from harness.files.records import PARAMETERS, SECOND, START, measurement

from tsgt.geometry import exp_so3, transform_from
from tsgt.recording import EventRecord
from tsgt.simulation.checks.poses.apparent import apparent_poses, misfit_tolerances
from tsgt.simulation.checks.poses.layout_events import WITHIN_S, layout_failures
from tsgt.simulation.checks.setup_lines import setup_failures
from tsgt.simulation.mission import StationMove

DURATION_S = 120


def _frame(x_m: float, heading_rad: float = 0.0) -> Any:
    T = transform_from(exp_so3(np.array([0.0, 0.0, heading_rad])), np.array([x_m, 0.0, 0.0]))
    return tuple(map(tuple, T.tolist()))


def _still(at_s: Any) -> Any:
    """Return poses of a robot that stands 20 m away."""
    return np.tile(transform_from(np.eye(3), np.array([20.0, 0.0, 0.0])), (len(at_s), 1, 1))


def _mission(*moves: StationMove, events: tuple[tuple[float, str], ...] = (), parameters: Any = None) -> Any:
    """Return log and result of two minutes with measurements at 2.5 Hz."""
    measured = [
        replace(
            measurement(count),
            station=n,
            prism=n,
            stamp_ns=(at := START + count * 400_000_000),
            received_ns=at,
        )
        for count in range(DURATION_S * 5 // 2)
        for n in (1, 2, 3)
    ]
    log = SimpleNamespace(
        unix_at_zero_ns=START,
        parameters=parameters,
        measurements=measured,
        setups=(),
        events=[
            EventRecord(stamp_ns=START + round(at_s * SECOND), event=name, message="", station=2)
            for at_s, name in events
        ],
    )
    world = SimpleNamespace(pose_at=_still)
    return log, SimpleNamespace(parameters=PARAMETERS, moves=moves, true_poses=_still, world=world)


def test_stations_that_moved_as_one_show_another_pose() -> None:
    """All by 50 mm: the prisms appear 50 mm on the other side, without a misfit; before, and near the step, that is told."""
    log, result = _mission(*(StationMove(n, 60.0, _frame(0.05)) for n in (1, 2, 3)))
    at_s = np.array([10.0, 58.0, 62.0, 100.0])
    apparent = apparent_poses(result, log, at_s)
    assert apparent.T_station1_robot[:, 0, 3] == pytest.approx([20.0, 20.0, 19.95, 19.95])
    assert apparent.misfit_m == pytest.approx(0.0, abs=1e-9)
    assert apparent.step_m == pytest.approx([0.0, 0.05, 0.05, 0.0], abs=1e-9)


def test_single_station_that_turned_distorts_the_triangle() -> None:
    """By a third of a milliradian over 20 m; the tolerance of rotation is larger by the short side of the layout."""
    log, result = _mission(StationMove(2, 0.0, _frame(0.0, 1e-3)))
    apparent = apparent_poses(result, log, np.array([10.0]))
    assert 0.002 < apparent.misfit_m[0] < 0.020
    (by_m, by_rad), *_ = misfit_tolerances(result, apparent)
    assert by_m == apparent.misfit_m[0]
    assert by_rad > 2 * by_m


def test_frames_in_force_are_those_of_the_master() -> None:
    """One that knows the new frame shows the truth; its published set-up has that frame, not the old one."""
    moved = replace(PARAMETERS.stations[1], T_station1_station=_frame(0.5))
    calibrated = replace(PARAMETERS, stations=(PARAMETERS.stations[0], moved, PARAMETERS.stations[2]))
    log, result = _mission(StationMove(2, 10.0, _frame(0.5)), parameters=calibrated)
    apparent = apparent_poses(result, log, np.array([50.0]))
    assert apparent.T_station1_robot[0] == pytest.approx(_still([0])[0])
    log.setups = [
        SimpleNamespace(
            stations=[
                SimpleNamespace(id=2, orientation_xyzw=(0.0, 0.0, 0.0, 1.0), position_m=(0.5, 0.0, 0.0))
            ],
            prisms=(),
        )
    ]
    assert not list(setup_failures(log, result))
    log.parameters = None
    assert len(list(setup_failures(log, result))) == 1


@pytest.mark.parametrize(
    ("turn_rad", "events", "count"),
    [
        (0.0001, (), 0),  # the monitor does not promise it
        (0.005, (), 1),
        (0.005, ((55.0, "layout_residual_high"),), 0),
        (0.005, ((80.0, "layout_residual_high"),), 1),  # too late
        (
            0.005,
            ((55.0, "layout_residual_high"), (60.0, "layout_residual_normal")),
            1,
        ),  # it still does not fit
    ],
)
def test_distorted_triangle_has_to_be_reported(
    turn_rad: float, events: tuple[tuple[float, str], ...], count: int
) -> None:
    """Within half a minute, and as long as it lasts."""
    log, result = _mission(StationMove(2, 40.0, _frame(0.0, turn_rad)), events=events)
    found = list(layout_failures(log, result))
    assert len(found) == count
    assert not count or f"{WITHIN_S:g} s" in found[0]
