"""Joint least squares of all stations' target measurements: frames, target positions and instrument errors.

The measurements are the readings of the instruments (angles of either face, distance), one by one. Target positions are
eliminated (Schur complement), so that the effort grows linearly with their number.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import DegenerateGeometryError
from tsgt.geometry.polar import corrected_angles, polar_to_cartesian
from tsgt.geometry.rigid import exp_so3, skew
from tsgt.model import ARCSECOND_RAD

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.model import InstrumentNoise

MAX_ITERATIONS = 20
STEP_TOLERANCE = 1e-10  # In m and rad: far below any instrument's noise
MIN_INFORMATION = (
    1e-13  # Smallest eigenvalue of the scaled normal matrix; below, the targets do not determine a frame
)


class InstrumentError(StrEnum):
    """Unknowns of an instrument, with the signs of ``tsgt.model.StationParameters``."""

    VERTICAL_INDEX = "vertical_index"  # rad
    COLLIMATION = "collimation"  # rad
    RANGE_SCALE = "range_scale"  # Correction of the distance, dimensionless
    RANGE_CONSTANT = "range_constant"  # Correction of the distance to a target, in m


ERRORS = tuple(InstrumentError)
DATA_SHEET_SIGMA = {
    InstrumentError.VERTICAL_INDEX: 5 * ARCSECOND_RAD,
    InstrumentError.COLLIMATION: 5 * ARCSECOND_RAD,
    InstrumentError.RANGE_SCALE: 2e-6,
    InstrumentError.RANGE_CONSTANT: 1e-3,
}
"""One sigma of each error of an instrument in order, from data sheets of 1 to 5 arcsecond instruments.

