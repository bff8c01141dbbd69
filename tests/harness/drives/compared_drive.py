"""A drive by formulas, its reference and an estimate without errors: for tests of `tsgt.analysis.compare`."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from tsgt.analysis.compare import Estimate, ReferencePoses
from tsgt.geometry import FloatArray, quaternion_from_rotation, transform_from
from tsgt.model import ROBOT_ORIGIN

START_NS = 1_700_000_000_000_000_000


def robot(time_s: FloatArray) -> FloatArray:
    """Return ``T_station1_robot`` of a robot that drives curves with changing speed, and rocks: (N, 4, 4)."""
    t = time_s
    heading = 1.3 * np.sin(0.3 * t) + 0.6 * np.sin(0.47 * t + 0.004 * t * t)
    position = np.stack(
        [8 * np.sin(0.2 * t), 6 * np.cos(0.31 * t + 0.0015 * t * t), 0.02 * np.sin(1.8 * t)], axis=1
    )
    angles = np.stack([0.03 * np.sin(2.0 * t), 0.03 * np.cos(1.7 * t), heading], axis=1)
    return transform_from(Rotation.from_euler("xyz", angles).as_matrix(), position)


def reference(duration_s: float = 10.0, step_s: float = 0.05) -> ReferencePoses:
    """Return the reference from :data:`START_NS` on, without covariance."""
    time_s = np.arange(0.0, duration_s, step_s)
    n = len(time_s)
    return ReferencePoses(
        stamp_ns=START_NS + np.rint(time_s * 1e9).astype(np.int64),
        T_station1_point=robot(time_s),
        covariance=None,
        covariance_common=None,
        valid=np.ones(n, dtype=np.bool_),
        point=ROBOT_ORIGIN,
    )


def estimate_at(time_s: FloatArray, **changes: object) -> Estimate:
    """Return an estimate of the robot itself."""
    T = robot(time_s)
    found = Estimate(
        name="exact",
        stamp_ns=START_NS + np.rint(time_s * 1e9).astype(np.int64),
        position_m=T[:, :3, 3],
        orientation_xyzw=quaternion_from_rotation(T[:, :3, :3]),
        covariance=None,
    )
    return dataclasses.replace(found, **changes)  # type: ignore[arg-type]


def long_reference() -> ReferencePoses:
    """Return two minutes; the drive does not repeat itself within them."""
    return reference(120.0)
