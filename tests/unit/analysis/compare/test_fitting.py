import dataclasses

import numpy as np
import pytest
from harness.drives.compared_drive import START_NS, long_reference, reference, robot
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from tsgt.analysis.compare import (
    Estimate,
    ExtrinsicPrior,
    FitSettings,
    FittedPart,
    ReferencePoses,
    Relation,
    compare_estimate,
    fit,
    nested_fits,
    overlap_s,
    pair,
)
from tsgt.geometry import (
    FloatArray,
    align,
    covariance_over_lever_arm,
    exp_so3,
    invert,
    log_so3,
    quaternion_from_rotation,
    transform_from,
)

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


def carried(made: ReferencePoses, sensor: FloatArray) -> Estimate:
    """Return an estimate without errors from poses of the sensor at the instants of the reference, (N, 4, 4), every other one."""
    rows = slice(20, -20, 2)
    orientation = quaternion_from_rotation(sensor[rows, :3, :3])
    return Estimate("carried", made.stamp_ns[rows], sensor[rows, :3, 3], orientation, None)


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


@pytest.mark.parametrize("offset_s", [-47.3, 0.0, 2.1])
def test_seconds_of_offset_are_found(offset_s: float) -> None:
    """From motion alone; the estimate covers a part of the reference, with a dropout."""
    time_s = np.concatenate([np.arange(62.0, 80.0, 0.1), np.arange(84.0, 110.0, 0.1)])
    true = dataclasses.replace(TRUE, offset_s=offset_s)
    found = fit(long_reference(), noisy(seen(time_s, true), 1), FitSettings(EVERYTHING, "rigid"))
    assert abs(found.relation.offset_s - offset_s) < 0.002


def test_offset_beyond_the_search_is_refused() -> None:
    """It is named where the motion shows it; nothing is fitted to what agrees by chance."""
    true = dataclasses.replace(TRUE, offset_s=-70.0)
    settings = FitSettings(EVERYTHING, "rigid", max_offset_s=40.0)
    with pytest.raises(ValueError, match=r"offset of -70.0 s .* more than the 40 s that are searched"):
        fit(long_reference(), noisy(seen(np.arange(5.0, 115.0, 0.1), true), 1), settings)
    with pytest.raises(ValueError, match=r"at no time offset within 5 s|that are searched"):
        fit(long_reference(), noisy(seen(np.arange(40.0, 80.0, 0.1), true), 1), replaced(settings, 5.0))


def laps_of_30_s() -> tuple[ReferencePoses, Estimate]:
    """Return a motion that repeats itself."""
    made = long_reference()
    phase = 2 * np.pi * np.arange(len(made.stamp_ns)) / 600
    path = np.stack([8 * np.sin(phase), 6 * np.cos(2 * phase), 0 * phase], axis=1)
    laps = dataclasses.replace(made, T_station1_point=transform_from(np.eye(3), path))
    return laps, Estimate("laps", made.stamp_ns[800:1400:2], path[800:1400:2], None, None)


def test_offset_of_a_motion_that_repeats_itself_is_refused() -> None:
    """Any of the laps may be meant; the search can be narrowed."""
    laps, estimate = laps_of_30_s()
    settings = FitSettings(EVERYTHING, "rigid")
    with pytest.raises(ValueError, match="about as well at a time offset of"):
        fit(laps, estimate, settings)
    assert abs(fit(laps, estimate, replaced(settings, 5.0)).relation.offset_s) < 0.01


def test_offset_that_is_not_asked_for_need_not_be_found() -> None:
    """Clocks that are known: a note says that the motion does not confirm them."""
    found = compare_estimate(*laps_of_30_s(), FitSettings(frozenset(), "none"))
    assert found.errors.ate.errors.position_mm.rms < 1e-6
    assert all("offset" not in each.settings.parts for each in found.steps)
    assert any("at the times of its stamps, but" in each for each in found.warnings)