Angles: what remains after the user's adjustment. Constant: also of the foil.
"""

Column = tuple[int, int]  # Row of a station, and component: 0-5 of its pose, 6-9 its instrument errors
POSE_COLUMNS = (0, 1, 2, 3, 4, 5)
LEVELLED_COLUMNS = (0, 1, 2, 5)
COLUMNS = 6 + len(ERRORS)
TARGET_CONSTANT: Column = (0, COLUMNS)  # Correction of the distances of all stations to targets alike, in m


@dataclass(frozen=True, slots=True, eq=False)
class TargetReadings:
    """Readings of n targets in the order in which they were made, with the constants given for them added."""

    stations: tuple[int, ...]  # Numbers; the first is the reference
    targets: tuple[int, ...]  # Numbers
    station: NDArray[np.intp]  # (n,) row of ``stations``
    target: NDArray[np.intp]  # (n,) row of ``targets``
    horizontal_rad: FloatArray  # (n,) in either face
    zenith_rad: FloatArray  # (n,) above pi in the second face
    distance_m: FloatArray  # (n,)

    @property
    def face(self) -> FloatArray:
        """(n,) 1 in the first face, -1 in the second."""
        return np.where(np.sin(self.zenith_rad) < 0, -1.0, 1.0)

    def select(self, rows: NDArray[np.bool_]) -> TargetReadings:
        """Return these readings, of the same stations and targets."""
        return replace(
            self,
            station=self.station[rows],
            target=self.target[rows],
            horizontal_rad=self.horizontal_rad[rows],
            zenith_rad=self.zenith_rad[rows],
            distance_m=self.distance_m[rows],
        )

    def sigmas_m(self, noise: InstrumentNoise) -> FloatArray:
        """(n, 3) noise along the line of sight, horizontally and vertically across it."""
        along = np.sqrt(
            noise.range_sigma_m**2
            + (1e-6 * noise.range_sigma_ppm * self.distance_m) ** 2
            + noise.pointing_sigma_m**2
        )
        across = np.hypot(noise.angle_sigma_rad * self.distance_m, noise.pointing_sigma_m)
        return np.stack([along, across, across], axis=1)

    def points_m(self, errors: FloatArray, target_constant_m: float = 0.0) -> FloatArray:
        """(n, 3) in the frames of the stations, corrected by the instrument errors (stations, 4)."""
        points = np.empty((len(self.station), 3))
        for row in range(len(self.stations)):
            own = self.station == row
            index, collimation, scale, constant = errors[row]
            horizontal, zenith = corrected_angles(
                self.horizontal_rad[own],
                self.zenith_rad[own],
                vertical_index_rad=float(index),
                collimation_rad=float(collimation),
            )
            points[own] = polar_to_cartesian(
                horizontal, zenith, self.distance_m[own] * (1 + scale) + constant + target_constant_m
            )
        return points

    def axes(self) -> FloatArray:
        """(n, 3, 3) rows: unit vectors along, horizontally (clockwise) and vertically (down) across the line of sight."""
        sign = self.face
        h = self.horizontal_rad
        sin_h, cos_h = sign * np.sin(h), sign * np.cos(h)  # Of the first face
        sin_z, cos_z = np.abs(np.sin(self.zenith_rad)), np.cos(self.zenith_rad)
        zero = np.zeros_like(h)
        return np.stack(
            [
                np.stack([sin_z * cos_h, -sin_z * sin_h, cos_z], axis=1),
                np.stack([-sin_h, -cos_h, zero], axis=1),
                np.stack([cos_z * cos_h, -cos_z * sin_h, -sin_z], axis=1),
            ],
            axis=1,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    """Values of all unknowns: stations (K), targets (T)."""

    rotation: FloatArray  # (K, 3, 3) from each station's frame to that of the first
    translation_m: FloatArray  # (K, 3)
    errors: FloatArray  # (K, 4) instrument errors in the order of ``InstrumentError``
    points_m: FloatArray  # (T, 3) in the first station's frame
    target_constant_m: float = 0.0  # Correction that all stations share

    def value(self, column: Column) -> float:
        """Value of an unknown; of a pose zero."""
        row, component = column
        if column == TARGET_CONSTANT:
            return self.target_constant_m
        return float(self.errors[row, component - 6]) if component >= 6 else 0.0

    def without_errors(self) -> Network:
        """Return the network with ideal instruments."""
        return replace(self, errors=np.zeros_like(self.errors), target_constant_m=0.0)


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Whitened residuals ``y = A da + B dp`` of n readings at a network, and what least squares makes of them.

    ``active``: the estimated columns of A; the target positions are eliminated.
    """

    target: NDArray[np.intp]
    y: FloatArray  # (n, 3) along, horizontally and vertically across the line of sight
    A: FloatArray  # (n, 3, K, 11) by poses, instrument errors and (first station) the target constant
    B: FloatArray  # (n, 3, 3) by the position of the reading's target
    active: tuple[Column, ...]
    target_count: int
    # (a,) information of priors on the active columns, and their present distance from the priors' means
    prior_information: FloatArray
    prior_distance: FloatArray

    def with_noise(self, scale: float) -> Linearisation:
        """Return the same for noise larger by a factor; priors are as before."""
        return replace(self, y=self.y / scale, A=self.A / scale, B=self.B / scale)

    def columns(self, which: tuple[Column, ...]) -> FloatArray:
        """(n, 3, c) of these columns of A."""
        rows, components = (list(each) for each in zip(*which, strict=True)) if which else ([], [])
        return self.A[:, :, rows, components]

    def by_target(self, values: FloatArray) -> FloatArray:
        """(T, 3, ...) sums of ``B^T values`` over the readings of each target."""
        product = np.einsum("nij,ni...->nj...", self.B, values)
        sums = np.zeros((self.target_count, *product.shape[1:]))
        np.add.at(sums, self.target, product)
        return sums

    @cached_property
    def point_covariances_m2(self) -> FloatArray:
        """(T, 3, 3) of the targets in given frames; the identity of those without readings."""
        information = self.by_target(self.B)
        information[~np.isin(np.arange(self.target_count), self.target)] = np.eye(3)
        inverse: FloatArray = np.linalg.inv(information).astype(np.float64)
        return inverse

    def reduced(self, values: FloatArray) -> FloatArray:
        """Values (n, 3, c) less what the targets' positions absorb."""
        absorbed = np.einsum("tij,tj...->ti...", self.point_covariances_m2, self.by_target(values))
        reduced: FloatArray = values - np.einsum("nij,nj...->ni...", self.B, absorbed[self.target])
        return reduced

    @cached_property
    def D(self) -> FloatArray:  # noqa: N802 (a matrix)
        """(n, 3, a) active columns less what the targets' positions absorb."""
        return self.reduced(self.columns(self.active))

    @cached_property
    def covariance(self) -> FloatArray:
        """(a, a) of the active columns. Raises DegenerateGeometryError if the readings do not determine them."""
        normal = np.einsum("nia,nib->ab", self.D, self.D) + np.diag(self.prior_information)
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        scaled = normal / np.outer(scale, scale)
        values, vectors = np.linalg.eigh(scaled)
        if values[0] < MIN_INFORMATION:
            raise DegenerateGeometryError(
                "expected targets that determine every station frame, got targets in a line; add some away from it"
            )
        covariance: FloatArray = (vectors / values) @ vectors.T / np.outer(scale, scale)
        return covariance

    def step(self) -> tuple[FloatArray, FloatArray]:
        """Gauss-Newton step of the active columns (a,) and of the points (T, 3)."""
        gradient = np.einsum("nia,ni->a", self.D, self.y) - self.prior_information * self.prior_distance
        active = self.covariance @ gradient
        rest = self.y - self.columns(self.active) @ active
        points = np.einsum("tij,tj->ti", self.point_covariances_m2, self.by_target(rest))
        return active, points

    def project(self, values: FloatArray) -> FloatArray:
        """Residuals (n, 3, c) of values (n, 3, c) after least squares; with priors, their products with the inverse covariance."""
        rest = self.reduced(values)
        projected: FloatArray = rest - self.D @ (self.covariance @ np.einsum("nia,nic->ac", self.D, rest))
        return projected

    @property
    def redundancy(self) -> int:
        """Degrees of freedom; what has a prior takes none."""
        free = int(np.count_nonzero(self.prior_information == 0))
        return self.y.size - 3 * len(np.unique(self.target)) - free

    @property
    def chi_squared(self) -> float:
        """Squared normalised residuals, and squared normalised distances from the priors."""
        return float(np.sum(self.y**2) + self.prior_information @ self.prior_distance**2)


