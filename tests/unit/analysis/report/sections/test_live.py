from __future__ import annotations

import numpy as np

from tsgt.analysis.evaluation import LiveComparison, LivePoseErrors, LivePoses
from tsgt.analysis.report.sections.live import live_section


def test_kinds_and_ages_have_rows() -> None:
    """Each with its errors; a limit that is not known gives no share."""
    n = 4
    errors = LivePoseErrors(
        age_s=np.array([0.05, 0.05, 0.15, 0.15]),
        position_m=np.array([0.003, 0.004, 0.003, 0.004]),
        centroid_m=np.full(n, 0.002),
        rotation_rad=np.radians(np.full(n, 0.5)),
        nees=np.full(n, 6.0),
        position_nees=np.full(n, 3.0),
        rotation_nees=np.full(n, 3.0),
    )
    found = LiveComparison(
        "reference", {"predicted": LivePoses(5, n, errors.age_s, errors.statistics(0.0035, None))}
    )
    section = live_section(found, "the robot's origin")
    assert section is not None
    all_ages, by_age = section.tables
    assert all_ages.rows == (
        *(("predicted (for now)", "5", "80.0%", "3.5", "4.0", "2.0", "0.50", "6.0", "50.00%", "unknown"),),
    )
    assert [row[1:4] for row in by_age.rows] == [("0 to 100", "2", "3.5"), ("100 to 200", "2", "3.5")]
    assert "compared with the reference." in section.text[0]


def test_recording_without_streamed_poses_has_no_section() -> None:
    """An import has none."""
    assert live_section(None, "the robot's origin") is None
