"""Parameters of a calibration from motion: station frames, latencies and prism positions as one vector. Sans-I/O.

Station 1 (row 0) defines frame and time. A frame is corrected by a translation and by a rotation about a pivot at the
centroid of all measurements, both in the axes of frame ``station1``: the translation is the displacement at the robot.
Prisms move only relative to each other, since the motion does not determine the robot's origin.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.rigid import exp_so3, log_so3, rotate, skew

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory import LinearisedMeasurements, Observations


@dataclass(frozen=True, slots=True, kw_only=True)
class SetupPrior:
    """What to estimate, and its prior: one sigma each, 0 for what is fixed."""

    translation_sigma_m: float = 0.0  # Of each coordinate of the robot as seen by each station but the first
    rotation_sigma_rad: float = 0.0  # Of a station's rotation about each axis
    levelled: bool = False  # Stations rotate about the vertical only: 4 instead of 6 degrees of freedom
    latency_sigma_s: float = 0.0  # Of a station's latency relative to that of station 1
    prism_sigma_m: float = 0.0  # Of each coordinate of a prism on the robot


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """What is common to all measurements."""

    frames: FloatArray  # (S, 4, 4) ``T_station1_station``
    latencies_s: FloatArray  # (S,) delay of the timestamps, beyond the correction already applied
    layout: FloatArray  # (P, 3) prisms in the robot frame in m

    @classmethod
    def of(cls, observations: Observations) -> Setup:
        """Return the set-up of observations."""
        return cls(observations.frames, np.zeros(len(observations.frames)), observations.layout)

    def applied(self, observations: Observations) -> Observations:
        """Return observations, whose latencies must be zero, with this set-up, in the order of time."""
        time_s = observations.time_s - self.latencies_s[observations.station]
        updated = replace(observations, time_s=time_s, frames=self.frames, layout=self.layout)
        return updated.select(np.argsort(time_s, kind="stable"))

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
    """Layout of the G parameters in one vector: indices of each kind, empty where it is fixed."""

    reference: Setup  # the set-up about which the prior holds
    pivot: FloatArray  # (3,) centroid of all measurements in frame ``station1``, about which stations rotate
    stations: NDArray[np.intp]  # (n,) rows of the stations whose frame or latency is estimated
    translations: NDArray[np.intp]  # (n, 3)
    rotations: NDArray[np.intp]  # (n, 3), or (n, 1) about z
    latencies: NDArray[np.intp]  # (n,)
    prisms: NDArray[np.intp]  # (3 P - 6,) of the deformation modes
    sigmas: FloatArray  # (G,) of the prior

    @classmethod
    def of(cls, observations: Observations, setup: Setup, prior: SetupPrior) -> SetupParameters:
        """Lay out the parameters of a set-up that observations have.

        Raises GeometryError: nothing to estimate, station 1 has measured nothing, or a measurement is not polar.
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
        stations = measured[measured > 0]
        sigmas: list[float] = []

        def allocate(wanted: list[float]) -> NDArray[np.intp]:
            sigmas.extend(wanted)
            return np.arange(len(sigmas) - len(wanted), len(sigmas))

        frames = stations if prior.translation_sigma_m > 0 else stations[:0]
        rotation_axes = 1 if prior.levelled else 3
        translations = [allocate([prior.translation_sigma_m] * 3) for _ in frames]
        rotations = [allocate([prior.rotation_sigma_rad] * rotation_axes) for _ in frames]
        latencies = allocate([prior.latency_sigma_s] * len(stations) if prior.latency_sigma_s > 0 else [])
        modes = max(3 * len(setup.layout) - 6, 0) if prior.prism_sigma_m > 0 else 0
        prisms = allocate([prior.prism_sigma_m] * modes)
        if not sigmas:
            raise GeometryError("nothing to estimate: frames, latencies and prisms are all fixed")
        return cls(
            reference=setup,
            pivot=observations.in_world().mean(axis=0),
            stations=stations,
            translations=np.array(translations, np.intp).reshape(-1, 3),
            rotations=np.array(rotations, np.intp).reshape(-1, rotation_axes),
            latencies=latencies,
            prisms=prisms,
            sigmas=np.array(sigmas),
        )

    def retract(self, setup: Setup, step: FloatArray) -> Setup:
        """Apply a step, (G,), to a set-up."""
        frames, latencies_s = setup.frames.copy(), setup.latencies_s.copy()
        for station, translation, rotation in zip(
            self.stations, self.translations, self.rotations, strict=False
        ):
            correction = np.eye(4)
            correction[:3, :3] = exp_so3(about_axes(step[rotation]))
            correction[:3, 3] = self.pivot - correction[:3, :3] @ self.pivot + step[translation]
            frames[station] = correction @ frames[station]
        if len(self.latencies):
            latencies_s[self.stations] += step[self.latencies]
        layout = setup.layout
        if len(self.prisms):
            layout = layout + (deformation_modes(layout) @ step[self.prisms]).reshape(-1, 3)
        return Setup(frames, latencies_s, layout)

    def local_coordinates(self, setup: Setup) -> FloatArray:
        """(G,) difference of a set-up from the reference."""
        coordinates = np.zeros(len(self.sigmas))
        translation, rotation = setup.corrections(self.reference, self.pivot)
        for station, at_translation, at_rotation in zip(
            self.stations, self.translations, self.rotations, strict=False
        ):
            coordinates[at_translation] = translation[station]
            coordinates[at_rotation] = rotation[station][-len(at_rotation) :]
        if len(self.latencies):
            coordinates[self.latencies] = (setup.latencies_s - self.reference.latencies_s)[self.stations]
        if len(self.prisms):
            coordinates[self.prisms] = (
                deformation_modes(setup.layout).T @ (setup.layout - self.reference.layout).ravel()
            )
        return coordinates

    def jacobian(
        self, observations: Observations, linearised: LinearisedMeasurements, setup: Setup
    ) -> FloatArray:
        """(M, 3, G) Jacobian of the residuals by the parameters."""
        jacobian = np.zeros((len(observations), 3, len(self.sigmas)))
        lever_arms = skew(linearised.point_m - self.pivot)
        for i, station in enumerate(self.stations):
            rows = np.flatnonzero(observations.station == station)
            by_point = linearised.by_point[rows]
            if len(self.translations):
                rotation = self.rotations[i]
                jacobian[np.ix_(rows, np.arange(3), self.translations[i])] = -by_point
                jacobian[np.ix_(rows, np.arange(3), rotation)] = (by_point @ lever_arms[rows])[
                    :, :, -len(rotation) :
                ]
            if len(self.latencies):
                jacobian[rows, :, self.latencies[i]] = -rotate(by_point, linearised.velocity_mps[rows])
        if len(self.prisms):
            modes = deformation_modes(setup.layout).reshape(-1, 3, len(self.prisms))
            jacobian[:, :, self.prisms] = (
                linearised.by_point @ linearised.rotation @ modes[observations.prism]
            )
        return jacobian


def about_axes(rotation: FloatArray) -> FloatArray:
    """(3,) rotation vector from three components or from that about z alone."""
    return np.concatenate([np.zeros(3 - len(rotation)), rotation])


def deformation_modes(layout: FloatArray) -> FloatArray:
    """(3 P, 3 P - 6) orthonormal displacements of the prisms orthogonal to all rigid motions."""
    centred = layout - layout.mean(axis=0)
    rigid = np.concatenate([np.tile(np.eye(3), (len(layout), 1)), -skew(centred).reshape(-1, 3)], axis=1)
    basis, _, _ = np.linalg.svd(rigid, full_matrices=True)
    return basis[:, 6:]