def test_aligned_robot_at_rest_is_turned_as_its_orientations_say() -> None:
    """Noise of its positions has no direction."""
    made = reference(40.0)
    rng = np.random.default_rng(6)
    still = transform_from(np.eye(3), rng.normal(0.0, 1e-4, (len(made.stamp_ns), 3)))
    seen_m = rng.normal(0.0, 3e-3, (len(made.stamp_ns), 3))
    turned = Rotation.from_euler("z", 0.7).as_matrix()
    orientation = np.tile(quaternion_from_rotation(turned), (len(seen_m), 1))
    estimate = Estimate("still", made.stamp_ns[20:-20], seen_m[20:-20], orientation[20:-20], None)
    for align_by in ("rigid", "yaw"):
        settings = FitSettings(EVERYTHING, align_by)
        found = fit(dataclasses.replace(made, T_station1_point=still), estimate, settings).relation
        np.testing.assert_allclose(found.T_station1_frame[:3, :3], turned.T, atol=1e-6)


def test_offset_of_a_robot_at_rest_is_unobservable() -> None:
    """It is named, and left as given; a difference of noises is no disagreement."""
    made = reference(40.0)
    still = transform_from(np.eye(3), np.random.default_rng(3).normal(0.0, 1e-4, (len(made.stamp_ns), 3)))
    rows = slice(20, 780, 2)
    estimate = Estimate(
        "still", made.stamp_ns[rows], still[rows, :3, 3], quaternion_from_rotation(still[rows, :3, :3]), None
    )
    found = fit(
        dataclasses.replace(made, T_station1_point=still), noisy(estimate, 4), FitSettings(align="start")
    )
    assert found.relation.offset_s == 0.0
    assert "offset_s" in found.unobservable


def replaced(settings: FitSettings, max_offset_s: float) -> FitSettings:
    """Return settings with another search."""
    return dataclasses.replace(settings, max_offset_s=max_offset_s)


def test_stated_sigmas_fit_the_errors() -> None:
    """Normalised errors of white noise, over a few draws: not far above 1, not far below."""
    normalised = []
    for seed in range(4):
        found = fit(
            reference(40.0),
            noisy(seen(np.arange(3.0, 35.0, 0.1), TRUE), seed),
            FitSettings(EVERYTHING, "rigid"),
        )
        arm = found.relation.T_point_sensor[:3, 3] - EXTRINSIC[:3, 3]
        errors = {
            "offset_s": found.relation.offset_s - TRUE.offset_s,
            "extrinsic_x_m": arm[0],
            "extrinsic_y_m": arm[1],
        }
        sigmas = np.sqrt(np.diag(found.covariance))
        normalised += [errors[name] / sigmas[found.names.index(name)] for name in errors]
    assert 0.3 < np.sqrt(np.mean(np.square(normalised))) < 1.7


def test_estimate_that_flies_away_does_not_move_offset_and_extrinsic() -> None:
    """Its last third accelerates away; those poses are not used."""
    time_s = np.arange(2.0, 38.0, 0.1)
    good = noisy(seen(time_s, TRUE), 2)
    away_m = 0.5 * np.maximum(time_s - 26.0, 0.0)[:, None] ** 2 * np.array([1.0, 0.5, 0.2])
    lost = dataclasses.replace(good, position_m=good.position_m + away_m)
    before, after = (fit(reference(40.0), each, FitSettings(EVERYTHING, "rigid")) for each in (good, lost))
    assert abs(after.relation.offset_s - TRUE.offset_s) < 0.003
    assert np.abs(after.relation.T_point_sensor[:3, 3] - EXTRINSIC[:3, 3]).max() < 0.03
    assert (
        np.abs(after.relation.T_station1_frame[:3, 3] - before.relation.T_station1_frame[:3, 3]).max() < 0.05
    )
    assert after.used[time_s < 25.5].mean() > 0.95
    assert after.used[time_s > 28.0].mean() < 0.05


