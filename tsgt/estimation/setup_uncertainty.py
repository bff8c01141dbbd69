"""The set-up of the parameters as the estimators' vector of parameters, with its covariance, and back."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
from scipy.linalg import block_diag

from tsgt.geometry.motion_calibration import INSTRUMENT_ERRORS, Setup, SetupParameters, factor_of
from tsgt.model import SetupCovariance

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from tsgt.geometry import FloatArray
    from tsgt.geometry.trajectory import LinearisedMeasurements, Observations, SetupJacobian
    from tsgt.model import Matrix4, Parameters, StationParameters, Vector3


MOUNTING_COMPONENTS = (
    *("imu.x", "imu.y", "imu.z", "imu.rotation_x", "imu.rotation_y", "imu.rotation_z"),
    "imu.latency",
)


def parameter_names(layout: SetupParameters, parameters: Parameters) -> list[str]:
    """Return the components of a set-up covariance that the vector of parameters stands for."""
    return layout.names([s.station for s in parameters.stations], [p.prism for p in parameters.prisms])


def stated_covariance(layout: SetupParameters, parameters: Parameters) -> FloatArray | None:
    """Return the (G, G) covariance of the set-up as the parameters state it; None: unknown. What they omit is exact."""
    known = parameters.setup_covariance
    if known is None:
        return None
    covariance = _of_components(known, parameter_names(layout, parameters))
    to_pivot = layout.from_station_origins()
    result: FloatArray = to_pivot @ covariance @ to_pivot.T
    return result


def _of_components(known: SetupCovariance, names: Sequence[str]) -> FloatArray:
    """(N, N) covariance of components; those that are not stated are exact."""
    rows = {name: row for row, name in enumerate(known.components)}
    ours = [i for i, name in enumerate(names) if name in rows]
    theirs = [rows[names[i]] for i in ours]
    covariance = np.zeros((len(names), len(names)))
    covariance[np.ix_(ours, ours)] = np.array(known.matrix)[np.ix_(theirs, theirs)]
    return covariance


def setup_jacobian(parameters: Parameters) -> SetupJacobian | None:
    """Return how the residuals of observations with these parameters depend on the set-up's errors; None: unknown.

    The columns are those of a factor of the set-up's covariance.
    """
    layout = uncertain_setup(parameters)
    covariance = stated_covariance(layout, parameters)
    if covariance is None:
        return None
    factor = factor_of(covariance)

    def jacobian(observations: Observations, linearised: LinearisedMeasurements) -> FloatArray:
        by_setup: FloatArray = layout.jacobian(observations, linearised, layout.reference) @ factor
        return by_setup

    return jacobian


class InertialSetupUncertainty(NamedTuple):
    """What is uncertain of the set-up with an IMU, in the columns of a factor of the joint covariance; None: unknown."""

    setup_jacobian: SetupJacobian | None
    mounting_factor: FloatArray | None  # (7, r), as of the estimators with an IMU

    @classmethod
    def of(cls, parameters: Parameters) -> InertialSetupUncertainty:
        """Return that of the parameters. What they omit is exact, as are the gyro's matrix and sigmas of the noise."""
        known = parameters.setup_covariance
        if known is None:
            return cls(None, None)
        layout = uncertain_setup(parameters)
        count = layout.count
        covariance = _of_components(known, [*parameter_names(layout, parameters), *MOUNTING_COMPONENTS])
        to_pivot = np.eye(len(covariance))
        to_pivot[:count, :count] = layout.from_station_origins()
        factor = factor_of(to_pivot @ covariance @ to_pivot.T)

        def jacobian(observations: Observations, linearised: LinearisedMeasurements) -> FloatArray:
            by_setup: FloatArray = (
                layout.jacobian(observations, linearised, layout.reference) @ factor[:count]
            )
            return by_setup

        return cls(jacobian, factor[count:])


