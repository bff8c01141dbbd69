"""Initial station frames from nothing but a robot's motion, for a calibration from motion. Sans-I/O.

All stations tracked prisms of the same robot. First all tracks are aligned with that of station 1 as if all prisms were one
point; then the frames are optimised so that the prisms have their distances on the robot.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.rigid import exp_so3, rotate

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory import Observations

STEP_S = 0.5
MAX_GAP_S = 1.0  # Epochs between measurements of a station that are further apart are skipped
MIN_EPOCHS = 20
MIN_EXTENT_M = 2.0  # RMS distance of the robot from its path's centroid: a few times its size
LOSS_M = 0.05  # Robust loss: interpolation, timestamp errors and wrong prisms exceed it


class _Track(NamedTuple):
    """One station's measurements at common epochs: position, prism, validity."""

    points_m: FloatArray
    prism: NDArray[np.intp]
    valid: NDArray[np.bool_]


def frames_from_motion(observations: Observations) -> FloatArray:
    """Return initial frames, (S, 4, 4), of approximately level stations, from polar measurements in the order of time.

    Of their frames only that of station 1 (row 0) is used. Raises GeometryError: two stations have too few epochs in common,
    or the robot hardly moved.
    """
    stations = np.unique(observations.station)
    if 0 not in stations:
        raise GeometryError("station 1 has measured nothing; frames are relative to station 1")
    epochs_s = np.arange(observations.time_s[0], observations.time_s[-1], STEP_S)
    tracks = [_track(observations, station, epochs_s) for station in stations]
    first = observations.frames[0]
    tracks[0] = tracks[0]._replace(points_m=rotate(first[:3, :3], tracks[0].points_m) + first[:3, 3])
    initial = [
        _align_track(tracks[0], track, observations.layout, int(stations[i + 1]) + 1)
        for i, track in enumerate(tracks[1:])
    ]
    pairs = [
        _StationPair.of(a, b, tracks, observations.layout) for a, b in combinations(range(len(tracks)), 2)
    ]

    def residuals_m(unknowns: FloatArray) -> FloatArray:
        points_m = [tracks[0].points_m] + [
            _transform_4dof(track.points_m, parameters)
            for track, parameters in zip(tracks[1:], unknowns.reshape(-1, 4), strict=True)
        ]
        return np.concatenate([pair.residuals_m(points_m) for pair in pairs])

    from scipy.optimize import least_squares  # noqa: PLC0415 (a tenth of the start-up of `tsgt process`)

    found = least_squares(
        residuals_m,
        np.concatenate(initial),
        loss="soft_l1",
        f_scale=LOSS_M,
        x_scale=np.tile([0.01, 1, 1, 1], len(initial)),
    )
    frames = observations.frames.copy()
    for station, parameters in zip(stations[1:], found.x.reshape(-1, 4), strict=True):
        frames[station] = np.eye(4)
        frames[station, :3, :3] = exp_so3(np.array([0.0, 0.0, parameters[0]]))
        frames[station, :3, 3] = parameters[1:]
    return frames


class _StationPair(NamedTuple):
    """Two stations, their common epochs, and the distance of their prisms on the robot."""

    a: int
    b: int
    epochs: NDArray[np.intp]
    distances_m: FloatArray

    @classmethod
    def of(cls, a: int, b: int, tracks: list[_Track], layout: FloatArray) -> _StationPair:
        epochs = np.flatnonzero(tracks[a].valid & tracks[b].valid)
        difference_m = layout[tracks[a].prism[epochs]] - layout[tracks[b].prism[epochs]]
        return cls(a, b, epochs, np.linalg.norm(difference_m, axis=1))

    def residuals_m(self, points_m: list[FloatArray]) -> FloatArray:
        measured_m: FloatArray = np.linalg.norm(
            points_m[self.a][self.epochs] - points_m[self.b][self.epochs], axis=1
        )
        return measured_m - self.distances_m


def _track(observations: Observations, station: np.intp, epochs_s: FloatArray) -> _Track:
    rows = np.flatnonzero(observations.station == station)
    time_s = observations.time_s[rows]
    points = observations.points_m[rows]
    after = np.clip(np.searchsorted(time_s, epochs_s), 1, max(len(rows) - 1, 1))
    if len(rows) < 2:
        no_epoch = np.zeros(len(epochs_s), np.bool_)
        return _Track(np.zeros((len(epochs_s), 3)), np.zeros(len(epochs_s), np.intp), no_epoch)
    prism = observations.prism[rows]
    inside = (epochs_s >= time_s[after - 1]) & (epochs_s <= time_s[after])
    valid = inside & (time_s[after] - time_s[after - 1] <= MAX_GAP_S) & (prism[after] == prism[after - 1])
    interpolated = np.stack([np.interp(epochs_s, time_s, points[:, axis]) for axis in range(3)], axis=1)
    return _Track(interpolated, prism[after], valid)


def _align_track(reference: _Track, track: _Track, layout: FloatArray, number: int) -> FloatArray:
    """(4,) heading and position that align a track with that of station 1, for a robot that is upright on average."""
    both = reference.valid & track.valid
    if np.count_nonzero(both) < MIN_EPOCHS:
        raise GeometryError(
            f"stations 1 and {number} have only {np.count_nonzero(both) * STEP_S:.0f} s in common, "
            f"{MIN_EPOCHS * STEP_S:.0f} s are needed"
        )
    target, source = reference.points_m[both], track.points_m[both]
    target_centroid, source_centroid = target.mean(axis=0), source.mean(axis=0)
    target_xy, source_xy = (target - target_centroid)[:, :2], (source - source_centroid)[:, :2]
    extent_m = float(np.sqrt((target_xy**2).sum(axis=1).mean()))
    if extent_m < MIN_EXTENT_M:
        raise GeometryError(
            f"the robot went no further than {extent_m:.1f} m (rms) from the centroid of its path; too little to determine "
            f"the frame of station {number}, {MIN_EXTENT_M:g} m are needed"
        )
    heading = np.arctan2(
        (source_xy[:, 0] * target_xy[:, 1] - source_xy[:, 1] * target_xy[:, 0]).sum(),
        (source_xy * target_xy).sum(),
    )
    height_difference_m = (layout[track.prism[both], 2] - layout[reference.prism[both], 2]).mean()
    parameters = np.concatenate([[heading], np.zeros(3)])
    parameters[1:] = target_centroid - _transform_4dof(source_centroid, parameters)
    parameters[3] += height_difference_m
    return parameters


def _transform_4dof(points_m: FloatArray, parameters: FloatArray) -> FloatArray:
    cosine, sine = np.cos(parameters[0]), np.sin(parameters[0])
    x, y, z = points_m[..., 0], points_m[..., 1], points_m[..., 2]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=-1) + parameters[1:]
