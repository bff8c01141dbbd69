"""Factors on the stated noise of the measurements, by station and component. Sans-I/O.

Instruments differ, and so do their components: a range may scatter as its data sheet says while the same instrument's
horizontal angles scatter by three times as much. The factors are hyperparameters of
:func:`tsgt.geometry.batch.hyperparameters.tune`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.rest import Series, in_rest

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.geometry.rest import RestInterval
    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.gauss_newton import Solution
    from tsgt.geometry.trajectory.measurement_factors import Observations

SCALE_SPREAD = 0.4
"""One sigma of a factor's logarithm about that common to all. Wide: a factor of 1.5. It matters only for a station or
component with little redundancy, whose factor the evidence would otherwise drive to zero or infinity.
"""

MIN_SCALE = 0.5  # No instrument is better than half its data sheet
SHEET_FREEDOM = 10.0  # Measurements that agree with the sheet, added to those at rest


def scale_noise(observations: Observations, scales: FloatArray | float) -> Observations:
    """Return measurements with their noise scaled by one factor, or by station and component, (S, 3)."""
    factors = np.asarray(scales, np.float64)
    if factors.ndim == 2:
        factors = factors[observations.station]
    return replace(observations, sigmas_m=observations.sigmas_m * factors)


def overall_scale(observations: Observations, scales: FloatArray) -> float:
    """Return the root mean square of the factors, (S, 3), over all measurements and their three components."""
    return float(np.sqrt(np.mean(scales[observations.station] ** 2)))


def min_scales(observations: Observations, rest: Sequence[RestInterval]) -> FloatArray:
    """(S, 3) least factors by station and component: the scatter of raw measurements at rest, if it is no vibration.

    A prior that fits the motion badly takes noise for motion. It cannot at rest, and no instrument is better on the move. At
    rest it may be far better, which says nothing about driving.
    """
    index, series = in_rest(rest, observations.time_s), Series.of(observations)
    squares, freedom = np.zeros((2, len(observations.frames), 3))
    for interval in range(len(rest)):
        for number in np.unique(series.series[index == interval]):
            own = (index == interval) & (series.series == number)
            values, station = series.values[own], observations.station[own][0]
            squares[station] += (((values - values.mean(axis=0)) / series.sigmas[own]) ** 2).sum(axis=0)
            freedom[station] += len(values) - 1
    scales = np.sqrt((squares + SHEET_FREEDOM) / (freedom + SHEET_FREEDOM))
    vibrating = scales > 1.0 + 2.0 / np.sqrt(2.0 * (freedom + SHEET_FREEDOM))
    scales = np.where(freedom > 0, np.where(vibrating, 1.0, scales), 0.0)
    return np.maximum(scales, MIN_SCALE)


def log_scale_gradient(
    solution: Solution, observations: Observations, covariance: FloatArray, scaled: NDArray[np.bool_]
) -> tuple[FloatArray, float]:
    """Differentiate the log evidence by the logarithms of the factors, (S, 3), and of one on all time sigmas.

    By Fisher's identity: expected outer products of the residuals, compared with the covariance that the noise states.
    ``covariance``: of the knots, (K, 18, 18). ``scaled``: (M,) measurements to whose noise the factors apply.
    """
    linearised = solution.linearised
    information = np.linalg.inv(linearised.covariance(observations))
    jacobian = linearised.jacobian
    weighted = information @ jacobian
    normalised = (information @ linearised.residuals_m[:, :, None])[:, :, 0]
    expected = normalised**2 + np.einsum(
        "mij,mjk,mik->mi", weighted, covariance[solution.knot_index], weighted, optimize=True
    )
    by_row = observations.sigmas_m**2 * (
        solution.weights[:, None] * expected - np.diagonal(information, axis1=1, axis2=2)
    )
    gradient = np.zeros((len(observations.frames), 3))
    np.add.at(gradient, observations.station[scaled], by_row[scaled])
    by_time = (linearised.by_point @ linearised.velocity_mps[:, :, None]) * observations.time_sigma_s[
        :, None, None
    ]
    projected = np.swapaxes(by_time, 1, 2) @ weighted
    expected_time = (np.swapaxes(by_time, 1, 2) @ normalised[:, :, None])[:, 0, 0] ** 2 + np.einsum(
        "mj,mjk,mk->m", projected[:, 0], covariance[solution.knot_index], projected[:, 0], optimize=True
    )
    stated = (np.swapaxes(by_time, 1, 2) @ information @ by_time)[:, 0, 0]
    return gradient, float((solution.weights * expected_time - stated).sum())
