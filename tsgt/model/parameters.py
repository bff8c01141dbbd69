"""Everything that turns measurements into poses."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

from tsgt.model.pipeline import PipelineParameters
from tsgt.model.robot import ROBOT_ORIGIN, ImuParameters, OdometryParameters, PrismPosition, ReferencePoint
from tsgt.model.stations import StationParameters  # noqa: TC001 (looked up when the program runs)
from tsgt.model.values import FiniteNumbers


@dataclass(frozen=True, slots=True, kw_only=True)
class SetupCovariance(FiniteNumbers):
    """Joint covariance of the calibrated set-up, which all poses share: it does not average out over time."""

    components: tuple[str, ...]
    """What the n rows and columns stand for, each at most once. ``stationK.x``, ``.y``, ``.z``: displacement of the
    origin of station K in frame ``station1``, in m; ``stationK.rotation_x``, ``.rotation_y``, ``.rotation_z``: rotation of
    its axes about the fixed axes of frame ``station1`` through that origin, in rad; ``stationK.latency`` in s;
    ``stationK.vertical_index`` and ``.collimation`` in rad; ``stationK.prism_constant`` in m; ``stationK.range_scale``,
    dimensionless; ``prismP.x``, ``.y``, ``.z``: in the frame ``robot``, in m; ``imu.x``, ``.y``, ``.z``: its origin in the frame ``robot``, in m;
    ``imu.rotation_x``, ``.rotation_y``, ``.rotation_z``: rotation of its axes about those of ``robot``, in rad;
    ``imu.latency`` in s; ``imu.gyro_11`` to ``imu.gyro_33``: entries of its gyro matrix."""
    matrix: tuple[tuple[float, ...], ...]
    """n rows of n: covariances in products of those units."""

    def __post_init__(self) -> None:
        """Reject a matrix that is no covariance of the components."""
        n = len(self.components)
        if len(set(self.components)) != n:
            raise ValueError("components holds a name twice")
        if len(self.matrix) != n or any(len(row) != n for row in self.matrix):
            raise ValueError(f"matrix is not {n} x {n}, as the components are")
        for i, row in enumerate(self.matrix):
            for j, value in enumerate(row):
                limit = math.sqrt(max(self.matrix[i][i] * self.matrix[j][j], 0.0))
                if self.matrix[i][i] < 0 or abs(value) > limit * (1 + 1e-6) or value != self.matrix[j][i]:
                    raise ValueError(f"matrix is no covariance, see row {i + 1}, column {j + 1}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    """Every parameter in force: what post-processing a recording needs."""

    omitted_if_none: ClassVar[frozenset[str]] = frozenset({"imu", "odometry", "no_poses"})

    type: Literal["parameters"] = "parameters"
    stations: tuple[StationParameters, ...]
    """One entry per station."""
    prisms: tuple[PrismPosition, ...]
    """One entry per prism."""
    pipeline: PipelineParameters = PipelineParameters()  # noqa: RUF009 (it is frozen)
    """Parameters of the estimators."""
    reference_point: ReferencePoint = ROBOT_ORIGIN
    """The frame on the robot whose pose is exported."""
    setup_covariance: SetupCovariance | None = None
    """Uncertainty of station frames, latencies, instrument errors and prisms; null where unknown: taken as exact."""
    imu: ImuParameters | None = None
    """The robot's IMU; absent where none is configured."""
    odometry: OdometryParameters | None = None
    """The robot's wheel odometry, which is used with the IMU; absent where none is configured."""
    no_poses: str | None = None
    """Why no poses are computed: a set-up file is missing, so that frames or prisms are unknown here; else absent."""

    def same_set_up(self, other: Parameters) -> bool:
        """Whether the stations' frames and prisms, and the prisms' positions, are those of ``other``."""
        return self._set_up() == other._set_up()

    def same_corrections(self, other: Parameters) -> bool:
        """Whether also all that corrects measurements and samples is that of ``other``: constants, latencies, and the IMU's mounting."""
        return self.same_set_up(other) and self._corrections() == other._corrections()

    def _corrections(self) -> tuple[object, ...]:
        stations = (
            (
                each.prism_constant_m,
                each.atmospheric_ppm,
                each.latency_ns,
                each.vertical_index_rad,
                each.collimation_rad,
            )
            for each in self.stations
        )
        imu = self.imu and (self.imu.mounting, self.imu.latency_ns, self.imu.gyro_matrix)
        return *stations, imu, self.odometry

    def _set_up(self) -> tuple[object, ...]:
        stations = ((each.station, each.prism, each.T_station1_station) for each in self.stations)
        return *stations, *self.prisms
