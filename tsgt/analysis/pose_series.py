"""Poses at the epochs of a recording, from a trajectory in pieces or one with an IMU."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation import (
    ContinuousPoseOutput,
    Degradation,
    MeasurementHistory,
    PoseBatch,
    Reason,
    measured_at_ns,
    unconfirmed_covariance,
    usable,
)
from tsgt.geometry.trajectory import POSE_DIM

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from tsgt.analysis.inertial_smoothing import ImuUse
    from tsgt.geometry import FloatArray
    from tsgt.geometry.batch import TrajectoryInPieces, TrajectoryPiece
    from tsgt.geometry.trajectory import Trajectory
    from tsgt.model import Measurement, Parameters

# Bounds the memory of intermediate results, which should fit into the CPU cache.
_EPOCHS_PER_CHUNK = 1024


class PoseSeries:
    """Poses at the epochs from the first to the last usable measurement."""

    def __init__(
        self,
        parameters: Parameters,
        measurements: Sequence[Measurement],
        sources: Sequence[Measurement],
        origin_ns: int,
    ) -> None:
        self.origin_ns = origin_ns
        stations = {station.station: station for station in parameters.stations}
        columns = {prism.prism: column for column, prism in enumerate(parameters.prisms)}
        self._parameters, self._output = parameters, ContinuousPoseOutput(parameters)
        self._times_ns = np.array([measured_at_ns(m, stations[m.station]) for m in sources], dtype=np.int64)
        self._stations = np.array([m.station for m in sources], dtype=np.int64)
        self._prisms = np.array([columns[m.prism] for m in sources], dtype=np.intp)
        self._unusable_ns = [
            np.array(
                sorted(
                    measured_at_ns(m, stations[m.station])
                    for m in measurements
                    if m.prism == prism.prism and m.station in stations and not usable(m)
                ),
                dtype=np.int64,
            )
            for prism in parameters.prisms
        ]
        period_ns = parameters.pipeline.period_ns
        first, last = -(-int(self._times_ns[0]) // period_ns), int(self._times_ns[-1]) // period_ns
        self._epochs_ns = np.arange(first, last + 1, dtype=np.int64) * period_ns

    def with_imu(self, imu: ImuUse, without: PoseBatch | None) -> PoseBatch:
        """Return poses with an IMU; where it is not to be used those without it, or invalid ones.

        Where a shock may have displaced it they are degraded, and their covariance allows for that, as live; where a station seems to
        have moved they are invalid, with three prisms degraded.
        """
        seen = self._history(imu.fit.residuals_m)

        def chunk(epochs_ns: NDArray[np.int64]) -> PoseBatch:
            time_s = self._time_s(epochs_ns)
            states, covariance, common = imu.fit.trajectory.poses_at(time_s)
            displaced = time_s > imu.displaced_from_s
            covariance[displaced] += unconfirmed_covariance(imu.shocks_before(time_s[displaced]))
            batch = self._output.smoothed(
                epochs_ns, seen, states, covariance, common=common, converged=~imu.unused_at(time_s)
            )
            batch.degraded[displaced & batch.valid] |= Degradation.IMU_UNCONFIRMED
            if not imu.complete:
                moved = batch.valid & (time_s > imu.moved_from_s)
                batch.reason[moved], batch.degraded[moved] = Reason.CONTRADICTED, 0
            return batch

        poses = PoseBatch.collected(len(self._epochs_ns), map(chunk, _chunks(self._epochs_ns)))
        if without is not None:
            unused = imu.unused_at(self._time_s(poses.stamp_ns))
            rows = np.concatenate([np.flatnonzero(~unused), len(poses) + np.flatnonzero(unused)])
            joined = PoseBatch.concatenated([poses, without]).select(rows)
            poses = joined.select(np.argsort(joined.stamp_ns, kind="stable"))
        if imu.complete:
            poses.degraded[poses.valid & imu.disagrees_at(self._time_s(poses.stamp_ns))] |= (
                Degradation.IMU_DISAGREES
            )
        return poses

    def of_pieces(
        self, in_pieces: TrajectoryInPieces, on_progress: Callable[[float], None] | None, *, keep: bool
    ) -> tuple[PoseBatch, list[TrajectoryPiece]]:
        """Return the poses of a trajectory, computed piece by piece, and the pieces if they are to be kept."""
        kept: list[TrajectoryPiece] = []

        def chunks() -> Iterator[PoseBatch]:
            residuals_m, measured, done = np.full((len(self._times_ns), 3), np.nan), 0, 0
            # A pose looks at residuals before and after it, so that a piece waits for the next one.
            previous: TrajectoryPiece | None = None
            for piece in itertools.chain(in_pieces.fitted(on_progress), [None]):
                if piece is not None:
                    residuals_m[measured : measured + len(piece.residuals_m)] = piece.residuals_m
                    measured += len(piece.residuals_m)
                    if keep:
                        kept.append(piece)
                if previous is not None:
                    until_s = np.inf if piece is None else piece.trajectory.knots.time_s[0]
                    stop = int(np.searchsorted(self._time_s(self._epochs_ns), until_s))
                    yield from self._of_piece(previous.trajectory, self._epochs_ns[done:stop], residuals_m)
                    done = stop
                previous = piece

        return PoseBatch.collected(len(self._epochs_ns), chunks()), kept

    def _of_piece(
        self, trajectory: Trajectory, epochs_ns: NDArray[np.int64], residuals_m: FloatArray
    ) -> Iterator[PoseBatch]:
        seen = self._history(residuals_m)
        for some_ns in _chunks(epochs_ns):
            time_s = self._time_s(some_ns)
            states, covariance = trajectory.at(time_s, dim=POSE_DIM)
            common = trajectory.common_at(time_s, dim=POSE_DIM)
            yield self._output.smoothed(some_ns, seen, states, covariance, common=common)

    def _time_s(self, epochs_ns: NDArray[np.int64]) -> FloatArray:
        """Return the times of epochs from the trajectory's origin."""
        return np.asarray((epochs_ns - self.origin_ns) / 1e9)

    def _history(self, residuals_m: FloatArray) -> MeasurementHistory:
        return MeasurementHistory(
            times_ns=self._times_ns,
            stations=self._stations,
            prisms=self._prisms,
            residuals_m=np.linalg.norm(residuals_m, axis=1),
            unusable_ns=self._unusable_ns,
        )


def _chunks(epochs_ns: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    for start in range(0, max(len(epochs_ns), 1), _EPOCHS_PER_CHUNK):
        yield epochs_ns[start : start + _EPOCHS_PER_CHUNK]
