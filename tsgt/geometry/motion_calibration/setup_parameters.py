"""The set-up of a day as one vector of parameters: frames, latencies, instrument errors and prism positions. Sans-I/O.

Station 1 (row 0) defines frame and time; instrument errors are those of all stations. A frame is corrected by a translation
and by a rotation about a pivot near the robot, both in the axes of frame ``station1``: the translation is the displacement
at the robot. A prior on the parameters is a factor L, (G, r), of their covariance ``L L^T``: what is fixed has zeros there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.polar import MIN_SINE, cartesian_to_polar, polar_to_cartesian
from tsgt.geometry.rigid import dot, exp_so3, log_so3, matvec, rotate, skew
from tsgt.geometry.trajectory.measurement_factors import line_of_sight_axes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory import LinearisedMeasurements, Observations

INSTRUMENT_ERRORS = ("vertical_index", "collimation", "prism_constant", "range_scale")
"""Columns of :attr:`Setup.instrument`, in rad, rad, m and 1, as the parameters of a station name them."""


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """What is common to all measurements."""

    frames: FloatArray  # (S, 4, 4) ``T_station1_station``
    latencies_s: FloatArray  # (S,) delay of the timestamps, beyond the correction already applied
    # (S, 4) instrument errors beyond the corrections already applied, of measurements in the first face
    instrument: FloatArray
    layout: FloatArray  # (P, 3) prisms in m, in the axes of the robot, from the reference point of the states

    @classmethod
    def of(cls, observations: Observations) -> Setup:
        """Return the set-up of observations."""
        count = len(observations.frames)
        return cls(
            observations.frames,
            np.zeros(count),
            np.zeros((count, len(INSTRUMENT_ERRORS))),
            observations.layout,
        )

    def applied(self, observations: Observations) -> Observations:
        """Return observations, which nothing of this set-up has corrected yet, with this set-up, in the order of time."""
        updated = self.applied_in_place(observations)
        return updated.select(np.argsort(updated.time_s, kind="stable"))

    def applied_in_place(self, observations: Observations) -> Observations:
        """Return the same in the given order, which may no longer be that of time."""
        return replace(
            observations,
            time_s=observations.time_s - self.latencies_s[observations.station],
            points_m=self.corrected_points(observations),
            frames=self.frames,
            layout=self.layout,
        )

    def corrected_points(self, observations: Observations) -> FloatArray:
        """(M, 3) measured points without instrument errors."""
        if not self.instrument.any():
            return observations.points_m
        index, collimation, constant_m, scale = self.instrument[observations.station].T
        horizontal, zenith, distance_m = cartesian_to_polar(observations.points_m)
        corrected: FloatArray = polar_to_cartesian(
            horizontal + collimation / np.maximum(np.sin(zenith), MIN_SINE),
            zenith - index,
            distance_m * (1.0 + scale) + constant_m,
        )
        return np.where(observations.polar[:, None], corrected, observations.points_m)

    def corrections(self, reference: Setup, pivot: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Corrections of each station's frame from a reference: translation at the pivot in m, rotation in rad, (S, 3) each."""
        station_from_reference = np.swapaxes(reference.frames[:, :3, :3], 1, 2)
        pivot_in_station = rotate(station_from_reference, pivot - reference.frames[:, :3, 3])
        translation = rotate(self.frames[:, :3, :3], pivot_in_station) + self.frames[:, :3, 3] - pivot
        return translation, log_so3(self.frames[:, :3, :3] @ station_from_reference)

    def levelled(self, pivot: FloatArray, stations: NDArray[np.intp]) -> Setup:
        """Return the set-up with the tilts of some stations against station 1 removed, rotated about a pivot."""
        frames = self.frames.copy()
        up = frames[0, :3, 2]
        for station in stations:
            own_up = frames[station, :3, 2]
            axis = np.cross(own_up, up)
            sine = float(np.linalg.norm(axis))
            if sine > 0.0:
                levelling = exp_so3(axis / sine * np.arctan2(sine, float(own_up @ up)))
                frames[station, :3, :3] = levelling @ frames[station, :3, :3]
                frames[station, :3, 3] = pivot + levelling @ (frames[station, :3, 3] - pivot)
        return replace(self, frames=frames)