def test_vertical_lever_arm_is_unobservable_on_level_ground() -> None:
    """It is named, and left at its prior."""
    made = reference(40.0)
    level = made.T_station1_point.copy()
    heading = np.arctan2(level[:, 1, 0], level[:, 0, 0])
    level[:, :3, :3] = exp_so3(heading[:, None] * np.array([0.0, 0.0, 1.0]))
    flat = dataclasses.replace(made, T_station1_point=level)
    sensor = level @ EXTRINSIC
    estimate = noisy(carried(made, sensor), 3)
    found = fit(flat, estimate, FitSettings(EVERYTHING, "rigid"))
    assert found.unobservable == ("extrinsic_z_m",)
    assert found.relation.T_point_sensor[2, 3] == 0.0
    prior = ExtrinsicPrior(
        transform_from(EXTRINSIC[:3, :3], np.array([0.0, 0.0, 0.75])), np.array([1.0] * 3 + [0.2] * 3)
    )
    known = fit(flat, estimate, FitSettings(EVERYTHING, "rigid", extrinsic_prior=prior))
    assert known.relation.T_point_sensor[2, 3] == 0.75


def test_what_a_smoother_takes_off_the_motion_does_not_bias_the_lever_arm() -> None:
    """The truth rocks by 16 mrad, and about the prisms by 8 mrad more than the reference, independently of it, as the covariance says."""
    made = reference(60.0)
    n, centroid_m = len(made.stamp_ns), np.array([0.0, 0.0, 1.2])
    heading = np.arctan2(made.T_station1_point[:, 1, 0], made.T_station1_point[:, 0, 0])
    known, missed = (exp_so3(size * rocking(n, seed)) for seed, size in ((1, 0.016), (2, 0.008)))
    smoothed = transform_from(
        known @ exp_so3(heading[:, None] * np.array([0.0, 0.0, 1.0])), made.T_station1_point[:, :3, 3]
    )
    arm_m = smoothed[:, :3, :3] @ centroid_m
    about_prisms_m = smoothed[:, :3, 3] + arm_m - (missed @ arm_m[:, :, None])[:, :, 0]
    T = transform_from(missed @ smoothed[:, :3, :3], about_prisms_m)[40:-40:2] @ EXTRINSIC
    estimate = Estimate("seen", made.stamp_ns[40:-40:2], T[:, :3, 3], None, None)
    covariance = covariance_over_lever_arm(np.tile(np.diag([1e-6] * 3 + [64e-6] * 3), (n, 1, 1)), -arm_m)
    found = fit(
        dataclasses.replace(made, T_station1_point=smoothed, covariance=covariance),
        noisy(estimate, 9),
        FitSettings(EVERYTHING, "rigid"),
    )
    assert abs(found.relation.T_point_sensor[2, 3] - EXTRINSIC[2, 3]) < 0.05


@pytest.mark.parametrize("height_m", [0.6, 2.0])
def test_noise_of_the_reference_does_not_tell_the_height_on_level_ground(height_m: float) -> None:
    """Its rotation jitters by 3 mrad, correlated over a fifth of a second, which is no motion of the robot."""
    made = reference(120.0)
    n = len(made.stamp_ns)
    heading = np.arctan2(made.T_station1_point[:, 1, 0], made.T_station1_point[:, 0, 0])
    level = transform_from(
        exp_so3(heading[:, None] * np.array([0.0, 0.0, 1.0])),
        made.T_station1_point[:, :3, 3] * [1.0, 1.0, 0.0],
    )
    extrinsic = EXTRINSIC.copy()
    extrinsic[2, 3] = height_m
    sensor = level @ extrinsic
    estimate = noisy(carried(made, sensor), 5)
    jittering = transform_from(level[:, :3, :3] @ exp_so3(0.003 * rocking(n, 4)), level[:, :3, 3])
    found = fit(
        dataclasses.replace(made, T_station1_point=jittering), estimate, FitSettings(EVERYTHING, "rigid")
    )
    assert "extrinsic_z_m" in found.unobservable
    assert found.relation.T_point_sensor[2, 3] == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_rotation_about_a_straight_line_of_travel_is_left_as_given(seed: int) -> None:
    """Nothing tells it, and the search for a first guess finds any."""
    made = reference(60.0)
    speed = 1.2 + 0.8 * rocking_slowly(len(made.stamp_ns), seed)
    way_m = np.cumsum(np.clip(speed, 0.0, 3.0)) * 0.05
    straight = transform_from(
        np.broadcast_to(exp_so3(np.array([0.0, 0.0, 0.3])), (len(way_m), 3, 3)),
        way_m[:, None] * np.array([np.cos(0.3), np.sin(0.3), 0.0]),
    )
    sensor = straight @ transform_from(np.eye(3), EXTRINSIC[:3, 3])
    estimate = noisy(carried(made, sensor), seed)
    found = fit(
        dataclasses.replace(made, T_station1_point=straight), estimate, FitSettings(EVERYTHING, "rigid")
    )
    assert "extrinsic_roll_rad" in found.unobservable
    assert np.abs(log_so3(found.relation.T_point_sensor[:3, :3])).max() < 0.01
    offset_sigma_s = float(np.sqrt(found.covariance[0, 0]))
    assert offset_sigma_s < 0.01


