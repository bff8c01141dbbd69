"""What must work again after faults."""

from __future__ import annotations

from tsgt.simulation.checks.liveness import pose_share


def test_poses_are_expected_but_of_a_knocked_imu_that_is_needed() -> None:
    """Three stations go on alone; fewer have nothing to go on with."""
    assert pose_share("superframe", stations=3, knocked=True) == 0.6
    assert pose_share("superframe", stations=2, knocked=False) == 0.6
    assert pose_share("classic", stations=1, knocked=False) == 0.35
    assert pose_share("superframe", stations=2, knocked=True) == 0.0
