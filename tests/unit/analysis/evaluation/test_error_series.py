from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tsgt.analysis.evaluation import Reference, error_components, pose_components
from tsgt.estimation import Kind, PoseBatch, Reason

COUNT = 200
STAMP_NS = 1_700_000_000_000_000_000 + 50_000_000 * np.arange(COUNT)
YAW = np.linspace(3.0, 3.4, COUNT)  # passes 180 degrees


def poses_with(errors: np.ndarray) -> tuple[PoseBatch, Reference]:
    """Return poses with errors (N, 6) in x, y, z, roll, pitch, yaw, and the truth: level, turning through 180 degrees."""
    position_m = np.stack([0.1 * np.arange(COUNT), np.zeros(COUNT), np.ones(COUNT)], axis=1)
    level = np.zeros(COUNT)
    truth = Reference(
        STAMP_NS, position_m, Rotation.from_euler("xyz", np.stack([level, level, YAW], axis=1)).as_quat()
    )
    batch = PoseBatch.blank(STAMP_NS, (1, 2, 3), Kind.SMOOTHED)
    batch.position_m[:] = position_m + errors[:, :3]
    angles = errors[:, 3:] + np.stack([level, level, YAW], axis=1)
    batch.orientation_xyzw[:] = Rotation.from_euler("xyz", angles).as_quat()
    batch.covariance[:] = np.diag([1.0, 4.0, 9.0, 1.0, 4.0, 9.0]) * 1e-6
    batch.covariance_common[:] = 0.25 * batch.covariance
    return batch, truth


def test_each_component_has_its_error_and_sigma() -> None:
    """Errors are in frame station1, angles as roll, pitch and yaw; yaw does not jump at 180 degrees."""
    given = np.tile([0.001, -0.002, 0.003, 0.004, -0.005, 0.006], (COUNT, 1))
    found = error_components(*poses_with(given))
    np.testing.assert_allclose(found.value, given[: len(found.value)], atol=1e-9)
    np.testing.assert_allclose(found.rms, np.abs(given[0]), atol=1e-9)
    np.testing.assert_allclose(found.sigma[:, :3], np.tile([0.001, 0.002, 0.003], (len(found.value), 1)))
    np.testing.assert_allclose(found.sigma_common, 0.5 * found.sigma)
    # Sigmas of roll and pitch are about the robot's heading: here nearly minus x, so nearly those about x and y.
    np.testing.assert_allclose(found.sigma[0, 3:], [0.001, 0.002, 0.003], rtol=0.1)


def test_share_within_two_sigmas_is_counted_by_component() -> None:
    """Half of x is three sigmas off, all of y within one, all of z beyond."""
    given = np.zeros((COUNT, 6))
    given[::2, 0], given[:, 1], given[:, 2] = 0.003, 0.002, 0.0061
    found = error_components(*poses_with(given))
    assert found.within_two_sigma.tolist() == pytest.approx([0.5, 1.0, 0.0, 1.0, 1.0, 1.0], abs=0.01)


def test_invalid_poses_are_unknown() -> None:
    """They are drawn as gaps, and not compared."""
    batch, truth = poses_with(np.zeros((COUNT, 6)))
    batch.reason[60:100] = int(Reason.OUTAGE)
    assert np.isnan(pose_components(batch).value[60:100]).all()
    assert np.isfinite(pose_components(batch).sigma[:60]).all()
    assert not np.isin(STAMP_NS[60:100], error_components(batch, truth).stamp_ns).any()
    batch.reason[:] = int(Reason.OUTAGE)
    nothing = error_components(batch, truth)
    assert np.isnan(nothing.rms).all()
    assert np.isnan(nothing.within_two_sigma).all()
