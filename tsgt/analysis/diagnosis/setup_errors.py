"""Errors of a set-up as one vector, and what the measurements of a moving robot say about them. Sans-I/O.

For three stations and prisms the vector has 60 components: of each station its frame, the drift of its frame from the start to
the end of the recording, latency, vertical index, collimation, constant and scale of the range; of each prism its position.
Station 1 is treated as any other, since the trajectory moves with an error that all stations share: such directions carry no
information. Names are those of :class:`tsgt.model.SetupCovariance`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry import exp_so3
from tsgt.geometry.trajectory import STATE_DIM, initial_guess, knot_times, line_of_sight_axes, solve

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray
    from tsgt.geometry.trajectory import LinearisedMeasurements, Observations, Solution
    from tsgt.model import MotionPrior, SetupCovariance

FRAME = ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")
DRIFT = tuple(f"drift_{axis}" for axis in FRAME)
INSTRUMENT = ("latency", "vertical_index", "collimation", "prism_constant", "range_scale")
STATION_COMPONENTS = (*FRAME, *DRIFT, *INSTRUMENT)

NOMINAL = {
    **dict.fromkeys(FRAME[:3], 3e-3),
    **dict.fromkeys(FRAME[3:], 1e-4),
    **dict.fromkeys(DRIFT[:3], 2e-4),
    **dict.fromkeys(DRIFT[3:], 5e-6),
    "latency": 1e-3,
    "vertical_index": 1.2e-5,
    "collimation": 1.2e-5,
    "prism_constant": 5e-4,
    "range_scale": 2e-6,
}
"""One sigma of a set-up in order, where its covariance is unknown: frames from targets, instruments within their data sheets.
In m, rad and s."""

NOMINAL_PRISM_M = 5e-4
SEGMENT_S = 40.0
MAX_GAP_S = 5.0
MIN_MEASUREMENTS = 30
MAX_SEGMENTS = 20  # Evenly spread ones represent a long recording


@dataclass(frozen=True, slots=True)
class SetupErrors:
    """Layout of the vector: a station's components follow those of the one before; the prisms are last."""

    stations: tuple[int, ...]  # numbers, by row of the observations
    prisms: tuple[int, ...]

    def __len__(self) -> int:
        return len(STATION_COMPONENTS) * len(self.stations) + 3 * len(self.prisms)

    def of_station(self, number: int, *names: str) -> NDArray[np.intp]:
        """Rows of components of a station."""
        first = self.stations.index(number) * len(STATION_COMPONENTS)
        return np.array([first + STATION_COMPONENTS.index(name) for name in names], np.intp)

    def of_prism(self, number: int) -> NDArray[np.intp]:
        """Rows of a prism's position, (3,)."""
        first = len(self.stations) * len(STATION_COMPONENTS) + 3 * self.prisms.index(number)
        return np.arange(first, first + 3)

    def nominal_covariance(self, known: SetupCovariance | None) -> FloatArray:
        """Covariance of a set-up without faults: what is known of it, and :data:`NOMINAL` for the rest."""
        covariance = np.zeros((len(self), len(self)))
        for number in self.stations:
            for name, sigma in NOMINAL.items():
                # Station 1 defines the frame.
                exact = number == self.stations[0] and name in FRAME
                row = self.of_station(number, name)
                covariance[row, row] = 0.0 if exact else sigma**2
        for number in self.prisms:
            rows = self.of_prism(number)
            covariance[rows, rows] = NOMINAL_PRISM_M**2
        if known is not None:
            places = [(i, self._row(name)) for i, name in enumerate(known.components)]
            given = [i for i, row in places if row is not None]
            rows = np.array([row for _, row in places if row is not None], np.intp)
            covariance[rows, :] = covariance[:, rows] = 0.0
            covariance[np.ix_(rows, rows)] = np.array(known.matrix)[np.ix_(given, given)]
        return covariance

    def _row(self, component: str) -> int | None:
        owner, _, name = component.partition(".")
        kind, number = owner.rstrip("0123456789"), int(owner.lstrip("abcdefghijklmnopqrstuvwxyz") or 0)
        if kind == "station" and number in self.stations and name in STATION_COMPONENTS:
            return int(self.of_station(number, name)[0])
        if kind == "prism" and number in self.prisms and name in FRAME[:3]:
            return int(self.of_prism(number)[FRAME.index(name)])
        return None

    def corrected(self, observations: Observations, errors: FloatArray) -> Observations:
        """Return observations without these errors, (G,): frames and instruments in the points, latencies in the times."""
        points, time_s = observations.points_m.copy(), observations.time_s.copy()
        phase = drift_phase(observations.time_s)
        for row, number in enumerate(self.stations):
            own = np.flatnonzero(observations.station == row)
            at = {name: errors[self.of_station(number, name)[0]] for name in STATION_COMPONENTS}
            axes, distance_m = line_of_sight_axes(points[own])
            along = at["prism_constant"] + at["range_scale"] * distance_m
            shift = np.stack(
                [along, at["collimation"] * distance_m, -at["vertical_index"] * distance_m], axis=1
            )
            in_station = points[own] + np.einsum("mji,mj->mi", axes, shift)
            rotation = observations.frames[row, :3, :3]
            frame = np.array([at[name] for name in FRAME])
            drift = np.array([at[name] for name in DRIFT])
            moved = frame + phase[own, None] * drift
            turned = np.einsum("mij,mj->mi", exp_so3(moved[:, 3:]), in_station @ rotation.T)
            points[own] = (turned + moved[:, :3]) @ rotation
            time_s[own] -= at["latency"]
        prisms_m = errors[len(self) - 3 * len(self.prisms) :].reshape(-1, 3)
        changed = replace(observations, points_m=points, time_s=time_s, layout=observations.layout + prisms_m)
        return changed.select(np.argsort(time_s, kind="stable"))

    def jacobian(
        self, observations: Observations, linearised: LinearisedMeasurements, phase: FloatArray
    ) -> FloatArray:
        """(M, 3, G) Jacobian of the residuals by the errors; ``phase``, (M,), of :func:`drift_phase`."""
        jacobian = np.zeros((len(observations), 3, len(self)))
        distance_m = np.linalg.norm(observations.points_m, axis=1)
        for row, number in enumerate(self.stations):
            own = np.flatnonzero(observations.station == row)
            by_point = linearised.by_point[own]
            lever_arm = linearised.point_m[own] - observations.frames[row, :3, 3]
            by_rotation = np.cross(by_point, lever_arm[:, None, :])
            by_frame = np.concatenate([-by_point, by_rotation], axis=2)
            at = self.of_station(number, *FRAME)
            jacobian[own, :, at[0] : at[0] + 6] = by_frame
            at = self.of_station(number, *DRIFT)
            jacobian[own, :, at[0] : at[0] + 6] = by_frame * phase[own, None, None]
            latency, index, collimation, constant, scale = self.of_station(number, *INSTRUMENT)
            jacobian[own, :, latency] = -np.einsum("mij,mj->mi", by_point, linearised.velocity_mps[own])
            jacobian[own, 2, index] = distance_m[own]
            jacobian[own, 1, collimation] = -distance_m[own]
            jacobian[own, 0, constant] = -1.0
            jacobian[own, 0, scale] = -distance_m[own]
        by_layout = linearised.by_point @ linearised.rotation
        for row, number in enumerate(self.prisms):
            own = np.flatnonzero(observations.prism == row)
            at = self.of_prism(number)
            jacobian[own, :, at[0] : at[0] + 3] = by_layout[own]
        return jacobian