@dataclass(frozen=True, slots=True, eq=False)
class SetupParameters:
    """Layout of the G parameters in one vector: indices of each kind."""

    reference: Setup  # the set-up at which all parameters are zero
    pivot: FloatArray  # (3,) in frame ``station1``, about which stations rotate
    measured: NDArray[np.intp]  # (n + 1,) rows of the stations whose instrument errors are parameters
    stations: NDArray[np.intp]  # (n,) the same without station 1, whose frame and time are fixed
    translations: NDArray[np.intp]  # (n, 3)
    rotations: NDArray[np.intp]  # (n, 3)
    latencies: NDArray[np.intp]  # (n,)
    instrument: NDArray[np.intp]  # (n + 1, 4) in the order of ``measured`` and of :data:`INSTRUMENT_ERRORS`
    prisms: NDArray[np.intp]  # (P, 3)
    count: int  # G

    @classmethod
    def of(
        cls, setup: Setup, pivot: FloatArray, stations: Sequence[int] | NDArray[np.intp]
    ) -> SetupParameters:
        """Lay out the parameters of a set-up; ``stations``: rows of all stations that measure, station 1 first."""
        measured = np.asarray(stations, np.intp)
        others = len(measured) - 1
        sizes = [3 * others, 3 * others, others, 4 * len(measured), setup.layout.size]
        edges = np.cumsum([0, *sizes])
        indices = [np.arange(start, stop) for start, stop in pairwise(edges)]
        return cls(
            reference=setup,
            pivot=pivot,
            measured=measured,
            stations=measured[1:],
            translations=indices[0].reshape(-1, 3),
            rotations=indices[1].reshape(-1, 3),
            latencies=indices[2],
            instrument=indices[3].reshape(-1, 4),
            prisms=indices[4].reshape(-1, 3),
            count=int(edges[-1]),
        )

    @classmethod
    def of_observations(cls, observations: Observations, setup: Setup) -> SetupParameters:
        """Lay out the parameters of a set-up that observations have, with their centroid as the pivot.

        Raises GeometryError: station 1 has measured nothing, or a measurement is not polar.
        """
        if not observations.polar.all():
            raise GeometryError(
                "points in frame station1 are no polar measurements of their stations; import the recording with its targets"
            )
        measured = np.unique(observations.station)
        if 0 not in measured:
            raise GeometryError(
                "station 1 has measured nothing; frames and latencies are relative to station 1"
            )
        return cls.of(setup, observations.in_world().mean(axis=0), measured)

    def names(self, stations: Sequence[int], prisms: Sequence[int]) -> list[str]:
        """Names of the parameters as components of a set-up covariance have them, by station and prism numbers."""
        names = [""] * self.count
        for i, row in enumerate(self.stations):
            for axis, at in zip("xyz", self.translations[i], strict=True):
                names[at] = f"station{stations[row]}.{axis}"
            for axis, at in zip("xyz", self.rotations[i], strict=True):
                names[at] = f"station{stations[row]}.rotation_{axis}"
            names[self.latencies[i]] = f"station{stations[row]}.latency"
        for i, row in enumerate(self.measured):
            for error, at in zip(INSTRUMENT_ERRORS, self.instrument[i], strict=True):
                names[at] = f"station{stations[row]}.{error}"
        for row, prism in enumerate(prisms):
            for axis, at in zip("xyz", self.prisms[row], strict=True):
                names[at] = f"prism{prism}.{axis}"
        return names

    def from_station_origins(self) -> FloatArray:
        """(G, G) matrix that takes displacements of the stations' origins to those at the pivot, all else unchanged."""
        matrix = np.eye(self.count)
        for i, row in enumerate(self.stations):
            lever_arm = self.pivot - self.reference.frames[row, :3, 3]
            matrix[np.ix_(self.translations[i], self.rotations[i])] = -skew(lever_arm)
        return matrix

    def retract(self, setup: Setup, step: FloatArray) -> Setup:
        """Apply a step, (G,), to a set-up."""
        frames, latencies_s = setup.frames.copy(), setup.latencies_s.copy()
        for i, station in enumerate(self.stations):
            correction = np.eye(4)
            correction[:3, :3] = exp_so3(step[self.rotations[i]])
            correction[:3, 3] = self.pivot - correction[:3, :3] @ self.pivot + step[self.translations[i]]
            frames[station] = correction @ frames[station]
        latencies_s[self.stations] += step[self.latencies]
        instrument = setup.instrument.copy()
        instrument[self.measured] += step[self.instrument]
        return Setup(frames, latencies_s, instrument, setup.layout + step[self.prisms])

    def local_coordinates(self, setup: Setup) -> FloatArray:
        """(G,) difference of a set-up from the reference."""
        coordinates = np.zeros(self.count)
        translation, rotation = setup.corrections(self.reference, self.pivot)
        coordinates[self.translations] = translation[self.stations]
        coordinates[self.rotations] = rotation[self.stations]
        coordinates[self.latencies] = (setup.latencies_s - self.reference.latencies_s)[self.stations]
        coordinates[self.instrument] = (setup.instrument - self.reference.instrument)[self.measured]
        coordinates[self.prisms] = setup.layout - self.reference.layout
        return coordinates

    def jacobian(
        self, observations: Observations, linearised: LinearisedMeasurements, setup: Setup
    ) -> FloatArray:
        """(M, 3, G) Jacobian of the residuals, of observations with this set-up, by the parameters."""
        blocks = np.concatenate(
            [
                by_displacements(linearised, self.pivot),
                -linearised.by_point @ linearised.velocity_mps[:, :, None],
                by_instrument_errors(observations, linearised, setup),
                linearised.by_point @ linearised.rotation,
            ],
            axis=2,
        )
        # Columns of the blocks; those of what is no parameter come last, and are dropped.
        of_station = np.full((len(observations.frames), 11), self.count, np.intp)
        of_station[self.stations] = np.concatenate(
            [self.translations, self.rotations, self.latencies[:, None], of_station[self.stations, 7:]],
            axis=1,
        )
        of_station[self.measured, 7:] = self.instrument
        columns = np.concatenate([of_station[observations.station], self.prisms[observations.prism]], axis=1)
        jacobian = np.zeros((len(observations), 3, self.count + 1))
        np.put_along_axis(jacobian, columns[:, None], blocks, axis=2)
        return jacobian[:, :, : self.count]

    def point_jacobian(self, points_m: FloatArray, velocities_mps: FloatArray, station: int) -> FloatArray:
        """(N, 3, G) displacement in frame ``station1`` of a station's measured points, (N, 3), at a given time."""
        jacobian = np.zeros((len(points_m), 3, self.count))
        for i in np.flatnonzero(self.stations == station):
            jacobian[:, :, self.translations[i]] = np.eye(3)
            jacobian[:, :, self.rotations[i]] = -skew(points_m - self.pivot)
            jacobian[:, :, self.latencies[i]] = velocities_mps
        frame = self.reference.frames[station]
        axes, distance_m = line_of_sight_axes((points_m - frame[:3, 3]) @ frame[:3, :3])
        along, horizontal, vertical = np.moveaxis(axes @ frame[:3, :3].T, 1, 0)
        for i in np.flatnonzero(self.measured == station):
            index, collimation, constant, scale = self.instrument[i]
            jacobian[:, :, index] = -distance_m[:, None] * vertical
            jacobian[:, :, collimation] = distance_m[:, None] * horizontal
            jacobian[:, :, constant] = along
            jacobian[:, :, scale] = distance_m[:, None] * along
        return jacobian


