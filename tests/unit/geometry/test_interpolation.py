"""Linear interpolation: intervals, outage limit, precision of Unix times, covariance."""

from __future__ import annotations

import numpy as np
import pytest

from tsgt.errors import GeometryError
from tsgt.geometry import (
    NO_GAP_NS,
    interpolate,
    interpolate_prisms,
    interpolated_covariance,
    interpolation_error_s2,
)

SECOND_NS = 1_000_000_000
START_NS = 1_647_269_269_671_000_000
TIMES_NS = START_NS + np.array([0, 400_000_000, 800_000_000, 2_800_000_000, 3_200_000_000])
POINTS = np.array([[0.0, 0.0, 1.0], [0.4, 0.0, 1.0], [0.8, 0.4, 1.0], [2.8, 2.4, 1.0], [2.8, 2.4, 3.0]])


def test_agrees_with_numpy_interp() -> None:
    """Between samples, positions equal np.interp."""
    rng = np.random.default_rng(1)
    times_ns = np.cumsum(rng.integers(1, SECOND_NS, 50))
    points = rng.normal(size=(50, 3))
    epochs_ns = rng.integers(times_ns[0] + 1, times_ns[-1], 500)
    found = interpolate(times_ns, points, epochs_ns, SECOND_NS)
    assert found.valid.all()
    for axis in range(3):
        np.testing.assert_allclose(
            found.points[:, axis], np.interp(epochs_ns, times_ns, points[:, axis]), rtol=0, atol=1e-13
        )


def test_unix_times_keep_their_nanoseconds() -> None:
    """One nanosecond after a sample differs from the sample, although a float64 of Unix ns could not resolve it."""
    found = interpolate(TIMES_NS, POINTS, TIMES_NS[:1] + 1, SECOND_NS)
    assert found.fraction[0] == 1 / 400_000_000


def test_velocity_is_the_slope() -> None:
    """The velocity is the difference of the two samples over their time."""
    found = interpolate(TIMES_NS, POINTS, TIMES_NS[1:2] + 1, SECOND_NS)
    np.testing.assert_allclose(found.velocities_mps, [[1.0, 1.0, 0.0]], atol=1e-14)


def test_epoch_on_a_sample_belongs_to_the_interval_that_ends_there() -> None:
    """On a sample the position is that sample's and the interval ends there."""
    found = interpolate(TIMES_NS, POINTS, TIMES_NS[1:2], SECOND_NS)
    assert (found.after[0], found.fraction[0], found.gap_ns[0]) == (1, 1.0, 400_000_000)
    np.testing.assert_allclose(found.points[0], POINTS[1], atol=1e-15)


@pytest.mark.parametrize(("limit_ns", "valid"), [(2 * SECOND_NS, True), (2 * SECOND_NS - 1, False)])
def test_gap_as_long_as_the_limit_is_valid(limit_ns: int, valid: bool) -> None:  # noqa: FBT001 (a parameter)
    """A gap of exactly the outage limit is valid, one nanosecond more is not; its length is reported either way."""
    found = interpolate(TIMES_NS, POINTS, TIMES_NS[2:3] + SECOND_NS, limit_ns)
    assert found.valid.tolist() == [valid]
    assert found.gap_ns.tolist() == [2 * SECOND_NS]
    assert found.fraction.tolist() == [0.5]


@pytest.mark.parametrize(
    ("epoch_ns", "after"), [(TIMES_NS[0] - 1, 0), (TIMES_NS[0], 0), (TIMES_NS[-1] + 1, len(TIMES_NS))]
)
def test_outside_the_samples_is_invalid(epoch_ns: int, after: int) -> None:
    """Before, on the first and after the last sample there is no interval."""
    found = interpolate(TIMES_NS, POINTS, np.array([epoch_ns]), SECOND_NS)
    assert found.valid.tolist() == [False]
    assert found.gap_ns.tolist() == [NO_GAP_NS]
    assert found.after.tolist() == [after]


def test_invalid_epochs_have_finite_zeros() -> None:
    """Invalid positions and velocities are 0, not NaN."""
    found = interpolate(TIMES_NS, POINTS, np.array([START_NS - 5, START_NS + SECOND_NS]), SECOND_NS)
    np.testing.assert_array_equal(found.points, np.zeros((2, 3)))
    np.testing.assert_array_equal(found.velocities_mps, np.zeros((2, 3)))


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_samples_give_no_valid_epoch(count: int) -> None:
    """With zero or one sample every epoch is invalid."""
    found = interpolate(TIMES_NS[:count], POINTS[:count], TIMES_NS, SECOND_NS)
    assert not found.valid.any()
    assert (found.gap_ns == NO_GAP_NS).all()


