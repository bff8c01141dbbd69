from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tsgt.analysis.evaluation import Reference, stationary_errors
from tsgt.estimation import Kind, PoseBatch, Reason

START_NS = 1_700_000_000_000_000_000
SECOND_NS = 1_000_000_000
POINT_M = np.array([0.0, 0.0, 1.0])


def stood(count: int = 401) -> tuple[PoseBatch, Reference]:
    """Twenty seconds at 20 Hz in one place, without an error."""
    stamps = START_NS + np.arange(count, dtype=np.int64) * 50_000_000
    batch = PoseBatch.blank(stamps, (1, 2, 3), Kind.SMOOTHED)
    batch.position_m[:] = (5.0, -3.0, 0.5)
    batch.orientation_xyzw[:] = Rotation.from_euler("z", 0.4).as_quat()
    return batch, Reference(stamps, batch.position_m.copy(), batch.orientation_xyzw.copy())


def test_noise_averages_out_and_an_offset_stays() -> None:
    """Each stop counts for itself: 10 mm to and fro in the first are nothing, 3 mm and 1 degree in the second are that."""
    poses, truth = stood()
    poses.position_m[:100:2, 0] += 0.010
    poses.position_m[1:100:2, 0] -= 0.010
    poses.position_m[200:, 1] += 0.003
    poses.orientation_xyzw[200:] = Rotation.from_euler("z", 0.4 + math.radians(1.0)).as_quat()
    stops = [(START_NS, START_NS + 4_950_000_000), (START_NS + 10 * SECOND_NS, START_NS + 20 * SECOND_NS)]
    found = stationary_errors(poses, truth, stops, POINT_M)
    np.testing.assert_allclose(found.position_m, [0.0, 0.003], atol=1e-9)
    np.testing.assert_allclose(np.degrees(found.rotation_rad), [0.0, 1.0], atol=1e-6)
    figures = found.statistics()
    assert figures.stops == 2
    assert figures.position_max_mm == pytest.approx(3.0)
    assert figures.position_mean_mm == pytest.approx(1.5)
    assert figures.rotation_mean_deg == pytest.approx(0.5)


def test_a_robot_that_creeps_is_compared_with_where_it_was() -> None:
    """Half of the stop without valid poses: the truth of that half does not count either."""
    poses, truth = stood()
    drift = np.linspace(0.0, 0.02, 401)
    poses.position_m[:, 0] += drift
    truth.position_m[:, 0] += drift
    poses.reason[200:] = Reason.OUTAGE
    found = stationary_errors(poses, truth, [(START_NS, START_NS + 20 * SECOND_NS)], POINT_M)
    np.testing.assert_allclose(found.position_m, [0.0], atol=1e-9)


def test_a_stop_of_less_than_a_second_is_none() -> None:
    """Nor is one without valid poses; without any stop there are no figures."""
    poses, truth = stood()
    poses.reason[200:] = Reason.OUTAGE
    stops = [(START_NS, START_NS + 900_000_000), (START_NS + 12 * SECOND_NS, START_NS + 20 * SECOND_NS)]
    found = stationary_errors(poses, truth, stops, POINT_M).statistics()
    assert found.stops == 0
    assert math.isnan(found.position_mean_mm)
