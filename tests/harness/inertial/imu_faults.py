"""Faults of the robot's IMU in a mission that has been driven: the estimator alone, with samples that are simulated anew."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from tsgt.config import ScenarioConfig, SimulatedImu, SuperframeMasterConfig
from tsgt.estimation import LiveEstimator, centroid_at_point, transform_of
from tsgt.geometry import log_so3, rotation_from_quaternion, transform_from, transform_points
from tsgt.geometry.inertial_calibration import SetupCheck
from tsgt.imu import HelloLine, SamplesLine, decode_program_line
from tsgt.imu.sampler import Sampler
from tsgt.model import ImuSamples
from tsgt.recording import PoseRecord
from tsgt.simulation.imu import IMU_MODELS, ImuProgram, simulate_imu
from tsgt.simulation.kernel import VirtualClock
from tsgt.simulation.options import SimulationOptions
from tsgt.simulation.runner import simulate

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.config import ImuModelName
    from tsgt.estimation.inertial.setup_monitor import StartCheck
    from tsgt.geometry import FloatArray
    from tsgt.model import Measurement, Parameters
    from tsgt.simulation.faults import FaultKind
    from tsgt.simulation.imu import ImuCondition
    from tsgt.simulation.mission import MissionResult

MAX_NEES, TOLERANCE = 60.0, 0.02
"""Limits of the invariant of poses: in m at the prisms' centroid and rad."""

_PERIOD_NS = 100_000_000  # Of poses


def confirm_once() -> StartCheck:
    """Return what confirms the set-up of the IMU the first time, without computing, and finds nothing later."""
    checks = iter([SetupCheck(confirmed=True)])
    return lambda _work: lambda: next(checks, SetupCheck())


