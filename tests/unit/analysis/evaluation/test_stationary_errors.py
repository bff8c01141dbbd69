from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tsgt.analysis.evaluation import Reference, stationary_errors
from tsgt.estimation import Kind, PoseBatch, Reason

START_NS = 1_700_000_000_000_000_000
SECOND_NS = 1_000_000_000
CENTROID_M = np.array([0.2, 0.0, 1.0])


def stationary_robot(count: int = 401, period_ns: int = 50_000_000) -> tuple[PoseBatch, Reference]:
    """Return twenty seconds at 20 Hz at one place, without errors."""
    stamps = START_NS + np.arange(count, dtype=np.int64) * period_ns
    batch = PoseBatch.blank(stamps, (1, 2, 3), Kind.SMOOTHED)
    batch.position_m[:] = (5.0, -3.0, 0.5)
    batch.orientation_xyzw[:] = Rotation.from_euler("z", 0.4).as_quat()
    return batch, Reference(stamps, batch.position_m.copy(), batch.orientation_xyzw.copy())


def test_noise_averages_out_and_offsets_remain() -> None:
    """Per interval: alternating 10 mm in the first give 0, a constant 3 mm and 1 degree in the second remain."""
    poses, truth = stationary_robot()
    poses.position_m[:100:2, 0] += 0.010
    poses.position_m[1:100:2, 0] -= 0.010
    poses.position_m[200:, 1] += 0.003
    poses.orientation_xyzw[200:] = Rotation.from_euler("z", 0.4 + math.radians(1.0)).as_quat()
    stops = [(START_NS, START_NS + 4_950_000_000), (START_NS + 10 * SECOND_NS, START_NS + 20 * SECOND_NS)]
    found = stationary_errors(poses, truth, stops, CENTROID_M)
    np.testing.assert_allclose(found.position_m, [0.0, 0.003], atol=1e-9)
    turn, true_turn = Rotation.from_euler("z", 0.4 + math.radians(1.0)), Rotation.from_euler("z", 0.4)
    at_centroid = turn.apply(CENTROID_M) - true_turn.apply(CENTROID_M) + [0.0, 0.003, 0.0]
    np.testing.assert_allclose(found.centroid_m, [0.0, float(np.linalg.norm(at_centroid))], atol=1e-9)
    np.testing.assert_allclose(np.degrees(found.rotation_rad), [0.0, 1.0], atol=1e-6)
    figures = found.statistics()
    assert figures.stops == 2
    assert figures.position_max_mm == pytest.approx(3.0)
    assert figures.position_mean_mm == pytest.approx(1.5)
    assert figures.rotation_mean_deg == pytest.approx(0.5)


def test_only_instants_with_valid_poses_are_compared() -> None:
    """Of a slowly moving robot: where poses are invalid, the truth does not count either."""
    poses, truth = stationary_robot()
    drift = np.linspace(0.0, 0.02, 401)
    poses.position_m[:, 0] += drift
    truth.position_m[:, 0] += drift
    poses.reason[200:] = Reason.OUTAGE
    found = stationary_errors(poses, truth, [(START_NS, START_NS + 20 * SECOND_NS)], CENTROID_M)
    np.testing.assert_allclose(found.position_m, [0.0], atol=1e-9)


@pytest.mark.parametrize("rate_hz", [5, 20, 100])
def test_a_second_of_poses_counts_at_any_rate(rate_hz: int) -> None:
    """Whatever the number of poses in it."""
    poses, truth = stationary_robot(4 * rate_hz, SECOND_NS // rate_hz)
    last_ns = SECOND_NS - SECOND_NS // rate_hz
    for until_ns, stops in ((last_ns, 1), (last_ns - SECOND_NS // rate_hz, 0)):
        found = stationary_errors(poses, truth, [(START_NS, START_NS + until_ns)], CENTROID_M)
        assert len(found.position_m) == stops


def test_intervals_with_less_than_a_second_of_poses_are_ignored() -> None:
    """Without any interval the statistics are NaN."""
    poses, truth = stationary_robot()
    poses.reason[200:] = Reason.OUTAGE
    stops = [(START_NS, START_NS + 900_000_000), (START_NS + 12 * SECOND_NS, START_NS + 20 * SECOND_NS)]
    found = stationary_errors(poses, truth, stops, CENTROID_M).statistics()
    assert found.stops == 0
    assert math.isnan(found.position_mean_mm)