def by_displacements(linearised: LinearisedMeasurements, pivot: FloatArray) -> FloatArray:
    """(M, 3, 6) Jacobian of the residuals by a displacement of the station: translation, and rotation about (M, 3) or (3,)."""
    by_rotation = linearised.by_point @ skew(linearised.point_m - pivot)
    return np.concatenate([-linearised.by_point, by_rotation], axis=2)


def by_instrument_errors(
    observations: Observations, linearised: LinearisedMeasurements, setup: Setup
) -> FloatArray:
    """(M, 3, 4) Jacobian of the residuals by the instrument errors of the station; zero for Cartesian points."""
    frames = observations.frames[observations.station]
    predicted = matvec(np.swapaxes(frames[:, :3, :3], 1, 2), linearised.point_m - frames[:, :3, 3])
    direction = predicted / np.sqrt(dot(predicted, predicted))[:, None]
    axes, distance_m = line_of_sight_axes(observations.points_m)
    along, across = dot(axes[:, 0], direction), dot(axes[:, 1], direction)
    sine, cosine = np.maximum(-axes[:, 2, 2], MIN_SINE), axes[:, 0, 2]
    # Component away from the station's vertical axis.
    outward = (axes[:, 0, 0] * direction[:, 0] + axes[:, 0, 1] * direction[:, 1]) / sine
    by_error = np.zeros((len(observations), 3, 4))
    by_error[:, 2, 0] = distance_m * along
    by_error[:, 1, 1] = -distance_m * outward / sine
    by_error[:, 2, 1] = distance_m * cosine * across / sine
    by_error[:, 0, 2] = -1.0
    by_error[:, 1:, 2] = linearised.residuals_m[:, 1:] / distance_m[:, None]
    _, _, constant_m, scale = setup.instrument[observations.station].T
    by_error[:, :, 3] = by_error[:, :, 2] * ((distance_m - constant_m) / (1.0 + scale))[:, None]
    by_error[~observations.polar] = 0.0
    return by_error


def deformation_modes(layout: FloatArray) -> FloatArray:
    """(3 P, 3 P - 6) orthonormal displacements of the prisms orthogonal to all rigid motions."""
    centred = layout - layout.mean(axis=0)
    rigid = np.concatenate([np.tile(np.eye(3), (len(layout), 1)), -skew(centred).reshape(-1, 3)], axis=1)
    basis, _, _ = np.linalg.svd(rigid, full_matrices=True)
    return basis[:, 6:]