@pytest.mark.parametrize("counts", [(5, 2, 3), (0, 5, 1), (0, 0, 0)])
def test_prisms_together_equal_prisms_alone(counts: tuple[int, ...]) -> None:
    """Several prisms, some without samples, give the same bits together as one by one."""
    epochs_ns = np.sort(np.concatenate([TIMES_NS, TIMES_NS + 1, TIMES_NS - 1]))
    times_ns = np.concatenate([TIMES_NS[:count] for count in counts])
    points = np.concatenate([POINTS[:count] * (number + 1) for number, count in enumerate(counts)])
    together = interpolate_prisms(times_ns, points, counts, epochs_ns, SECOND_NS)
    for number, count in enumerate(counts):
        alone = interpolate(TIMES_NS[:count], POINTS[:count] * (number + 1), epochs_ns, SECOND_NS)
        for name in ("points", "velocities_mps", "fraction", "gap_ns", "valid"):
            np.testing.assert_array_equal(getattr(together, name)[:, number], getattr(alone, name))
        np.testing.assert_array_equal(together.after[:, number] - sum(counts[:number]), alone.after)


def test_no_epochs_give_empty_arrays() -> None:
    """An empty list of epochs gives empty arrays."""
    found = interpolate(TIMES_NS, POINTS, np.array([], dtype=np.int64), SECOND_NS)
    assert found.points.shape == (0, 3)


@pytest.mark.parametrize(
    ("times_ns", "points", "message"),
    [
        (TIMES_NS[::-1], POINTS, "increase strictly"),
        (np.zeros(5, dtype=np.int64), POINTS, "increase strictly"),
        (TIMES_NS, POINTS[:4], r"shape \(5, 3\), got \(4, 3\)"),
        (TIMES_NS, POINTS * np.nan, "NaN"),
    ],
)
def test_invalid_samples_are_rejected(times_ns: np.ndarray, points: np.ndarray, message: str) -> None:
    """Unsorted or repeated times, a wrong shape and NaN raise an error."""
    with pytest.raises(GeometryError, match=message):
        interpolate(times_ns, points, TIMES_NS, SECOND_NS)


def test_covariance_matches_monte_carlo_of_a_curved_path() -> None:
    """Errors of interpolating noisy samples of randomly accelerated paths have the stated covariance."""
    rng = np.random.default_rng(2)
    draws, gap_s, fraction, acceleration_sigma = 20_000, 0.8, 0.3, 0.5
    factors = 0.02 * rng.normal(size=(2, 3, 3))
    covariances = factors @ np.swapaxes(factors, 1, 2)
    acceleration = rng.normal(scale=acceleration_sigma, size=(draws, 3))
    before, after = (rng.normal(size=(draws, 3)) @ factor.T for factor in factors)
    after = after + acceleration * gap_s**2 / 2
    truth = acceleration * (fraction * gap_s) ** 2 / 2
    errors = before + fraction * (after - before) - truth
    noise = interpolated_covariance(covariances[:1], covariances[1:], np.array([fraction]))[0]
    unseen_m = acceleration_sigma * interpolation_error_s2(np.array([fraction]), np.array([800_000_000]))[0]
    predicted = noise + unseen_m**2 * np.eye(3)
    # Whitened, the sample covariance is the identity; with 20000 draws its entries scatter by 0.01.
    whitening = np.linalg.inv(np.linalg.cholesky(predicted))
    np.testing.assert_allclose(whitening @ (errors.T @ errors / draws) @ whitening.T, np.eye(3), atol=0.05)


def test_covariance_on_a_sample_is_that_of_the_sample() -> None:
    """At fraction 1 only the later sample counts."""
    before, after = np.diag([1.0, 2, 3])[None], np.diag([4.0, 5, 6])[None]
    found = interpolated_covariance(before, after, np.array([1.0]))
    np.testing.assert_array_equal(found, after)
    assert interpolation_error_s2(np.array([1.0]), np.array([SECOND_NS]))[0] == 0.0