def rocking_slowly(n: int, seed: int) -> FloatArray:
    """Return a smooth random number of unit variance at 20 Hz, correlated over seconds, (N,)."""
    found = gaussian_filter1d(np.random.default_rng(seed).normal(size=n), 25.0)
    return np.asarray(found / found.std())


def rocking(n: int, seed: int) -> FloatArray:
    """Return smooth random numbers of unit variance at 20 Hz, correlated over half a second, (N, 3)."""
    found = gaussian_filter1d(np.random.default_rng(seed).normal(size=(n, 3)), 4.0, axis=0)
    return np.asarray(found / found.std(axis=0))


def test_extrinsic_known_exactly_stays() -> None:
    """A prior sigma of zero; it has no sigma of its own then."""
    prior = ExtrinsicPrior(EXTRINSIC, np.zeros(6))
    settings = FitSettings(EVERYTHING, "rigid", extrinsic_prior=prior)
    found = fit(reference(40.0), noisy(seen(np.arange(3.0, 35.0, 0.1), TRUE), 4), settings)
    np.testing.assert_allclose(found.relation.T_point_sensor, EXTRINSIC, atol=1e-15)
    assert not any(name.startswith("extrinsic") for name in found.names)
    assert abs(found.relation.offset_s - TRUE.offset_s) < 0.003


def test_yaw_alignment_keeps_the_estimate_level() -> None:
    """Four degrees of freedom are fitted and have sigmas."""
    true = dataclasses.replace(TRUE, T_station1_frame=LEVEL_FRAME)
    found = fit(
        reference(40.0), noisy(seen(np.arange(3.0, 35.0, 0.1), true), 5), FitSettings(EVERYTHING, "yaw")
    )
    np.testing.assert_allclose(found.relation.T_station1_frame[2, :3], [0.0, 0.0, 1.0], atol=1e-12)
    assert [n for n in found.names if n.startswith("frame")] == [
        "frame_x_m",
        "frame_y_m",
        "frame_z_m",
        "frame_yaw_rad",
    ]


def test_alignment_at_the_start_ignores_what_drifts_later() -> None:
    """The first five seconds agree, the end has the drift."""
    time_s = np.arange(3.0, 35.0, 0.1)
    exact = seen(time_s, TRUE)
    drift_m = 0.01 * (time_s - 3.0)[:, None] * (FRAME[:3, :3].T @ np.array([1.0, 0.0, 0.0]))
    estimate = dataclasses.replace(exact, position_m=exact.position_m + drift_m)
    found = fit(reference(40.0), estimate, FitSettings(EVERYTHING, "start"))
    paired = pair(reference(40.0), estimate, found.relation)
    error_m = (paired.estimated - paired.reference)[:, :3, 3]
    assert np.abs(error_m[:50].mean(axis=0)).max() < 0.002
    assert abs(error_m[-1, 0] - 0.294) < 0.01


