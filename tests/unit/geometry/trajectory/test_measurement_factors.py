"""Measurement factors: Jacobians against numerical derivatives, residuals against range and angles."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tsgt.geometry import cartesian_to_polar, invert, polar_to_cartesian, transform_from, transform_points
from tsgt.geometry.trajectory import STATE_DIM, Observations, States, linearise
from tsgt.geometry.trajectory.measurement_factors import line_of_sight_axes, squared_distances_at

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray

LAYOUT = np.array([[-0.4559, -0.1759, 1.1167], [0.4844, -0.1759, 1.4167], [-0.0285, 0.3519, 1.0667]])


def tumbling(rng: np.random.Generator) -> States:
    """States at two times in random attitude with large velocities and accelerations."""
    return States(
        np.array([0.0, 0.5]),
        rng.uniform(-30, 30, (2, 3)),
        Rotation.random(2, random_state=int(rng.integers(2**31))).as_matrix(),
        *rng.normal(scale=2.0, size=(4, 2, 3)),
    )


def test_measurements_exactly_at_knots_are_linearised_as_the_others() -> None:
    """To the last bit, whether or not another measurement is beside its knot."""
    rng = np.random.default_rng(4)
    knots = tumbling(rng)
    measured = observed(knots, rng)
    knot_index = np.arange(len(measured)) % 2
    at_knots = replace(measured, time_s=knots.time_s[knot_index])
    one_beside = replace(measured, time_s=at_knots.time_s + 0.1 * (np.arange(len(measured)) == 0))
    alone, together = linearise(at_knots, knots, knot_index), linearise(one_beside, knots, knot_index)
    for name in ("residuals_m", "jacobian", "by_point", "point_m", "velocity_mps", "rotation"):
        np.testing.assert_array_equal(getattr(alone, name)[1:], getattr(together, name)[1:])


def observed(
    knots: States, rng: np.random.Generator, *, count: int = 8, offset_s: float = 0.2
) -> Observations:
    """Measurements near both times with residuals of centimetres, from stations in random attitude."""
    at = rng.integers(0, len(knots), count)
    frames = transform_from(
        Rotation.random(3, random_state=int(rng.integers(2**31))).as_matrix(), rng.uniform(-50, 50, (3, 3))
    )
    station, prism = rng.integers(0, 3, count), rng.integers(0, 3, count)
    world = knots.position[at] + (knots.rotation[at] @ LAYOUT[prism][:, :, None])[:, :, 0]
    points = transform_points(invert(frames)[station], world) + rng.normal(scale=0.03, size=(count, 3))
    return Observations(
        time_s=knots.time_s[at] + rng.uniform(-offset_s, offset_s, count),
        time_sigma_s=np.full(count, 1e-3),
        points_m=points,
        sigmas_m=np.tile([0.002, 0.001, 0.001], (count, 1)),
        polar=rng.random(count) < 0.8,
        station=station,
        prism=prism,
        frames=frames,
        layout=LAYOUT,
    )


def knot_index(observations: Observations, knots: States) -> NDArray[np.intp]:
    """Knot that each measurement is attached to."""
    return np.asarray(np.argmin(np.abs(observations.time_s[:, None] - knots.time_s), axis=1), np.intp)


def seen_at(points: FloatArray) -> tuple[Observations, States]:
    """Stations that measured the only prism of a robot at these points, and the robot at the first."""
    count = len(points)
    zero = np.zeros((1, 3))
    knots = States(np.zeros(1), points[:1], np.eye(3)[None], zero, zero, zero, zero)
    observations = Observations(
        time_s=np.zeros(count),
        time_sigma_s=np.zeros(count),
        points_m=points,
        sigmas_m=np.ones((count, 3)),
        polar=np.ones(count, dtype=bool),
        station=np.zeros(count, dtype=np.intp),
        prism=np.zeros(count, dtype=np.intp),
        frames=np.eye(4)[None],
        layout=np.zeros((1, 3)),
    )
    return observations, knots


@settings(derandomize=True, max_examples=40)
@given(st.integers(0, 10**6))
@pytest.mark.slow
def test_jacobian_is_exact(seed: int) -> None:
    """For random attitudes, frames, time offsets and residuals the Jacobian equals central differences."""
    rng = np.random.default_rng(seed)
    knots = tumbling(rng)
    observations = observed(knots, rng)
    at = knot_index(observations, knots)
    found = linearise(observations, knots, at).jacobian
    step = 1e-5
    for part in range(STATE_DIM):
        error = np.zeros((2, STATE_DIM))
        error[:, part] = step
        forth, back = (
            linearise(observations, knots.retract(sign * error), at).residuals_m for sign in (1, -1)
        )
        np.testing.assert_allclose(found[:, :, part], (forth - back) / (2 * step), atol=3e-8)


@settings(derandomize=True, max_examples=40)
@given(st.integers(0, 10**6))
def test_distances_alone_are_those_of_whitened_residuals(seed: int) -> None:
    """Whatever the offsets from the knots, with time noise."""
    rng = np.random.default_rng(seed)
    knots = tumbling(rng)
    observations = observed(knots, rng, offset_s=rng.choice([0.0, 0.2]))
    at = knot_index(observations, knots)
    residuals = linearise(observations, knots, at).whitened(observations)[:, :, -1]
    np.testing.assert_allclose(
        squared_distances_at(observations, knots, at), (residuals**2).sum(axis=1), rtol=1e-9
    )


@settings(derandomize=True, max_examples=40)
@given(st.integers(0, 10**6))
def test_prism_velocity_is_the_derivative_of_its_position(seed: int) -> None:
    """Position and rotation are the robot's at the time of the measurement."""
    rng = np.random.default_rng(seed)
    knots = tumbling(rng)
    observations = observed(knots, rng)
    at = knot_index(observations, knots)
    step = 1e-5
    here = linearise(observations, knots, at)
    later, earlier = (
        linearise(replace(observations, time_s=observations.time_s + sign * step), knots, at).point_m
        for sign in (1, -1)
    )
    delta_s = (observations.time_s - knots.time_s[at])[:, None]
    turn = knots.angular_velocity[at] * delta_s + knots.angular_acceleration[at] * delta_s**2 / 2
    expected = knots.rotation[at] @ Rotation.from_rotvec(turn).as_matrix()
    np.testing.assert_allclose(here.rotation, expected, atol=1e-12)
    # The turn's vector is what is carried on; the axis wanders a little within it.
    slack = np.linalg.norm(np.cross(knots.angular_velocity[at], knots.angular_acceleration[at]), axis=1)
    slack = slack * np.ravel(delta_s) ** 2 * 1.5 * (1 + np.linalg.norm(turn, axis=1)) + 1e-7
    assert np.all(np.linalg.norm(here.velocity_mps - (later - earlier) / (2 * step), axis=1) < slack)


