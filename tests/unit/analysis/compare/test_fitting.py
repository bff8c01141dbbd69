import dataclasses

import numpy as np
from harness.compared_drive import START_NS, reference, robot
from scipy.spatial.transform import Rotation

from tsgt.analysis.compare import (
    Estimate,
    FitSettings,
    FittedPart,
    Relation,
    fit,
)
from tsgt.geometry import FloatArray, invert, log_so3, quaternion_from_rotation, transform_from

EXTRINSIC = transform_from(
    Rotation.from_euler("xyz", [0.4, -1.0, 2.0]).as_matrix(), np.array([0.3, -0.2, 0.8])
)
FRAME = transform_from(Rotation.from_euler("xyz", [0.1, 0.2, -1.5]).as_matrix(), np.array([30.0, -5.0, 2.0]))
LEVEL_FRAME = transform_from(Rotation.from_euler("z", 2.5).as_matrix(), np.array([30.0, -5.0, 2.0]))
TRUE = Relation(offset_s=1.37, skew=0.0, T_point_sensor=EXTRINSIC, T_station1_frame=FRAME, scale=1.0)
EVERYTHING: frozenset[FittedPart] = frozenset({"offset", "extrinsic", "frame"})


def seen(time_s: FloatArray, relation: Relation, *, positions_only: bool = False) -> Estimate:
    """Return an estimate without errors, by hand from the drive; ``time_s`` is on the reference's clock."""
    T = invert(relation.T_station1_frame) @ robot(time_s) @ relation.T_point_sensor
    stamp_s = time_s[0] + (time_s - time_s[0]) / (1.0 + relation.skew) - relation.offset_s
    return Estimate(
        name="seen",
        stamp_ns=START_NS + np.rint(stamp_s * 1e9).astype(np.int64),
        position_m=T[:, :3, 3] / relation.scale,
        orientation_xyzw=None if positions_only else quaternion_from_rotation(T[:, :3, :3]),
        covariance=None,
    )


def difference(found: Relation, true: Relation) -> float:
    """Return the largest difference of two relations, in s, m, rad and 1."""
    T = invert(true.T_point_sensor) @ found.T_point_sensor
    F = invert(true.T_station1_frame) @ found.T_station1_frame
    return max(
        abs(found.offset_s - true.offset_s),
        abs(found.skew - true.skew),
        abs(found.scale - true.scale),
        *(float(np.abs(each[:3, 3]).max()) for each in (T, F)),
        *(float(np.abs(log_so3(each[:3, :3])).max()) for each in (T, F)),
    )


def noisy(estimate: Estimate, seed: int) -> Estimate:
    """Return it with white noise of 5 mm and 1 mrad."""
    rng = np.random.default_rng(seed)
    n = len(estimate.stamp_ns)
    turned = None
    if estimate.orientation_xyzw is not None:
        small = Rotation.from_rotvec(rng.normal(0.0, 1e-3, (n, 3)))
        turned = (Rotation.from_quat(estimate.orientation_xyzw) * small).as_quat()
    position = estimate.position_m + rng.normal(0.0, 5e-3, (n, 3))
    return dataclasses.replace(estimate, position_m=position, orientation_xyzw=turned)


def test_relation_without_noise_is_recovered() -> None:
    """Clock, six degrees of freedom of the sensor and six of the frame, from unknown values."""
    found = fit(
        reference(40.0, 0.01), seen(np.arange(3.0, 35.0, 0.1), TRUE), FitSettings(EVERYTHING, "rigid")
    )
    assert difference(found.relation, TRUE) < 2e-7
    assert found.unobservable == ()


def test_positions_alone_give_clock_lever_arm_and_frame() -> None:
    """The rotation of the sensor is named as unobservable, and stays as it was."""
    estimate = seen(np.arange(3.0, 35.0, 0.2), TRUE, positions_only=True)
    found = fit(reference(40.0, 0.01), estimate, FitSettings(EVERYTHING, "rigid"))
    arm_only = transform_from(np.eye(3), EXTRINSIC[:3, 3])
    assert difference(found.relation, dataclasses.replace(TRUE, T_point_sensor=arm_only)) < 1e-6
    assert found.unobservable == tuple(f"extrinsic_{axis}_rad" for axis in ("roll", "pitch", "yaw"))


def test_skew_and_scale_are_fitted_when_asked_for() -> None:
    """As of a camera on a clock of its own."""
    true = dataclasses.replace(TRUE, skew=1e-4, scale=0.4)
    settings = FitSettings(frozenset({"offset", "skew", "scale", "extrinsic", "frame"}), "rigid")
    found = fit(reference(40.0, 0.01), seen(np.arange(3.0, 35.0, 0.1), true), settings)
    assert difference(found.relation, true) < 2e-6
