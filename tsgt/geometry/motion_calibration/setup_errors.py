"""Errors of a set-up as one vector, and what the measurements of a moving robot say about them. Sans-I/O.

Beside the parameters of a calibration from motion these errors contain drifts during the recording, and station 1 is treated as
any other, since the trajectory moves with an error that all stations share: such directions carry no information. For three
stations and prisms the vector has 60 components: of each station its frame, the drift of its frame from the start to
the end of the recording, latency, vertical index, collimation, constant and scale of the range; of each prism its position.
Names are those of :class:`tsgt.model.SetupCovariance`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.geometry.motion_calibration.information import Information
from tsgt.geometry.motion_calibration.joint_system import eliminate_trajectory, segment_rows
from tsgt.geometry.motion_calibration.setup_parameters import (
    INSTRUMENT_ERRORS,
    Setup,
    by_displacements,
    by_instrument_errors,
)
from tsgt.geometry.rigid import exp_so3, matvec, rotate
from tsgt.geometry.trajectory import initial_guess, knot_times, solve

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory import LinearisedMeasurements, Observations, Solution
    from tsgt.model import MotionPrior, SetupCovariance

FRAME = ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")
DRIFT = tuple(f"drift_{axis}" for axis in FRAME)
STATION_COMPONENTS = (*FRAME, *DRIFT, "latency", *INSTRUMENT_ERRORS)

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
        setup = replace(
            Setup.of(observations),
            instrument=np.stack([errors[self.of_station(n, *INSTRUMENT_ERRORS)] for n in self.stations]),
        )
        points, time_s = setup.corrected_points(observations).copy(), observations.time_s.copy()
        phase = drift_phase(observations.time_s)
        for row, number in enumerate(self.stations):
            own = np.flatnonzero(observations.station == row)
            rotation = observations.frames[row, :3, :3]
            frame, drift = errors[self.of_station(number, *FRAME)], errors[self.of_station(number, *DRIFT)]
            moved = frame + phase[own, None] * drift
            turned = rotate(exp_so3(moved[:, 3:]), points[own] @ rotation.T)
            points[own] = (turned + moved[:, :3]) @ rotation
            time_s[own] -= errors[self.of_station(number, "latency")]
        prisms_m = errors[len(self) - 3 * len(self.prisms) :].reshape(-1, 3)
        changed = replace(observations, points_m=points, time_s=time_s, layout=observations.layout + prisms_m)
        return changed.select(np.argsort(time_s, kind="stable"))

    def jacobian(
        self, observations: Observations, linearised: LinearisedMeasurements, phase: FloatArray
    ) -> FloatArray:
        """(M, 3, G) Jacobian of the residuals by the errors; ``phase``, (M,), of :func:`drift_phase`."""
        jacobian = np.zeros((len(observations), 3, len(self)))
        each = np.arange(3)
        by_frame = by_displacements(linearised, observations.frames[observations.station, :3, 3])
        by_latency = -matvec(linearised.by_point, linearised.velocity_mps)
        by_instrument = by_instrument_errors(observations, linearised, Setup.of(observations))
        for row, number in enumerate(self.stations):
            own = np.flatnonzero(observations.station == row)
            jacobian[np.ix_(own, each, self.of_station(number, *FRAME))] = by_frame[own]
            drifting = by_frame[own] * phase[own, None, None]
            jacobian[np.ix_(own, each, self.of_station(number, *DRIFT))] = drifting
            jacobian[own, :, self.of_station(number, "latency")[0]] = by_latency[own]
            at = self.of_station(number, *INSTRUMENT_ERRORS)
            jacobian[np.ix_(own, each, at)] = by_instrument[own]
        by_layout = linearised.by_point @ linearised.rotation
        for row, number in enumerate(self.prisms):
            own = np.flatnonzero(observations.prism == row)
            jacobian[np.ix_(own, each, self.of_prism(number))] = by_layout[own]
        return jacobian


def drift_phase(time_s: FloatArray) -> FloatArray:
    """Scale times to -0.5 at the first measurement to 0.5 at the last, (M,)."""
    span_s = float(time_s[-1] - time_s[0])
    phase: FloatArray = (time_s - time_s[0]) / span_s - 0.5
    return phase


class LinearisedSetup(NamedTuple):
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
) -> LinearisedSetup:
    """Solve the trajectory of each segment, corrected for ``errors``, (G,), with the stated noise times ``noise``, (S, 3).

    Raises GeometryError: the measurements do not determine a trajectory.
    """
    changed = layout.corrected(observations, errors)
    changed = replace(changed, sigmas_m=changed.sigmas_m * noise[changed.station])
    phase = drift_phase(changed.time_s)
    information, parts = [], []
    for rows in segment_rows(changed.time_s, changed.prism, max_segments=MAX_SEGMENTS):
        some = changed.select(rows)
        solution = solve(some, initial_guess(some, knot_times(some.time_s)), prior, reject_outliers=True)
        by_errors = layout.jacobian(some, solution.linearised, phase[rows])
        part = eliminate_trajectory(some, solution, by_errors)
        matrix = 0.5 * (part.information + part.information.T)
        information.append(Information(matrix, matrix @ errors - part.gradient))
        redundancy = _redundancy(some, solution)
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
    rows, residuals_m, redundancy, weights, squared, speed, by_errors = (
        np.concatenate(each) for each in zip(*parts, strict=True)
    )
    return LinearisedSetup(
        information,
        changed.select(rows),
        residuals_m,
        redundancy,
        weights,
        squared,
        speed,
        by_errors,
    )


def _redundancy(observations: Observations, solution: Solution) -> FloatArray:
    """(M, 3) share of each measured component that the trajectory does not follow."""
    linearised = solution.linearised
    covariance, _ = solution.factor.marginals()
    own = np.einsum(
        "mij,mjk,mik->mi",
        linearised.jacobian,
        covariance[solution.knot_index],
        linearised.jacobian,
        optimize=True,
    )
    noise = np.diagonal(linearised.covariance(observations), axis1=1, axis2=2)
    redundancy: FloatArray = 1.0 - solution.weights[:, None] * own / noise
    return redundancy
