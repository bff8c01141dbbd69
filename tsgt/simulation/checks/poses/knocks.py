"""What a knock of the IMU adds to the poses of one or two stations."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import RecordingError
from tsgt.estimation import centroid_at_point, centroid_m
from tsgt.geometry.inertial import judge_magnitudes
from tsgt.model import MIN_PRISMS
from tsgt.recording import read_imu_samples
from tsgt.simulation.faults import KNOCK_DISPLACEMENT_M, KNOCK_ROTATION_RAD

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.model import Parameters
    from tsgt.simulation.mission import MasterLog, MissionResult, ValidPoses

SHOCK_S = 0.1
"""Samples of a knock, which takes 20 ms, have stamps within this time of it."""

NOTICED_S = 1.0
"""Poses after a knock that were sent before its samples arrived are not older than this."""


def untold_displacements(
    poses: ValidPoses, master_log: MasterLog, result: MissionResult
) -> NDArray[np.float64]:
    """By what the IMU has been knocked before each pose that nothing tells: in m at the prisms' centroid and in rad, (N, 2).

    A single prism tells no rotation of the IMU on the robot, and two none about their line: the poses are turned by it
    (docs/how-to/one-or-two-stations.md). A displacement is named from 50 mm on. A master knows of a knock by the shock that its samples
    show, or those of a master before it, and allows for it in the covariance. Where no master had samples of it, none does.
    """
    at_s = (poses.stamp_ns - master_log.unix_at_zero_ns) / 1e9
    count = np.zeros(len(at_s))
    for knock_s, known_until_s in _knocks(master_log, result):
        count += (at_s > knock_s) & ~((at_s > knock_s + NOTICED_S) & (at_s < known_until_s))
    return count[:, None] * _displacement(result.parameters)


def displacements(poses: ValidPoses, master_log: MasterLog, result: MissionResult) -> NDArray[np.float64]:
    """By what the IMU has been knocked before each pose, told or not: as :func:`untold_displacements`."""
    at_s = (poses.stamp_ns - master_log.unix_at_zero_ns) / 1e9
    count = np.searchsorted(np.sort(result.knocks_s), at_s).astype(np.float64)
    return count[:, None] * _displacement(result.parameters)


def displaced_covariance(
    covariance: NDArray[np.float64], untold: NDArray[np.float64], parameters: Parameters
) -> NDArray[np.float64]:
    """Add to covariances, (N, 6, 6), what :func:`untold_displacements` gives: the error of a long prediction is far larger than that."""
    arm_m = float(np.linalg.norm(centroid_at_point(parameters)))
    sigmas = np.stack([untold[:, 0] + arm_m * untold[:, 1], untold[:, 1]], axis=1).repeat(3, axis=1)
    return np.asarray(covariance + sigmas[:, None] ** 2 * np.eye(6))


def _displacement(parameters: Parameters) -> NDArray[np.float64]:
    """Return what a knock adds, (2,); nothing where three prisms tell it."""
    if parameters.imu is None or len(parameters.prisms) >= MIN_PRISMS:
        return np.zeros(2)
    lever_m = float(np.linalg.norm(np.array(parameters.imu.position_m) - centroid_m(parameters)))
    return np.array([KNOCK_DISPLACEMENT_M + lever_m * KNOCK_ROTATION_RAD, KNOCK_ROTATION_RAD])


def _knocks(master_log: MasterLog, result: MissionResult) -> Iterator[tuple[float, float]]:
    """Yield each knock, and until when the master knows of it."""
    if not result.knocks_s or not _displacement(result.parameters).any():
        return
    path = master_log.recording()
    shocks_s = np.array([] if path is None else [*_shocks_s(path, master_log.unix_at_zero_ns)])
    imu = (master_log.parameters or result.parameters).imu
    earlier = 0 if imu is None else imu.shocks_before
    for knock_s in sorted(result.knocks_s):
        seen = bool((np.abs(shocks_s - knock_s) < SHOCK_S).any())
        if not seen and earlier:
            seen, earlier = True, earlier - 1
        yield knock_s, np.inf if seen else knock_s


def _shocks_s(path: Path, unix_at_zero_ns: int) -> Iterator[float]:
    """Yield the time of each recorded sample that shows a shock, in s from the start."""
    # A master that is killed at once leaves no header.
    with suppress(RecordingError):
        for line in read_imu_samples(path, keep_going=True):
            _, shocks = judge_magnitudes(
                np.array(line.angular_rate_radps), np.array(line.specific_force_mps2)
            )
            for row in np.flatnonzero(shocks).tolist():
                yield (line.stamp_ns[row] - unix_at_zero_ns) / 1e9