@dataclass(frozen=True)
class Drive:
    """Measurements of three stations on a robot with an IMU, and the truth."""

    result: MissionResult
    imu: SimulatedImu
    seed: int
    parameters: Parameters
    measurements: Sequence[Measurement]

    @classmethod
    def simulated(
        cls,
        folder: Path,
        *,
        seed: int,
        duration_s: float,
        imu: ImuModelName = "industrial",
        faults: frozenset[FaultKind] = frozenset(),
        protocol: object = None,
    ) -> Drive:
        """Simulate a mission; ``faults``: of anything but the IMU."""
        pipeline = ScenarioConfig().pipeline.model_copy(update={"estimator": "linear"})
        scenario = ScenarioConfig(pipeline=pipeline, imu=SimulatedImu(model=imu))
        options = SimulationOptions(
            duration_s=duration_s,
            seed=seed,
            protocol=protocol or SuperframeMasterConfig(kind="superframe"),  # type: ignore[arg-type]
            faults=faults,
        )
        result = simulate(scenario, options, folder=folder)
        parameters = result.parameters
        limits = replace(
            parameters.pipeline, estimator="continuous", period_ns=_PERIOD_NS, smoothed_delays_ns=()
        )
        measurements = list(result.master_logs[0].measurements)
        return cls(result, scenario.imu, seed, replace(parameters, pipeline=limits), measurements)

    def samples(self, conditions: Sequence[ImuCondition] = ()) -> list[ImuSamples]:
        """Return the records of the IMU with faults."""
        run = simulate_imu(
            self.imu,
            self.result.world.motion_at,
            self.result.duration_s,
            seed=[self.seed],
            conditions=conditions,
        )
        program = ImuProgram(IMU_MODELS[self.imu.model], run.samples, VirtualClock(self.result.start_ns))
        sampler = Sampler(self.result.start_ns)
        hello = decode_program_line(program.hello)
        assert isinstance(hello, HelloLine)
        sampler.program_started(hello)
        found: list[ImuSamples] = []
        for arrival_ns, data in program.lines():
            line = decode_program_line(data)
            assert isinstance(line, SamplesLine)
            found += sampler.push(line, arrival_ns)
        return found

    def poses(
        self,
        samples: Sequence[ImuSamples],
        *,
        stations: int = 3,
        start_check: StartCheck | None = None,
        period_ns: int = _PERIOD_NS,
    ) -> Poses:
        """Return the poses of a live estimator; without samples it has no IMU."""
        parameters = replace(
            self.parameters,
            stations=self.parameters.stations[:stations],
            prisms=self.parameters.prisms[:stations],
            pipeline=replace(self.parameters.pipeline, period_ns=period_ns),
        )
        if not samples:
            parameters = replace(parameters, imu=None)
        live = LiveEstimator(parameters) if start_check is None else LiveEstimator(parameters, start_check)
        numbers = {each.station for each in parameters.stations}
        arrived: list[Measurement | ImuSamples] = [
            each for each in self.measurements if each.station in numbers
        ]
        arrived = sorted([*arrived, *samples], key=lambda each: each.received_ns)
        records: list[PoseRecord] = []
        for each in arrived:
            out = live.imu_samples(each) if isinstance(each, ImuSamples) else live.measurement(each)
            records += [record for record in out if isinstance(record, PoseRecord)]
        return self._compared(records, parameters)

    def _compared(self, records: list[PoseRecord], parameters: Parameters) -> Poses:
        valid = np.array([each.valid for each in records])
        known = [each for each in records if each.valid]
        stamp_ns = np.array([each.stamp_ns for each in records], dtype=np.int64)
        time_s = (stamp_ns - self.result.start_ns) / 1e9
        truth = self.result.world.pose_at(time_s[valid]) @ transform_of(parameters.reference_point)
        found = transform_from(
            rotation_from_quaternion(np.array([each.orientation_xyzw for each in known])),
            np.array([each.position_m for each in known]),
        )
        turn = log_so3(found[:, :3, :3] @ np.swapaxes(truth[:, :3, :3], 1, 2))
        error = np.concatenate([found[:, :3, 3] - truth[:, :3, 3], turn], axis=1)
        covariance = np.array([each.covariance for each in known]).reshape(-1, 6, 6)
        solved = np.linalg.solve(covariance, error[:, :, None])[:, :, 0]
        centroid_m = centroid_at_point(parameters)
        lengths = np.full((len(records), 3), np.nan)
        apart = transform_points(found, centroid_m) - transform_points(truth, centroid_m)
        lengths[valid, 0] = np.linalg.norm(apart, axis=1)
        lengths[valid, 1] = np.linalg.norm(turn, axis=1)
        sigmas = np.full((len(records), 2), np.nan)
        for column, block in enumerate((slice(0, 3), slice(3, 6))):
            sigmas[valid, column] = np.sqrt(np.linalg.eigvalsh(covariance[:, block, block])[:, -1])
        lengths[valid, 2] = np.einsum("ni,ni->n", error, solved)
        return Poses(
            time_s,
            np.array([each.kind == "predicted" for each in records]),
            valid,
            np.array([each.imu or "" for each in records]),
            lengths[:, 0],
            lengths[:, 1],
            lengths[:, 2],
            np.array([[each.jump_m, each.jump_rad] for each in records], dtype=np.float64),
            sigmas,
        )


@dataclass(frozen=True)
class Poses:
    """N poses in the order of the stream; errors are NaN where invalid."""

    time_s: FloatArray
    predicted: NDArray[np.bool_]
    valid: NDArray[np.bool_]
    imu: NDArray[np.str_]
    position_m: FloatArray  # Errors at the prisms' centroid
    rotation_rad: FloatArray
    nees: FloatArray
    jumps: FloatArray  # (N, 2) in m and rad; NaN where none is stated
    sigmas: FloatArray  # (N, 2) of the position in m and the rotation in rad, in the least certain direction

    def select(self, rows: NDArray[np.bool_]) -> Poses:
        """Return some."""
        return Poses(*(getattr(self, each.name)[rows] for each in fields(self)))

    @property
    def wrong(self) -> NDArray[np.bool_]:
        """Which violate the invariant of poses."""
        found: NDArray[np.bool_] = self.nees > MAX_NEES
        return found & (np.fmax(self.position_m, self.rotation_rad) > TOLERANCE)
