"""What must work again after faults."""

from __future__ import annotations

from tsgt.simulation.checks.liveness import pose_share


def test_poses_are_expected_unless_a_needed_imu_is_knocked_or_contradicted() -> None:
    """Three stations go on alone; fewer have nothing to go on with."""
    assert pose_share("superframe", stations=3, knocked=True, contradicted=False) == 0.6
    assert pose_share("superframe", stations=2, knocked=False, contradicted=False) == 0.6
    assert pose_share("classic", stations=1, knocked=False, contradicted=False) == 0.35
    assert pose_share("superframe", stations=2, knocked=True, contradicted=False) == 0.0
    assert pose_share("superframe", stations=2, knocked=False, contradicted=True) == 0.0
    assert pose_share("superframe", stations=3, knocked=False, contradicted=True) == 0.6