@settings(derandomize=True, max_examples=40)
@given(st.floats(0.01, 6.27), st.floats(0.05, 3.09), st.floats(2.0, 300.0), st.integers(0, 2))
def test_residuals_are_those_of_range_and_angles(
    around: float, zenith: float, distance_m: float, part: int
) -> None:
    """A prism farther, to the right or lower than measured has that residual as a length."""
    polar = np.array([distance_m, around, zenith])
    lengths = np.array([1.0, distance_m * np.sin(zenith), distance_m])
    moved = polar.copy()
    moved[part] += 1e-6 / lengths[part]
    measured, there = (polar_to_cartesian(h, z, d) for d, h, z in (polar, moved))
    observations, _ = seen_at(measured[None])
    zero = np.zeros((1, 3))
    knots = States(np.zeros(1), there[None], np.eye(3)[None], zero, zero, zero, zero)
    residuals = linearise(observations, knots, np.zeros(1, np.intp)).residuals_m[0]
    expected = np.zeros(3)
    expected[part] = 1e-6
    np.testing.assert_allclose(residuals, expected, atol=1e-11)


@pytest.mark.parametrize("zenith_rad", [0.0, 1e-9, 1e-3, np.pi - 1e-9, np.pi])
def test_vertical_line_of_sight_is_no_special_case(zenith_rad: float) -> None:
    """A prism overhead or underfoot has finite residuals of the right length and an exact Jacobian."""
    measured = polar_to_cartesian(0.3, zenith_rad, 20.0)
    observations, knots = seen_at(measured[None])
    miss = np.array([[0.001, -0.002, 0.003]])
    error = np.zeros((1, STATE_DIM))
    error[:, :3] = miss
    found = linearise(observations, knots.retract(error), np.zeros(1, np.intp))
    assert np.linalg.norm(found.residuals_m) == pytest.approx(np.linalg.norm(miss), rel=1e-3)
    assert abs(found.residuals_m[0, 0]) == pytest.approx(0.003, rel=2e-2)
    np.testing.assert_allclose(found.by_point[0] @ found.by_point[0].T, np.eye(3), atol=1e-3)