class PointUncertainty:
    """Displacement of measured prisms by the set-up's errors, in the columns of a factor of their covariance."""

    def __init__(self, parameters: Parameters, covariance: FloatArray, layout: SetupParameters) -> None:
        self._layout = layout
        self._factor = factor_of(covariance)
        self._rows = {station.station: row for row, station in enumerate(parameters.stations)}

    @classmethod
    def of(cls, parameters: Parameters) -> PointUncertainty | None:
        """Return that of the parameters; None: unknown."""
        layout = uncertain_setup(parameters)
        covariance = stated_covariance(layout, parameters)
        return None if covariance is None else cls(parameters, covariance, layout)

    def displacements(
        self,
        points_m: FloatArray,
        velocities_mps: FloatArray,
        stations: NDArray[np.int64],
        rotation: FloatArray,
    ) -> FloatArray:
        """(N, P, 3, r) of prisms, (N, P, 3), which these stations, (N, P), measured on a robot with rotations, (N, 3, 3).

        A prism elsewhere on the robot is to a fit what a displacement of its measurement the other way is.
        """
        found = np.zeros((*points_m.shape, self._layout.count))
        for prism in range(points_m.shape[1]):
            for number in np.unique(stations[:, prism]).tolist():
                rows = np.flatnonzero(stations[:, prism] == number)
                found[rows, prism] = self._layout.point_jacobian(
                    points_m[rows, prism], velocities_mps[rows, prism], self._rows[number]
                )
            found[:, prism][:, :, self._layout.prisms[prism]] -= rotation
        displaced: FloatArray = found @ self._factor
        return displaced


def uncertain_setup(parameters: Parameters) -> SetupParameters:
    """Return the vector of all parameters of the set-up; stations rotate about the origin of frame ``station1``."""
    frames = np.array([*(s.T_station1_station for s in parameters.stations), np.eye(4)])
    positions_m = np.array([p.position_m for p in parameters.prisms])
    setup = Setup(
        frames=frames,
        latencies_s=np.zeros(len(frames)),
        instrument=np.zeros((len(frames), len(INSTRUMENT_ERRORS))),
        layout=positions_m - positions_m.mean(axis=0),
    )
    return SetupParameters.of(setup, np.zeros(3), range(len(parameters.stations)))


def with_setup(
    parameters: Parameters, layout: SetupParameters, setup: Setup, covariance: FloatArray
) -> Parameters:
    """Return the parameters with a set-up that was estimated about theirs, and its covariance, (G, G)."""
    displacement_m = setup.layout - layout.reference.layout
    stations = tuple(_with_setup(station, setup, row) for row, station in enumerate(parameters.stations))
    prisms = tuple(
        replace(prism, position_m=cast("Vector3", tuple((prism.position_m + displacement_m[row]).tolist())))
        for row, prism in enumerate(parameters.prisms)
    )
    to_origins = np.linalg.inv(layout.from_station_origins())
    at_origins = to_origins @ covariance @ to_origins.T
    names = parameter_names(layout, parameters)
    if parameters.setup_covariance is not None:
        # What was not estimated is known as before.
        others = [each for each in parameters.setup_covariance.components if each.startswith("imu.")]
        names += others
        at_origins = block_diag(at_origins, _of_components(parameters.setup_covariance, others))
    free = np.flatnonzero(np.diag(at_origins) > 0)
    matrix = 0.5 * (at_origins + at_origins.T)[np.ix_(free, free)]
    known = SetupCovariance(
        components=tuple(names[i] for i in free), matrix=tuple(map(tuple, matrix.tolist()))
    )
    return replace(
        parameters, stations=stations, prisms=prisms, setup_covariance=known if len(free) else None
    )


def _with_setup(station: StationParameters, setup: Setup, row: int) -> StationParameters:
    index, collimation, constant_m, scale = map(float, setup.instrument[row])
    frame = setup.frames[row]
    changed = not np.array_equal(frame, np.array(station.T_station1_station))
    return replace(
        station,
        T_station1_station=_matrix(frame) if changed else station.T_station1_station,
        latency_ns=station.latency_ns + round(1e9 * float(setup.latencies_s[row])),
        vertical_index_rad=station.vertical_index_rad + index,
        collimation_rad=station.collimation_rad + collimation,
        prism_constant_m=station.prism_constant_m * (1.0 + scale) + constant_m,
        atmospheric_ppm=1e6 * ((1.0 + 1e-6 * station.atmospheric_ppm) * (1.0 + scale) - 1.0)
        if scale
        else station.atmospheric_ppm,
    )


def _matrix(frame: FloatArray) -> Matrix4:
    # Products of rotations drift from orthonormality by rounding only.
    a, b, c, d = (tuple(map(float, line)) for line in frame)
    return cast("Matrix4", (a, b, c, d))