def drift_phase(time_s: FloatArray) -> FloatArray:
    """Scale times to -0.5 at the first measurement to 0.5 at the last, (M,)."""
    span_s = float(time_s[-1] - time_s[0])
    phase: FloatArray = (time_s - time_s[0]) / span_s - 0.5
    return phase


class Information(NamedTuple):
    """What measurements say about the errors, their trajectory eliminated: quadratic about zero errors."""

    matrix: FloatArray  # (G, G) information
    vector: FloatArray  # (G,) information times the most likely errors

    def __add__(self, other: Information) -> Information:  # type: ignore[override]
        return Information(self.matrix + other.matrix, self.vector + other.vector)


class Linearisation(NamedTuple):
    """Solved segments of a recording, corrected for some errors."""

    segments: list[Information]
    observations: Observations  # of all segments, the M measurements
    residuals_m: FloatArray  # (M, 3)
    redundancy: (
        FloatArray  # (M, 3) share of each measured component that the trajectory does not follow, 0 to 1
    )
    weights: FloatArray  # (M,)
    squared_distances: FloatArray  # (M,)
    speed_mps: FloatArray  # (M,)
    by_errors: FloatArray  # (M, 3, G) Jacobian of the residuals by the errors

    @property
    def information(self) -> Information:
        """Of all segments."""
        return Information(
            np.sum([each.matrix for each in self.segments], axis=0),
            np.sum([each.vector for each in self.segments], axis=0),
        )