def test_second_face_is_the_same_measurement() -> None:
    """Second-face angles give the residuals and Jacobian of the first face."""
    first = np.array(polar_to_cartesian(1.2, 1.4, 50.0))
    second = np.array(polar_to_cartesian(1.2 + np.pi, 2 * np.pi - 1.4, 50.0))
    observations, knots = seen_at(np.array([first, second]))
    error = np.zeros((1, STATE_DIM))
    error[:, :3] = 0.01
    found = linearise(observations, knots.retract(error), np.zeros(2, np.intp))
    np.testing.assert_allclose(found.residuals_m[1], found.residuals_m[0], atol=1e-12)
    np.testing.assert_allclose(found.jacobian[1], found.jacobian[0], atol=1e-12)


@settings(derandomize=True, max_examples=40)
@given(st.integers(0, 10**6))
def test_line_of_sight_axes_are_the_angle_gradients(seed: int) -> None:
    """Orthonormal axes in the directions of growing range and angles."""
    points = np.random.default_rng(seed).uniform(-50, 50, (5, 3))
    axes, distance_m = line_of_sight_axes(points)
    np.testing.assert_allclose(
        axes @ np.swapaxes(axes, 1, 2), np.broadcast_to(np.eye(3), (5, 3, 3)), atol=1e-14
    )
    around, zenith, distance = cartesian_to_polar(points)
    np.testing.assert_allclose(distance_m, distance)
    step = 1e-6
    for row, (dh, dz) in ((1, (step, 0.0)), (2, (0.0, step))):
        moved = polar_to_cartesian(around + dh, zenith + dz, distance) - polar_to_cartesian(
            around - dh, zenith - dz, distance
        )
        np.testing.assert_allclose(axes[:, row], moved / np.linalg.norm(moved, axis=1)[:, None], atol=1e-8)


@pytest.mark.parametrize("measured_m", [0.0, 1e-200, 20.0])
@pytest.mark.parametrize("predicted_m", [0.0, 1e-200, 20.0])
def test_zero_distance_has_finite_residuals(measured_m: float, predicted_m: float) -> None:
    """A distance that the prism constant makes zero gives finite residuals, not NaN."""
    observations, knots = seen_at(np.array([[measured_m, 0.0, 0.0]]))
    there = replace(knots, position=np.array([[predicted_m, 0.0, 0.0]]))
    found = linearise(observations, there, np.zeros(1, np.intp))
    np.testing.assert_allclose(found.residuals_m, [[predicted_m - measured_m, 0.0, 0.0]], atol=1e-12)
    assert np.isfinite(found.whitened(observations)).all()


def test_time_noise_acts_along_the_velocity() -> None:
    """A time sigma of 10 ms makes a prism at 2 m/s uncertain by 20 mm along its velocity only."""
    observations, knots = seen_at(np.array([[40.0, 0.0, 0.0]]))
    observations = replace(
        observations, time_sigma_s=np.array([0.01]), sigmas_m=np.array([[0.002, 0.001, 0.001]])
    )
    moving = replace(knots, velocity=np.array([[0.0, 2.0, 0.0]]))
    covariance = linearise(observations, moving, np.zeros(1, np.intp)).covariance(observations)[0]
    # Seen along x, y is across: horizontal angles grow against it.
    np.testing.assert_allclose(covariance, np.diag([0.002**2, 0.001**2 + 0.02**2, 0.001**2]), atol=1e-15)


def test_cartesian_residuals_are_coordinate_differences() -> None:
    """Cartesian residuals are differences in the station frame."""
    rng = np.random.default_rng(3)
    knots = tumbling(rng)
    observations = replace(observed(knots, rng, offset_s=0.0), polar=np.zeros(8, dtype=bool))
    found = linearise(observations, knots, knot_index(observations, knots))
    expected = (
        transform_points(invert(observations.frames)[observations.station], found.point_m)
        - observations.points_m
    )
    np.testing.assert_allclose(found.residuals_m, expected, atol=1e-12)


def test_selected_measurements_keep_frames_and_layout() -> None:
    """Selected measurements refer to all stations and prisms."""
    rng = np.random.default_rng(4)
    observations = observed(tumbling(rng), rng)
    some = observations.select(observations.prism == 1)
    assert len(some) == np.count_nonzero(observations.prism == 1)
    assert some.frames is observations.frames
    assert some.layout is observations.layout
    np.testing.assert_array_equal(some.in_world(), observations.in_world()[observations.prism == 1])
