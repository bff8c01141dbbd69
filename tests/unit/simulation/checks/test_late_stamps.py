"""What stamps of a slow instrument add to the errors of poses."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from harness.files.records import measurement

from tsgt.model import Status
from tsgt.simulation.checks.poses.late_stamps import LATE_S, extrapolated_s, late_stamp_tolerances
from tsgt.simulation.instrument import ReportedDistance

SPEED_MPS = 1.5


def _poses(at_s: np.ndarray) -> np.ndarray:
    found = np.tile(np.eye(4), (len(at_s), 1, 1))
    found[:, 0, 3] = SPEED_MPS * at_s
    return found


def _index(*begins_s: int, switched_on_s: int = 0) -> Any:
    """Return journals that begin at times of an instrument that is four times as slow from 60 s to 80 s."""
    reported = [
        ReportedDistance(
            instrument_ms=1000 * (time_s - (switched_on_s if time_s >= switched_on_s else 0)),
            true_ns=time_s * 1_000_000_000,
            horizontal_angle_rad=0.0,
            zenith_angle_rad=1.5,
            distance_m=10.0,
            prism=1,
            code=0,
            slowed_by=4.0 if 60 <= time_s < 80 else 1.0,
        )
        for time_s in range(120)
    ]
    return SimpleNamespace(
        station_log=SimpleNamespace(reported_distances=reported),
        journalled_by_start=[[begin_s, begin_s + 1] for begin_s in begins_s],
        true_ns=lambda time_s: time_s * 1_000_000_000,
    )


@pytest.mark.parametrize(
    ("begins_s", "late"),
    [((5,), [0, 0, 0]), ((5, 70), [0, 1, 1]), ((5, 70, 90), [0, 1, 0]), ((5, 90), [0, 0, 0])],
)
def test_only_a_client_that_began_while_the_instrument_was_slow_is_late(
    begins_s: tuple[int, ...], late: list[int]
) -> None:
    """By the way that the robot drives meanwhile, until the client is restarted."""
    prism = SimpleNamespace(position_m=(0.1, 0.2, 1.0))
    result: Any = SimpleNamespace(parameters=SimpleNamespace(prisms=[prism]), true_poses=_poses)
    found = late_stamp_tolerances(result, [_index(*begins_s)], np.array([50.0, 75.0, 100.0]))
    np.testing.assert_allclose(found[:, 0], 3.0 * LATE_S * SPEED_MPS * np.array(late), atol=1e-9)
    np.testing.assert_allclose(found[:, 1], 0.0, atol=1e-9)


@pytest.mark.parametrize(("switched_on_s", "late"), [(40, [0, 0, 0]), (70, [0, 1, 1]), (90, [0, 0, 0])])
def test_instrument_that_was_switched_on_while_it_was_slow_is_late(
    switched_on_s: int, late: list[int]
) -> None:
    """Nothing is known of its responses from before."""
    prism = SimpleNamespace(position_m=(0.1, 0.2, 1.0))
    result: Any = SimpleNamespace(parameters=SimpleNamespace(prisms=[prism]), true_poses=_poses)
    index = _index(5, switched_on_s=switched_on_s)
    found = late_stamp_tolerances(result, [index], np.array([50.0, 75.0, 100.0]))
    np.testing.assert_allclose(found[:, 0], 3.0 * LATE_S * SPEED_MPS * np.array(late), atol=1e-9)


def test_robot_that_has_slowed_down_was_measured_while_it_was_fast() -> None:
    """Its poses rest on measurements of the last two seconds."""
    prism = SimpleNamespace(position_m=(0.1, 0.2, 1.0))

    def stops_at_70_s(at_s: np.ndarray) -> np.ndarray:
        return _poses(np.minimum(at_s, 70.0))

    result: Any = SimpleNamespace(parameters=SimpleNamespace(prisms=[prism]), true_poses=stops_at_70_s)
    found = late_stamp_tolerances(result, [_index(5, 65)], np.array([69.0, 71.5, 73.0]))[:, 0]
    np.testing.assert_allclose(found, 3.0 * LATE_S * SPEED_MPS * np.array([1.0, 1.0, 0.0]), atol=1e-9)


def test_prism_that_was_unmeasured_longest_when_a_pose_was_published() -> None:
    """By what had arrived before it; an unusable measurement, or a station without any yet, says nothing."""
    measured = [
        replace(measurement(0), station=station, stamp_ns=round(1e9 * at_s), status=status)
        for station, at_s, status in [
            (1, 10.0, Status.OK),
            (2, 9.4, Status.OK),
            (2, 10.1, Status.NO_TARGET),
            (1, 10.4, Status.OK),
            (2, 10.3, Status.OK),
        ]
    ]
    poses: Any = SimpleNamespace(measurements_before=np.array([0, 1, 3, 4, 5, 5]))
    at_s = np.array([10.2, 10.2, 10.2, 10.5, 10.5, 10.0])
    found = extrapolated_s(poses, measured, at_s, 0)
    np.testing.assert_allclose(found, [0.0, 0.2, 0.8, 1.1, 0.2, 0.0], atol=1e-9)