def test_what_is_not_asked_for_keeps_its_value() -> None:
    """The offset is right all the same: the extrinsic is fitted with it, but not applied."""
    settings = FitSettings(frozenset({"offset", "frame"}), "start")
    found = fit(reference(40.0), noisy(seen(np.arange(3.0, 35.0, 0.1), TRUE), 6), settings)
    np.testing.assert_array_equal(found.relation.T_point_sensor, np.eye(4))
    assert abs(found.relation.offset_s - TRUE.offset_s) < 0.003
    assert found.relation.skew == 0.0
    assert found.relation.scale == 1.0


def test_nested_fits_show_what_each_part_hides() -> None:
    """The error does not grow from set to set once a frame is fitted."""
    estimate = noisy(seen(np.arange(3.0, 35.0, 0.1), TRUE), 7)
    settings = FitSettings(EVERYTHING | {"scale"}, "rigid")
    found = nested_fits(reference(40.0), estimate, settings)
    assert [(own.parts, own.align) for own, _ in found] == [
        (frozenset(), "none"),
        ({"offset"}, "none"),
        ({"offset", "frame"}, "start"),
        ({"offset", "frame", "extrinsic"}, "start"),
        ({"offset", "frame", "extrinsic"}, "rigid"),
        ({"offset", "frame", "extrinsic", "scale"}, "rigid"),
    ]
    rms_m = []
    for _, each in found[2:5]:
        paired = pair(reference(40.0), estimate, each.relation)
        rms_m.append(
            float(np.sqrt(((paired.estimated - paired.reference)[:, :3, 3] ** 2).sum(axis=1).mean()))
        )
    assert rms_m[0] > 1.0 > 0.05 > rms_m[1] > rms_m[2]


def test_uncertainty_of_the_offset_is_that_of_the_error() -> None:
    """Of an estimate with drift, the frame following: against alignments by singular values at shifted offsets."""
    time_s = np.arange(3.0, 35.0, 0.1)
    exact = seen(time_s, TRUE)
    drift_m = 0.02 * np.sqrt(time_s - 3.0)[:, None] * np.array([1.0, 0.5, 0.0])
    estimate = dataclasses.replace(exact, position_m=exact.position_m + drift_m)
    held = ExtrinsicPrior(EXTRINSIC, np.zeros(6))
    found = fit(reference(40.0), estimate, FitSettings(EVERYTHING, "rigid", extrinsic_prior=held))
    ate_m = []
    for shift_s in (-0.002, 0.002):
        shifted = dataclasses.replace(found.relation, offset_s=found.relation.offset_s + shift_s)
        paired = pair(reference(40.0), estimate, shifted)
        own, true = paired.estimated[:, :3, 3], paired.reference[:, :3, 3]
        aligned = align(own, true).T
        error_m = own @ aligned[:3, :3].T + aligned[:3, 3] - true
        ate_m.append(np.sqrt((error_m**2).sum(axis=1).mean()))
    slope = (ate_m[1] - ate_m[0]) / 0.004
    offset_sigma_s = np.sqrt(found.covariance[found.names.index("offset_s"), found.names.index("offset_s")])
    assert abs(slope) > 0.01
    assert found.ate_sigma_m == pytest.approx(abs(slope) * offset_sigma_s, rel=0.05)


def test_overlap_is_stated_in_seconds() -> None:
    """Negative: the time between them."""
    estimate = seen(np.arange(3.0, 13.05, 0.1), dataclasses.replace(TRUE, offset_s=0.0))
    assert overlap_s(reference(10.0), estimate) == pytest.approx(6.95)
    assert overlap_s(reference(10.0), estimate, offset_s=10.0) == pytest.approx(-3.05)


def test_too_little_of_the_estimate_is_refused() -> None:
    """A second of poses determines nothing."""
    estimate = seen(np.arange(3.0, 4.0, 0.1), dataclasses.replace(TRUE, offset_s=0.0))
    with pytest.raises(ValueError, match="at least 5 poses over 2 s"):
        fit(reference(10.0), estimate, FitSettings())
