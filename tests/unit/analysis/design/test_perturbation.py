"""Pose errors due to noise on the prisms."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest

from tsgt.analysis.design import equivalent_noise, first_order_sigmas, perturbation_study
from tsgt.config import ScenarioConfig
from tsgt.errors import DegenerateGeometryError

LAYOUT = np.array([prism.position_m for prism in ScenarioConfig().prisms])
"""The prisms of the scenario ``dynamic``, at the paper's distances."""
FOUR = np.vstack([LAYOUT, [0.3, 0.3, 0.7]])
CENTROID = LAYOUT.mean(axis=0)


def _random(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.mark.parametrize("layout", [LAYOUT, FOUR], ids=["three prisms", "four prisms"])
@pytest.mark.parametrize("point_m", [CENTROID, np.zeros(3)], ids=["centroid", "origin"])
def test_small_noise_agrees_with_first_order_propagation(layout: np.ndarray, point_m: np.ndarray) -> None:
    """On each axis; 40000 samples determine a standard deviation to 0.35 %, one sigma."""
    (found,) = perturbation_study(layout, [0.002], samples=40_000, point_m=point_m, random=_random())
    position_m, rotation_rad = first_order_sigmas(layout, 0.002, point_m=point_m)
    np.testing.assert_allclose(found.position_std_m, position_m, rtol=0.015)
    np.testing.assert_allclose(found.euler_std_rad, rotation_rad, rtol=0.015)


def test_first_order_of_an_equilateral_triangle() -> None:
    """Centroid: sigma / sqrt(3); about axes in the plane: sigma sqrt(2/3) / r, about the normal sigma / (r sqrt(3))."""
    radius_m, sigma_m = 0.5, 0.004
    angles = np.arange(3) * 2 * math.pi / 3
    layout = radius_m * np.stack([np.cos(angles), np.sin(angles), np.zeros(3)], axis=1) + (1, 2, 3)
    position_m, rotation_rad = first_order_sigmas(layout, sigma_m, point_m=layout.mean(axis=0))
    np.testing.assert_allclose(position_m, sigma_m / math.sqrt(3))
    in_plane, normal = sigma_m * math.sqrt(2 / 3) / radius_m, sigma_m / radius_m / math.sqrt(3)
    np.testing.assert_allclose(rotation_rad, [in_plane, in_plane, normal])


def test_no_noise_gives_no_error() -> None:
    """At 0 mm every figure is rounding error."""
    (found,) = perturbation_study(LAYOUT, [0.0], samples=10, point_m=CENTROID, random=_random())
    assert found.position_norm_mean_m < 1e-12
    assert found.rotation_norm_mean_rad < 1e-12
    assert found.inter_prism_mean_m < 1e-12


def test_position_of_the_centroid_is_unbiased() -> None:
    """It is the mean of the prisms, however large the noise; another point is biased towards it."""
    at_centroid, at_origin = (
        perturbation_study(LAYOUT, [0.3], samples=40_000, point_m=point_m, random=_random())[0]
        for point_m in (CENTROID, np.zeros(3))
    )
    np.testing.assert_allclose(at_centroid.position_mean_m, 0, atol=4 * 0.3 / math.sqrt(3 * 40_000))
    np.testing.assert_allclose(at_centroid.position_std_m, 0.3 / math.sqrt(3), rtol=0.02)
    assert at_origin.position_mean_m[2] > 0.3


def test_equivalent_noise_of_ten_millimetres() -> None:
    """The noise that causes them is found, and its first-order effect on the pose."""
    found = equivalent_noise(LAYOUT, 0.010, samples=50_000, point_m=CENTROID, random=_random())
    assert found.inter_prism_mean_m == pytest.approx(0.010, rel=1e-6)
    # |difference of two prisms| along their line: sqrt(2) sigma sqrt(2 / pi) in the mean.
    assert found.noise_m == pytest.approx(0.010 * math.sqrt(math.pi) / 2, rel=0.01)
    # The length of three normal coordinates is sqrt(8 / pi) of their sigma in the mean.
    expected_m = found.noise_m / math.sqrt(3) * math.sqrt(8 / math.pi)
    assert found.position_norm_mean_m == pytest.approx(expected_m, rel=0.01)
    _, rotation_rad = first_order_sigmas(LAYOUT, found.noise_m, point_m=CENTROID)
    np.testing.assert_allclose(found.euler_abs_mean_rad, rotation_rad * math.sqrt(2 / math.pi), rtol=0.015)


def test_same_seed_gives_the_same_study() -> None:
    """Randomness comes from the generator alone."""
    one, two = (
        perturbation_study(LAYOUT, [0.01, 0.1], samples=50, point_m=CENTROID, random=_random(7)) for _ in "ab"
    )
    np.testing.assert_array_equal(one[1].euler_mean_rad, two[1].euler_mean_rad)


def test_study_takes_less_than_five_seconds() -> None:
    """101 sigmas, 1000 samples each; it takes a tenth of a second on a desktop computer."""
    start_s = time.perf_counter()
    study = perturbation_study(
        LAYOUT, list(0.004 * np.arange(101)), samples=1000, point_m=CENTROID, random=_random()
    )
    assert len(study) == 101
    assert time.perf_counter() - start_s < 5


def test_progress_is_reported() -> None:
    """From the first sigma to the last."""
    progress: list[float] = []
    perturbation_study(
        LAYOUT, [0.0, 0.1], samples=2, point_m=CENTROID, random=_random(), on_progress=progress.append
    )
    assert progress == [0.5, 1.0]


def test_prisms_in_a_line_are_rejected() -> None:
    """They determine no rotation."""
    line = np.array([[0.0, 0, 1], [0.5, 0, 1], [1.0, 0, 1]])
    with pytest.raises(DegenerateGeometryError, match="nearly in a line"):
        perturbation_study(line, [0.01], samples=10, point_m=np.zeros(3), random=_random())


def test_equivalent_noise_of_errors_larger_than_the_layout() -> None:
    """Five metres between prisms that are one metre apart."""
    found = equivalent_noise(LAYOUT, 5.0, samples=2000, point_m=CENTROID, random=_random())
    assert found.inter_prism_mean_m == pytest.approx(5.0, rel=1e-6)
