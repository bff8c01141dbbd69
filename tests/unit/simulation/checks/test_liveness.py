"""What must work again after faults."""

from __future__ import annotations

import pytest

from tsgt.simulation.checks.liveness import follows_another, pose_share
from tsgt.simulation.instrument.model import ReportedDistance
from tsgt.simulation.mission import StationLog


def test_poses_are_expected_unless_a_needed_imu_is_knocked_or_contradicted() -> None:
    """Three stations go on alone; fewer have nothing to go on with."""
    assert pose_share("superframe", stations=3, knocked=True, contradicted=False) == 0.6
    assert pose_share("superframe", stations=2, knocked=False, contradicted=False) == 0.6
    assert pose_share("classic", stations=1, knocked=False, contradicted=False) == 0.35
    assert pose_share("superframe", stations=2, knocked=True, contradicted=False) == 0.0
    assert pose_share("superframe", stations=2, knocked=False, contradicted=True) == 0.0
    assert pose_share("superframe", stations=3, knocked=False, contradicted=True) == 0.6


@pytest.mark.parametrize(("prism", "at_s", "expected"), [(2, 12.0, True), (2, 20.0, False), (1, 12.0, False)])
def test_station_on_another_prism_is_known(prism: int, at_s: float, *, expected: bool) -> None:
    """Its measurements contradict the IMU as those of a tripod that has moved."""
    reported = ReportedDistance(0, 10_000_000_000, 0.0, 1.5, 50.0, prism, 0)
    log = StationLog(station=1, folder=None, reported_distances=[reported])
    assert follows_another(log, 1, at_s) is expected
