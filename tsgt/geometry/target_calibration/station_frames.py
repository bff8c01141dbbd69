"""The frame of each station from the joint solution, or unweighted (Arun) from the targets that it keeps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtri

from tsgt.geometry.rigid import transform_from
from tsgt.geometry.target_calibration.adjustment import common_targets, mean_points, pair_residuals
from tsgt.geometry.target_calibration.causes import CauseKind
from tsgt.geometry.target_calibration.frame_fit import PointPairs, pose_jacobian
from tsgt.geometry.target_calibration.network import DATA_SHEET_SIGMA, ERRORS
from tsgt.geometry.target_calibration.prisms import (
    FALSE_ALARM_RATE,
    MAX_NOISE_SCALE,
    MAX_PREDICTION_SIGMA_M,
    MAX_PREDICTION_SIGMA_RAD,
    FrameCalibration,
    RejectedPoint,
    frame_without,
    weak_axes,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.target_calibration.adjustment import FitQuality, NetworkCalibration
    from tsgt.geometry.target_calibration.frame_fit import PointSet
    from tsgt.geometry.target_calibration.network import Column, TargetReadings
    from tsgt.model import InstrumentNoise

WEAK_STATION_RAD = 0.5e-3
"""One-sigma rotation of a station above which an axis is weak: 10 mm at a prism 20 m off the axis, as much as the rest of the system
together. Targets all around give 0.06 to 0.11 mrad (the authors' field sets), four of them nearly collinear 3 to 5 mrad."""


@dataclass(frozen=True, slots=True)
class Check:
    """A limit that decides whether a calibration may be used."""

    name: str
    station: int | None  # Number; None: all
    value: float
    limit: float

    @property
    def ok(self) -> bool:
        """Whether the value is within the limit."""
        return self.value <= self.limit


CONSISTENCY = ("noise_scale", "unidentified_causes", "tripod_moved", "max_residual_mm")
"""Checks without which a frame must not be used."""


def checks(calibration: NetworkCalibration) -> list[Check]:
    """Limits on the fit of the readings, of all and of each station, and on each frame.

    The limit of a noise scale is ``MAX_NOISE_SCALE``, and more where few degrees of freedom make it uncertain.
    """
    stations, found = calibration.readings.stations, []
    if calibration.max_residual_m is None:
        qualities = ((None, calibration.overall), *zip(stations, calibration.by_station, strict=True))
        found += [
            Check("noise_scale", station, quality.noise_scale, _limit(quality))
            for station, quality in qualities
        ]
        found.append(Check("unidentified_causes", None, float(len(calibration.unidentified)), 0.0))
        moved = [cause.station for cause in calibration.causes if cause.kind is CauseKind.TRIPOD]
        found += [
            Check("tripod_moved", station, float(row in moved), 0.0) for row, station in enumerate(stations)
        ]
    for row, station in enumerate(stations[1:], start=1):
        if calibration.max_residual_m is not None:
            used = calibration.readings.select(calibration.kept)
            residuals_m = pair_residuals(used, calibration.network, row, common_targets(used, row))
            largest_m = float(np.linalg.norm(residuals_m, axis=1).max())
            found.append(Check("max_residual_mm", station, 1e3 * largest_m, 1e3 * calibration.max_residual_m))
        variances = np.linalg.eigvalsh(_pose_covariance(calibration, row)[3:, 3:])
        found.append(
            Check(
                "rotation_sigma_mrad",
                station,
                1e3 * float(np.sqrt(variances[-1])),
                1e3 * WEAK_STATION_RAD,
            )
        )
        if calibration.levelled:
            found.append(Check("tilt_mrad", station, 1e3 * (_tilt_rad(calibration, row) or 0.0), 0.0))
    return found


def station_frames(calibration: NetworkCalibration) -> dict[int, FrameCalibration]:
    """Frame of each station but the first in that of the first, by number."""
    readings, network = calibration.readings, calibration.network
    failed = {check.station for check in checks(calibration) if not check.ok and check.name in CONSISTENCY}
    frames = {}
    for row, station in enumerate(readings.stations[1:], start=1):
        used = common_targets(readings.select(calibration.kept), row)
        rejected = [target for target in common_targets(readings, row) if target not in used]
        residuals, bad = (
            np.linalg.norm(pair_residuals(some, network, row, targets), axis=1)
            for some, targets in ((readings.select(calibration.kept), used), (readings, rejected))
        )
        covariance = _pose_covariance(calibration, row)
        frames[station] = FrameCalibration(
            T=transform_from(network.rotation[row], network.translation_m[row]),
            covariance=covariance,
            used=tuple(readings.targets[target] for target in used),
            residuals_m=residuals,
            leave_one_out_m=_leave_one_out_m(calibration, row, used),
            rejected=tuple(
                RejectedPoint(readings.targets[target], float(length))
                for target, length in zip(rejected, bad, strict=True)
            ),
            consistent=not failed & {None, station, readings.stations[0]},
            weak=weak_axes(covariance, network.points_m[used], WEAK_STATION_RAD),
            tilt_rad=_tilt_rad(calibration, row),
        )
    return frames


def unweighted_frames(
    calibration: NetworkCalibration, noise: InstrumentNoise
) -> tuple[dict[int, FrameCalibration], tuple[Column, ...], FloatArray]:
    """Frames by Arun's unweighted least squares from the targets that the joint solution keeps, and their covariance.

    Instrument errors are not applied: the covariance has the data sheet's sigmas of them, and the size of those found.
    """
    sets = mean_points(calibration.readings.select(calibration.kept), None, noise)
    everything = mean_points(calibration.readings, None, noise)
    frames = {}
    for number, weighted in station_frames(calibration).items():
        row = calibration.readings.stations.index(number)
        common = [*weighted.used, *(point.name for point in weighted.rejected)]
        pairs = PointPairs(everything[row].select(common), everything[0].select(common), calibration.levelled)
        frame = frame_without(pairs, [point.name for point in weighted.rejected], weighted=False)
        frames[number] = replace(
            frame, consistent=weighted.consistent, weak=weighted.weak, tilt_rad=weighted.tilt_rad
        )
    columns, covariance = _unweighted_covariance(calibration, sets, frames)
    for number, frame in frames.items():
        row = calibration.readings.stations.index(number)
        frames[number] = replace(frame, covariance=_block(columns, covariance, row))
    return frames, columns, covariance


def _unweighted_covariance(
    calibration: NetworkCalibration,
    sets: Sequence[PointSet],
    frames: dict[int, FrameCalibration],
) -> tuple[tuple[Column, ...], FloatArray]:
    """Joint covariance of the poses of all stations but the first and of all instrument errors."""
    readings = calibration.readings.select(calibration.kept)
    free = [0, 1, 2, 5] if calibration.levelled else [0, 1, 2, 3, 4, 5]
    count = len(readings.stations)
    place = {
        (row, name): at
        for at, (row, name) in enumerate((row, name) for row in range(count) for name in sets[row].names)
    }
    gains = np.zeros((len(free) * (count - 1), 3 * len(place)))
    for row in range(1, count):
        frame = frames[readings.stations[row]]
        rotated = sets[row].select(frame.used).points_m @ frame.T[:3, :3].T
        jacobian = pose_jacobian(rotated)[:, :, free]
        solution = np.linalg.pinv(jacobian.reshape(-1, len(free))).reshape(len(free), -1, 3)
        rows = slice((row - 1) * len(free), row * len(free))
        for each, name in enumerate(frame.used):
            of_first, of_own = (3 * place[k, name] for k in (0, row))
            gains[rows, of_first : of_first + 3] += solution[:, each]
            gains[rows, of_own : of_own + 3] -= solution[:, each] @ frame.T[:3, :3]
    noises = np.zeros((3 * len(place), 3 * len(place)))
    effects = np.zeros((3 * len(place), count * len(ERRORS)))
    for (row, name), at in place.items():
        here = slice(3 * at, 3 * at + 3)
        noises[here, here] = calibration.scale**2 * sets[row].select([name]).covariances_m2[0]
        own = (readings.station == row) & (readings.target == readings.targets.index(int(name)))
        shifts = _error_effects(readings.select(own))
        effects[here, row * len(ERRORS) : (row + 1) * len(ERRORS)] = shifts.mean(axis=0)
    variances = np.array(
        [
            DATA_SHEET_SIGMA[error] ** 2 + calibration.network.errors[row, column] ** 2
            for row in range(count)
            for column, error in enumerate(ERRORS)
        ]
    )
    poses = gains @ noises @ gains.T
    # An error that is not applied displaces the frame: truth minus estimate.
    shift = -gains @ effects
    joint = np.block(
        [
            [poses + (shift * variances) @ shift.T, shift * variances],
            [(shift * variances).T, np.diag(variances)],
        ]
    )
    columns = (
        *((row, component) for row in range(1, count) for component in free),
        *((row, 6 + column) for row in range(count) for column in range(len(ERRORS))),
    )
    return columns, (joint + joint.T) / 2


def _error_effects(readings: TargetReadings) -> FloatArray:
    """(n, 3, 4) displacement of measured points in the frames of their stations by instrument errors."""
    axes = readings.axes()
    lever = readings.face * readings.distance_m
    return np.stack(
        [
            lever[:, None] * axes[:, 2],
            -lever[:, None] * axes[:, 1],
            -readings.distance_m[:, None] * axes[:, 0],
            -axes[:, 0],
        ],
        axis=2,
    )


def _leave_one_out_m(calibration: NetworkCalibration, row: int, used: Sequence[int]) -> FloatArray:
    """Distance of each target from its place with the frames solved without it; NaN where the others do not determine it."""
    linear, network = calibration.linear, calibration.network
    readings = calibration.readings.select(calibration.kept)
    pose = [
        place for place, (station, component) in enumerate(linear.active) if station == row and component < 6
    ]
    components = [linear.active[place][1] for place in pose]
    whole = np.linalg.inv(linear.covariance)
    residuals = pair_residuals(readings, network, row, used)
    lengths = np.full(len(used), np.nan)
    for each, target in enumerate(used):
        rows = linear.target == target
        information = np.einsum("nia,nib->ab", linear.D[rows], linear.D[rows])
        gradient = np.einsum("nia,ni->a", linear.D[rows], linear.y[rows])
        try:
            covariance = np.linalg.inv(whole - information)
        except np.linalg.LinAlgError:
            continue
        step = np.zeros(6)
        step[components] = (-covariance @ gradient)[pose]
        own = np.zeros((6, 6))
        own[np.ix_(components, components)] = covariance[np.ix_(pose, pose)]
        lever = network.points_m[target] - network.translation_m[row]
        jacobian = pose_jacobian(lever[None])[0]
        variances, turns = np.linalg.eigvalsh(jacobian @ own @ jacobian.T), np.linalg.eigvalsh(own[3:, 3:])
        if (
            min(variances[0], turns[0]) > -1e-12  # Less: the others do not determine the frame
            and turns[-1] < MAX_PREDICTION_SIGMA_RAD**2
            and variances[-1] < MAX_PREDICTION_SIGMA_M**2
        ):
            lengths[each] = np.linalg.norm(residuals[each] - jacobian @ step)
    return lengths


def _pose_covariance(calibration: NetworkCalibration, row: int) -> FloatArray:
    return _block(calibration.columns, calibration.covariance, row)


def _block(columns: Sequence[Column], covariance: FloatArray, row: int) -> FloatArray:
    """(6, 6) of one station's pose, zero for components that are not solved."""
    places = [place for place, (station, component) in enumerate(columns) if station == row and component < 6]
    components = [columns[place][1] for place in places]
    block = np.zeros((6, 6))
    block[np.ix_(components, components)] = covariance[np.ix_(places, places)]
    return block


def _tilt_rad(calibration: NetworkCalibration, row: int) -> float | None:
    for cause in calibration.causes:
        if cause.kind is CauseKind.TILT and cause.station == row and cause.value is not None:
            return float(np.linalg.norm(cause.value))
    return None


def _limit(quality: FitQuality) -> float:
    if quality.redundancy < 1:
        return np.inf
    return MAX_NOISE_SCALE * float(np.sqrt(chdtri(quality.redundancy, FALSE_ALARM_RATE) / quality.redundancy))
