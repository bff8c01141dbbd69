"""What a calibration from motion may change: stations' frames, latencies, prism positions, as one vector. Pure.

Station 1 (row 0) holds frame and time. A frame changes by a shift of the robot as the station sees it, and by a turn about a
pivot in the middle of all measurements, both along the axes of frame ``station1``: so a shift is what happens at the robot.
Prisms move against each other only, since where the robot has its origin no motion can tell.
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
    """What to find, and what is known of it before the motion is looked at: one sigma each, 0 for what is held.

    Attributes
    ----------
    shift_sigma_m
        Of each coordinate of the robot as one of the stations 2, 3, ... sees it.
    turn_sigma_rad
        Of a station's turn about each axis.
    levelled
        Stations turn about the vertical only: 4 instead of 6 degrees of freedom.
    latency_sigma_s
        Of a station's latency beside that of station 1.
    prism_sigma_m
        Of each coordinate of a prism on the robot.
    """

    translation_sigma_m: float = 0.0
    rotation_sigma_rad: float = 0.0
    levelled: bool = False
    latency_sigma_s: float = 0.0
    prism_sigma_m: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """What is common to all measurements.

    Attributes
    ----------
    frames
        (S, 4, 4) ``T_station1_station``.
    latencies_s
        (S,) how much later than their instants the measurements are stamped, beyond what has been taken off.
    layout
        (P, 3) prisms in the robot frame in m.
    """

    frames: FloatArray
    latencies_s: FloatArray
    layout: FloatArray

    @classmethod
    def of(cls, observations: Observations) -> Setup:
        """Return the set-up that observations have."""
        return cls(observations.frames, np.zeros(len(observations.frames)), observations.layout)

    def applied(self, observations: Observations) -> Observations:
        """Return the observations with this set-up, in the order of time; they must have no latency of their own."""
        time_s = observations.time_s - self.latencies_s[observations.station]
        moved = replace(observations, time_s=time_s, frames=self.frames, layout=self.layout)
        return moved.select(np.argsort(time_s, kind="stable"))

    def corrections(self, was: Setup, pivot: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How far each station's frame has moved since it ``was``, (S, 3) at a pivot in m, and turned, (S, 3) in rad."""
        back = np.swapaxes(was.frames[:, :3, :3], 1, 2)
        seen = rotate(back, pivot - was.frames[:, :3, 3])
        shift = rotate(self.frames[:, :3, :3], seen) + self.frames[:, :3, 3] - pivot
        return shift, log_so3(self.frames[:, :3, :3] @ back)

    def levelled(self, pivot: FloatArray, stations: NDArray[np.intp]) -> Setup:
        """Return the same with the tilts against station 1 taken out of some frames, turned about a pivot."""
        frames = self.frames.copy()
        up = frames[0, :3, 2]
        for station in stations:
            own = frames[station, :3, 2]
            axis = np.cross(own, up)
            sine = float(np.linalg.norm(axis))
            if sine > 0.0:
                turn = exp_so3(axis / sine * np.arctan2(sine, float(own @ up)))
                frames[station, :3, :3] = turn @ frames[station, :3, :3]
                frames[station, :3, 3] = pivot + turn @ (frames[station, :3, 3] - pivot)
        return replace(self, frames=frames)


