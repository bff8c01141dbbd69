"""First-order accuracy of a pose, by layout, stations and noise."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from tsgt.analysis.design import (
    HEADING_COUNT,
    PoseAccuracy,
    RobotPoses,
    Station,
    pose_covariances,
    station_arrangements,
)
from tsgt.config import ScenarioConfig
from tsgt.errors import DegenerateGeometryError, GeometryError
from tsgt.geometry import (
    cartesian_to_polar,
    exp_so3,
    measurement_covariance,
    pose_covariance,
    rotate,
)
from tsgt.model import ARCSECOND_RAD, InstrumentNoise

LAYOUT = np.array([prism.position_m for prism in ScenarioConfig().prisms])
NOISE = InstrumentNoise(
    range_sigma_m=0.002, range_sigma_ppm=2.0, angle_sigma_rad=ARCSECOND_RAD, pointing_sigma_m=0.001
)
EVEN = InstrumentNoise(range_sigma_m=0.0, range_sigma_ppm=0.0, angle_sigma_rad=0.0, pointing_sigma_m=0.003)
"""Alike in all directions and at all distances."""
PLACES = [(0.0, 0.0, 0.0), (2.0, -1.5, 0.1), (-1.5, 2.5, -0.2)]
ROBOT_POSES = RobotPoses.at([[60.0, 45.0, -1.0], [20.0, 10.0, -1.0]])
ORIGIN = np.zeros(3)


def _stations(
    noise: InstrumentNoise, places: list[tuple[float, float, float]] = PLACES
) -> tuple[Station, ...]:
    return tuple(Station(np.array(place), noise, prism_index % 3) for prism_index, place in enumerate(places))


def test_isotropic_noise_gives_the_covariance_of_the_unweighted_fit() -> None:
    """With the same noise everywhere weights do not matter: the covariance is that of ``linear``, in the robot's axes."""
    found = pose_covariances(LAYOUT, _stations(EVEN), ROBOT_POSES, ORIGIN)
    prisms = np.broadcast_to(0.003**2 * np.eye(3), (1, 3, 3, 3))
    (expected,) = pose_covariance(LAYOUT, np.eye(3)[None], prisms)
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), rtol=1e-9, atol=1e-15)


def test_weighted_fit_is_never_worse_than_unweighted() -> None:
    """The unweighted fit of the same measurements has a larger covariance, in every direction."""
    found = pose_covariances(LAYOUT, _stations(NOISE), ROBOT_POSES, ORIGIN)
    points = rotate(ROBOT_POSES.rotation[:, None], LAYOUT) + ROBOT_POSES.position_m[:, None]
    prisms = np.stack(
        [
            measurement_covariance(*cartesian_to_polar(points[:, i] - place), NOISE)
            for i, place in enumerate(PLACES)
        ],
        axis=1,
    )
    unweighted = pose_covariance(LAYOUT, ROBOT_POSES.rotation, prisms)
    to_robot = np.zeros((len(found), 6, 6))
    to_robot[:, :3, :3] = to_robot[:, 3:, 3:] = np.swapaxes(ROBOT_POSES.rotation, 1, 2)
    unweighted = to_robot @ unweighted @ np.swapaxes(to_robot, 1, 2)
    assert (np.linalg.eigvalsh(unweighted - found) > -1e-12).all()
    assert np.trace(unweighted - found, axis1=1, axis2=2).max() > 1e-9


def test_information_equals_numerical_differentiation() -> None:
    """The information in two angles and a distance of each prism, from finite differences."""
    noise = dataclasses.replace(NOISE, pointing_sigma_m=0.0, angle_sigma_rad=20 * ARCSECOND_RAD)
    robot_pose = RobotPoses.at([[50.0, -30.0, 2.0]], [0.7])
    R, origin = robot_pose.rotation[0], robot_pose.position_m[0]
    point = np.array([0.2, -0.1, 0.4])

    def measured(error: np.ndarray) -> np.ndarray:
        """Angles and distances (3, 3) of a robot that is moved and turned a little about the point."""
        robot = point + error[:3] + rotate(exp_so3(error[3:]), LAYOUT - point)
        prisms = rotate(R, robot) + origin
        return np.stack(cartesian_to_polar(prisms - np.array(PLACES)))

    _, z, d = measured(np.zeros(6))
    sigmas = np.stack(
        [
            noise.angle_sigma_rad / np.sin(z),
            np.full(3, noise.angle_sigma_rad),
            np.hypot(noise.range_sigma_m, noise.range_sigma_ppm * 1e-6 * d),
        ]
    )
    step = 1e-6
    jacobian = np.stack(
        [((measured(e) - measured(-e)) / (2 * step) / sigmas).ravel() for e in step * np.eye(6)], axis=1
    )
    (found,) = pose_covariances(LAYOUT, _stations(noise), robot_pose, point)
    expected = np.linalg.inv(jacobian.T @ jacobian)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