def linearise_setup(
    layout: SetupErrors,
    observations: Observations,
    errors: FloatArray,
    prior: MotionPrior,
    noise: FloatArray,
) -> Linearisation:
    """Solve the trajectory of each segment, corrected for ``errors``, (G,), with the stated noise times ``noise``, (S, 3).

    Raises GeometryError: the measurements do not determine a trajectory.
    """
    changed = layout.corrected(observations, errors)
    changed = replace(changed, sigmas_m=changed.sigmas_m * noise[changed.station])
    phase = drift_phase(changed.time_s)
    information, parts = [], []
    for rows in _segments(changed.time_s, changed.prism):
        some = changed.select(rows)
        solution = solve(some, initial_guess(some, knot_times(some.time_s)), prior, reject_outliers=True)
        by_errors = layout.jacobian(some, solution.linearised, phase[rows])
        part, redundancy = _eliminate(some, solution, by_errors)
        information.append(Information(part.matrix, part.matrix @ errors + part.vector))
        speed = np.linalg.norm(solution.linearised.velocity_mps, axis=1)
        parts.append(
            (
                rows,
                solution.linearised.residuals_m,
                redundancy,
                solution.weights,
                solution.squared_distances,
                speed,
                by_errors,
            )
        )
    if not parts:
        raise GeometryError(
            f"too few measurements for a diagnosis: no {SEGMENT_S:.0f} s of them have {MIN_MEASUREMENTS}, of 3 prisms"
        )
    rows, residuals_m, redundancy, weights, squared, speed, by_errors = (
        np.concatenate(each) for each in zip(*parts, strict=True)
    )
    return Linearisation(
        information,
        changed.select(rows),
        residuals_m,
        redundancy,
        weights,
        squared,
        speed,
        by_errors,
    )


def _segments(time_s: FloatArray, prism: NDArray[np.intp]) -> Sequence[NDArray[np.intp]]:
    count = max(1, round(float(time_s[-1] - time_s[0]) / SEGMENT_S))
    edges = np.searchsorted(time_s, np.linspace(time_s[0], time_s[-1], count + 1)[1:-1])
    gaps = np.flatnonzero(np.diff(time_s) > MAX_GAP_S) + 1
    rows = np.split(np.arange(len(time_s)), np.unique(np.concatenate([edges, gaps])).astype(np.intp))
    usable = [each for each in rows if len(each) >= MIN_MEASUREMENTS and len(np.unique(prism[each])) >= 3]
    some = np.unique(np.linspace(0, len(usable) - 1, min(len(usable), MAX_SEGMENTS)).round().astype(np.intp))
    return [usable[each] for each in some]


def _eliminate(
    observations: Observations, solution: Solution, by_errors: FloatArray
) -> tuple[Information, FloatArray]:
    """Eliminate the trajectory (Schur complement): information about the errors' change, and redundancies, (M, 3)."""
    linearised = solution.linearised
    whitening = np.linalg.inv(np.linalg.cholesky(linearised.covariance(observations)))
    weighted = whitening * np.sqrt(solution.weights)[:, None, None]
    residuals = np.einsum("mij,mj->mi", weighted, linearised.residuals_m)
    by_state, by_error = weighted @ linearised.jacobian, weighted @ by_errors
    cross = np.zeros((len(solution.knots), STATE_DIM, by_error.shape[2]))
    np.add.at(cross, solution.knot_index, np.swapaxes(by_state, 1, 2) @ by_error)
    flat = by_error.reshape(-1, by_error.shape[2])
    matrix = flat.T @ flat - np.tensordot(cross, solution.factor.solve(cross), axes=((0, 1), (0, 1)))
    covariance, _ = solution.factor.marginals()
    own = np.einsum(
        "mij,mjk,mik->mi",
        linearised.jacobian,
        covariance[solution.knot_index],
        linearised.jacobian,
        optimize=True,
    )
    noise = np.diagonal(linearised.covariance(observations), axis1=1, axis2=2)
    redundancy = 1.0 - solution.weights[:, None] * own / noise
    return Information(0.5 * (matrix + matrix.T), -flat.T @ residuals.ravel()), redundancy