def linearise(
    readings: TargetReadings, network: Network, active: Mapping[Column, float], noise: InstrumentNoise
) -> Linearisation:
    """Whitened residuals (measured minus predicted) and Jacobians at a network.

    ``active``: the columns to estimate, with the sigma of their priors about zero; infinite for poses.
    """
    sigmas = readings.sigmas_m(noise)[:, :, None]
    station, target = readings.station, readings.target
    rotation = network.rotation[station]
    line_of_sight = network.points_m[target] - network.translation_m[station]  # In the first station's frame
    to_axes = readings.axes() @ rotation.transpose(0, 2, 1)
    measured = readings.points_m(network.errors, network.target_constant_m)
    y = readings.axes() @ measured[:, :, None] - to_axes @ line_of_sight[:, :, None]
    n = len(station)
    A = np.zeros((n, 3, len(readings.stations), COLUMNS + 1))
    rows = np.arange(n)
    own = np.zeros((n, 3, COLUMNS))
    own[:, :, :3] = -to_axes
    own[:, :, 3:6] = to_axes @ skew(line_of_sight)
    lever = readings.face * readings.distance_m
    own[:, 2, 6] = lever  # Vertical index
    own[:, 1, 7] = -lever  # Collimation
    own[:, 0, 8] = -readings.distance_m
    own[:, 0, 9] = -1.0
    A[rows, :, station, :COLUMNS] = own / sigmas
    A[:, 0, 0, COLUMNS] = -1.0 / sigmas[:, 0, 0]
    return Linearisation(
        target=target,
        y=(y / sigmas)[:, :, 0],
        A=A,
        B=to_axes / sigmas,
        active=tuple(active),
        target_count=len(readings.targets),
        prior_information=np.array([sigma**-2.0 for sigma in active.values()]),
        prior_distance=np.array([network.value(column) for column in active]),
    )


def solve(
    readings: TargetReadings, start: Network, active: Mapping[Column, float], noise: InstrumentNoise
) -> tuple[Network, Linearisation]:
    """Gauss-Newton from a start (``active`` as in :func:`linearise`); the second result is the linearisation at the solution.

    Raises DegenerateGeometryError if the readings do not determine the active columns.
    """
    network = start
    for _ in range(MAX_ITERATIONS):
        linear = linearise(readings, network, active, noise)
        step, points = linear.step()
        network = _moved(network, tuple(active), step, points)
        if max(np.abs(step).max(initial=0.0), np.abs(points).max()) < STEP_TOLERANCE:
            break
    return network, linearise(readings, network, active, noise)


def _moved(network: Network, active: tuple[Column, ...], step: FloatArray, points: FloatArray) -> Network:
    change = np.zeros((len(network.rotation), COLUMNS + 1))
    for column, value in zip(active, step, strict=True):
        change[column] = value
    return Network(
        rotation=np.stack([exp_so3(c[3:6]) @ r for c, r in zip(change, network.rotation, strict=True)]),
        translation_m=network.translation_m + change[:, :3],
        errors=network.errors + change[:, 6:COLUMNS],
        points_m=network.points_m + points,
        target_constant_m=network.target_constant_m + float(change[TARGET_CONSTANT]),
    )