def test_second_station_per_prism_halves_the_variance() -> None:
    """Six stations, two at each place, have twice the information of three."""
    one = pose_covariances(LAYOUT, _stations(NOISE), ROBOT_POSES, ORIGIN)
    two = pose_covariances(LAYOUT, _stations(NOISE, PLACES * 2), ROBOT_POSES, ORIGIN)
    np.testing.assert_allclose(2 * two, one, rtol=1e-9)


def test_larger_layouts_give_more_accurate_rotation() -> None:
    """Twice as large is twice as accurate; the position of the centroid does not change."""
    centroid = LAYOUT.mean(axis=0)
    one, two = (
        PoseAccuracy.of(
            pose_covariances(centroid + scale * (LAYOUT - centroid), _stations(EVEN), ROBOT_POSES, centroid)
        )
        for scale in (1, 2)
    )
    assert two.rotation_rad == pytest.approx(one.rotation_rad / 2)
    assert two.position_m == pytest.approx(one.position_m)
    assert one.position_m == pytest.approx(0.003)


def test_accuracy_is_root_mean_square_and_worst_case() -> None:
    """Over the robot poses, of the summed variances."""
    covariance = np.array([np.diag([1.0, 4, 4, 1, 0, 0]), np.diag([1.0, 0, 0, 0, 0, 3])])
    found = PoseAccuracy.of(covariance)
    assert found.position_m == pytest.approx(math.sqrt(5))
    assert found.worst_position_m == pytest.approx(3)
    assert found.rotation_rad == pytest.approx(math.sqrt(2))
    assert found.worst_rotation_rad == pytest.approx(math.sqrt(3))
    np.testing.assert_allclose(found.position_axes_m, np.sqrt([1, 2, 2]))


def test_robot_poses_combine_places_and_headings() -> None:
    """Place by place, with all headings evenly around the circle."""
    assert len(ROBOT_POSES.position_m) == 2 * HEADING_COUNT
    np.testing.assert_array_equal(ROBOT_POSES.position_m[HEADING_COUNT], [20, 10, -1])
    np.testing.assert_allclose(
        ROBOT_POSES.rotation[1], exp_so3(np.array([0, 0, 2 * math.pi / HEADING_COUNT]))
    )


def test_station_arrangements() -> None:
    """All at the distance; on one side in the direction of the first, or evenly around."""
    centre = np.array([60.0, 45.0, -1.0])
    found = station_arrangements(_stations(NOISE), centre, 75.0)
    for stations in found.values():
        for station, before in zip(stations, PLACES, strict=True):
            assert math.dist(station.position_m[:2], centre[:2]) == pytest.approx(75)
            assert station.position_m[2] == before[2]
    np.testing.assert_allclose(found["together"][0].position_m, [0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(found["together"][2].position_m[:2], [0, 0], atol=1e-9)
    np.testing.assert_allclose(np.mean([s.position_m[:2] for s in found["around"]], axis=0), centre[:2])


def test_untracked_prism_is_rejected() -> None:
    """Four prisms need four stations."""
    four = np.vstack([LAYOUT, [0.3, 0.3, 0.7]])
    with pytest.raises(GeometryError, match="4 prisms for 3 stations"):
        pose_covariances(four, _stations(NOISE), ROBOT_POSES, ORIGIN)


def test_prisms_in_a_line_are_rejected() -> None:
    """They determine no pose."""
    with pytest.raises(DegenerateGeometryError, match="nearly in a line"):
        pose_covariances(np.outer([0, 1, 2], [1.0, 0, 0]), _stations(NOISE), ROBOT_POSES, ORIGIN)


@pytest.mark.parametrize(("range_sigma_m", "angle_sigma_rad"), [(0.0, 1e-5), (0.002, 0.0)])
def test_noise_free_instruments_are_rejected(range_sigma_m: float, angle_sigma_rad: float) -> None:
    """Their weight would be infinite."""
    noise = InstrumentNoise(
        range_sigma_m=range_sigma_m, range_sigma_ppm=0, angle_sigma_rad=angle_sigma_rad, pointing_sigma_m=0
    )
    with pytest.raises(GeometryError, match="has no noise"):
        _stations(noise)
