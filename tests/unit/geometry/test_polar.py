"""Polar coordinates: axes, both faces, corrections, noise against propagation."""

from __future__ import annotations

import numpy as np
import pytest

from tsgt.geometry import (
    cartesian_to_polar,
    corrected_angles,
    corrected_distance,
    measurement_covariance,
    polar_to_cartesian,
    raw_distance,
)
from tsgt.model import TRACKING_NOISE, InstrumentNoise

QUARTER = np.pi / 2


@pytest.mark.parametrize(
    ("horizontal_rad", "zenith_rad", "expected"),
    [
        (0.0, QUARTER, (2, 0, 0)),
        (QUARTER, QUARTER, (0, -2, 0)),
        (3 * QUARTER, QUARTER, (0, 2, 0)),
        (1.0, 0.0, (0, 0, 2)),
        (1.0, np.pi, (0, 0, -2)),
    ],
)
def test_axes(horizontal_rad: float, zenith_rad: float, expected: tuple[float, ...]) -> None:
    """Horizontal angles run clockwise from x seen from above, zenith angles from straight up."""
    np.testing.assert_allclose(polar_to_cartesian(horizontal_rad, zenith_rad, 2.0), expected, atol=1e-15)


def test_both_faces_give_the_same_point() -> None:
    """Second-face angles (zenith above pi, horizontal angle turned by pi) give the same point."""
    np.testing.assert_allclose(
        polar_to_cartesian(0.7 + np.pi, 2 * np.pi - 1.2, 30.0), polar_to_cartesian(0.7, 1.2, 30.0), atol=1e-13
    )


def test_field_data_formula(field_data: object) -> None:
    """The authors' markers agree with the formula beside their data, written with elevations."""
    table = np.loadtxt(f"{field_data}/20220314/GCP.txt", delimiter=",", skiprows=1)
    el, az, d = table[:, 3], table[:, 4], table[:, 5]
    up = np.pi / 2 - el
    expected = np.column_stack([d * np.cos(-az) * np.cos(up), d * np.sin(-az) * np.cos(up), d * np.sin(up)])
    np.testing.assert_allclose(polar_to_cartesian(az, el, d), expected, atol=1e-12)


@pytest.mark.parametrize(
    "point", [(0, 0, 0), (0.0, -0.0, 3), (0, 0, -3), (-1, 0, 0), (-1, -0.0, 0), (1, 1e-20, 0)]
)
def test_cartesian_to_polar_at_singular_points(point: tuple[float, ...]) -> None:
    """At the station, on the vertical and at the circle's zero the angles stay in range and map back."""
    h, z, d = cartesian_to_polar(point)
    assert 0 <= h < 2 * np.pi
    assert 0 <= z <= np.pi
    np.testing.assert_allclose(polar_to_cartesian(h, z, d), point, atol=1e-15)


def test_constant_is_not_scaled_by_ppm() -> None:
    """100 ppm of 1000 m are 0.1 m; the constant is added unscaled."""
    assert corrected_distance(1000.0, constant_m=0.01, ppm=100.0) == pytest.approx(1000.11, abs=1e-12)


def test_raw_distance_inverts_corrected_distance() -> None:
    """raw_distance removes constant and scale."""
    raw_m = np.array([0.0, 1.5, 812.3])
    corrected_m = corrected_distance(raw_m, constant_m=-0.0344, ppm=-12.0)
    np.testing.assert_allclose(raw_distance(corrected_m, constant_m=-0.0344, ppm=-12.0), raw_m, atol=1e-12)


def test_covariance_is_propagated_from_angles_and_range() -> None:
    """J diag(sigma^2) J' with the horizontal sigma over sin z, plus pointing, gives the same matrix."""
    noise = InstrumentNoise(
        range_sigma_m=0.002, range_sigma_ppm=20.0, angle_sigma_rad=1e-4, pointing_sigma_m=0.001
    )
    polar = np.random.default_rng(3).uniform((0, 0.1, 1), (6.2, 3.0, 500), size=(50, 3))
    h, z, d = polar.T
    sin_h, cos_h, sin_z, cos_z = np.sin(h), np.cos(h), np.sin(z), np.cos(z)
    by_angles_and_range = [
        [-d * sin_z * sin_h, -d * sin_z * cos_h, 0.0 * d],
        [d * cos_z * cos_h, -d * cos_z * sin_h, -d * sin_z],
        [sin_z * cos_h, -sin_z * sin_h, cos_z],
    ]
    J = np.array(by_angles_and_range).T
    variances = np.stack(
        [(1e-4 / np.sin(z)) ** 2, np.full(50, 1e-4**2), 0.002**2 + (20e-6 * d) ** 2], axis=-1
    )
    expected = (J * variances[:, None, :]) @ np.swapaxes(J, 1, 2) + 0.001**2 * np.eye(3)
    np.testing.assert_allclose(measurement_covariance(h, z, d, noise), expected, rtol=1e-9, atol=1e-15)


def test_covariance_straight_up_is_finite() -> None:
    """At zenith 0 the noise across is distance x angle sigma in both directions."""
    noise = InstrumentNoise(
        range_sigma_m=0.002, range_sigma_ppm=0.0, angle_sigma_rad=1e-5, pointing_sigma_m=0.0
    )
    np.testing.assert_allclose(
        measurement_covariance(0.3, 0.0, 100.0, noise), np.diag([1e-6, 1e-6, 4e-6]), atol=1e-18
    )


def test_noise_model_broadcasts_to_one_matrix_per_measurement() -> None:
    """Arrays of angles and distances give one matrix per measurement."""
    h, z, d = np.array([[0.1, 2.0], [1.4, 1.6], [5.0, 70.0]])
    together = measurement_covariance(h, z, d, TRACKING_NOISE)
    np.testing.assert_array_equal(together[1], measurement_covariance(2.0, 1.6, 70.0, TRACKING_NOISE))


@pytest.mark.parametrize("second_face", [False, True])
def test_angle_errors_of_the_instrument_are_corrected(second_face: bool) -> None:  # noqa: FBT001
    """Readings with index and collimation errors give the target; the mean of both faces needs no correction."""
    h, z, index, collimation = 0.7, 1.2, 3e-4, 2e-4
    # The telescope's line of sight is off by the collimation error to the right of it, whichever face.
    read_h, read_z = h - collimation / np.sin(z), z + index
    if second_face:
        read_h, read_z = h + np.pi + collimation / np.sin(z), 2 * np.pi - z + index
    found = corrected_angles(read_h, read_z, vertical_index_rad=index, collimation_rad=collimation)
    assert polar_to_cartesian(*found, 100.0) == pytest.approx(polar_to_cartesian(h, z, 100.0), abs=1e-5)


def test_collimation_is_not_corrected_straight_up() -> None:
    """Its effect on the horizontal angle diverges there."""
    horizontal, zenith = corrected_angles(0.3, 0.0, vertical_index_rad=0.0, collimation_rad=1e-3)
    assert (float(horizontal), float(zenith)) == (0.3, 0.0)