@dataclass(frozen=True, slots=True, eq=False)
class SetupParameters:
    """The unknowns as a vector of G numbers.

    Attributes
    ----------
    began
        The set-up about which they are known.
    pivot
        (3,) the middle of all measurements in frame ``station1``, about which stations turn.
    stations
        Rows of the stations whose frame or latency is unknown.
    shifts, turns
        (n, 3) and (n, 3 or 1) where in the vector each such station's are; turns about z only if there is one. n is 0
        where frames are held.
    latencies
        (n,) where each station's latency is; empty where they are held.
    prisms
        (3 P - 6,) where the prisms' are; empty where they are held.
    sigmas
        (G,) what is known beforehand.
    """

    reference: Setup
    pivot: FloatArray
    stations: NDArray[np.intp]
    translations: NDArray[np.intp]
    rotations: NDArray[np.intp]
    latencies: NDArray[np.intp]
    prisms: NDArray[np.intp]
    sigmas: FloatArray

    @classmethod
    def of(cls, observations: Observations, setup: Setup, known: SetupPrior) -> SetupParameters:
        """Count the unknowns of a set-up that observations have.

        Raises
        ------
        GeometryError
            Nothing to find, station 1 has measured nothing, or a measurement is not polar.
        """
        if not observations.polar.all():
            raise GeometryError(
                "points in frame 1 do not tell what their stations measured; import the recording with its targets"
            )
        seen = np.unique(observations.station)
        if 0 not in seen:
            raise GeometryError(
                "station 1 has measured nothing; frames and latencies are those beside station 1"
            )
        stations = seen[seen > 0]
        sigmas: list[float] = []

        def take(wanted: list[float]) -> NDArray[np.intp]:
            sigmas.extend(wanted)
            return np.arange(len(sigmas) - len(wanted), len(sigmas))

        frames = stations if known.translation_sigma_m > 0 else stations[:0]
        turning = 1 if known.levelled else 3
        translations = [take([known.translation_sigma_m] * 3) for _ in frames]
        rotations = [take([known.rotation_sigma_rad] * turning) for _ in frames]
        latencies = take([known.latency_sigma_s] * len(stations) if known.latency_sigma_s > 0 else [])
        free = max(3 * len(setup.layout) - 6, 0) if known.prism_sigma_m > 0 else 0
        prisms = take([known.prism_sigma_m] * free)
        if not sigmas:
            raise GeometryError("nothing to find: frames, latencies and prisms are all held")
        return cls(
            reference=setup,
            pivot=observations.in_world().mean(axis=0),
            stations=stations,
            translations=np.array(translations, np.intp).reshape(-1, 3),
            rotations=np.array(rotations, np.intp).reshape(-1, turning),
            latencies=latencies,
            prisms=prisms,
            sigmas=np.array(sigmas),
        )

    def retract(self, setup: Setup, move: FloatArray) -> Setup:
        """Return a set-up with (G,) changes."""
        frames, latencies_s = setup.frames.copy(), setup.latencies_s.copy()
        for station, shift, turn in zip(self.stations, self.translations, self.rotations, strict=False):
            correction = np.eye(4)
            correction[:3, :3] = exp_so3(about_axes(move[turn]))
            correction[:3, 3] = self.pivot - correction[:3, :3] @ self.pivot + move[shift]
            frames[station] = correction @ frames[station]
        if len(self.latencies):
            latencies_s[self.stations] += move[self.latencies]
        layout = setup.layout
        if len(self.prisms):
            layout = layout + (deformation_modes(layout) @ move[self.prisms]).reshape(-1, 3)
        return Setup(frames, latencies_s, layout)

    def local_coordinates(self, setup: Setup) -> FloatArray:
        """(G,) how far a set-up is from the one that it began with."""
        found = np.zeros(len(self.sigmas))
        shift, turn = setup.corrections(self.reference, self.pivot)
        for station, at_shift, at_turn in zip(self.stations, self.translations, self.rotations, strict=False):
            found[at_shift] = shift[station]
            found[at_turn] = turn[station][-len(at_turn) :]
        if len(self.latencies):
            found[self.latencies] = (setup.latencies_s - self.reference.latencies_s)[self.stations]
        if len(self.prisms):
            found[self.prisms] = (
                deformation_modes(setup.layout).T @ (setup.layout - self.reference.layout).ravel()
            )
        return found

    def jacobian(
        self, observations: Observations, linearised: LinearisedMeasurements, setup: Setup
    ) -> FloatArray:
        """(M, 3, G) how the residuals change with the unknowns."""
        found = np.zeros((len(observations), 3, len(self.sigmas)))
        arms = skew(linearised.point_m - self.pivot)
        for place, station in enumerate(self.stations):
            rows = np.flatnonzero(observations.station == station)
            by_point = linearised.by_point[rows]
            if len(self.translations):
                rotations = self.rotations[place]
                found[np.ix_(rows, np.arange(3), self.translations[place])] = -by_point
                found[np.ix_(rows, np.arange(3), rotations)] = (by_point @ arms[rows])[
                    :, :, -len(rotations) :
                ]
            if len(self.latencies):
                found[rows, :, self.latencies[place]] = -rotate(by_point, linearised.velocity_mps[rows])
        if len(self.prisms):
            by_unknown = deformation_modes(setup.layout).reshape(-1, 3, len(self.prisms))
            found[:, :, self.prisms] = (
                linearised.by_point @ linearised.rotation @ by_unknown[observations.prism]
            )
        return found


def about_axes(turn: FloatArray) -> FloatArray:
    """(3,) a turn about x, y and z; of a turn about z alone the others are 0."""
    return np.concatenate([np.zeros(3 - len(turn)), turn])


def deformation_modes(layout: FloatArray) -> FloatArray:
    """(3 P, 3 P - 6) orthonormal displacements of the prisms that no motion of the whole robot makes."""
    centred = layout - layout.mean(axis=0)
    rigid = np.concatenate([np.tile(np.eye(3), (len(layout), 1)), -skew(centred).reshape(-1, 3)], axis=1)
    whole, _, _ = np.linalg.svd(rigid, full_matrices=True)
    return whole[:, 6:]
