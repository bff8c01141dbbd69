"""Stations' frames from nothing but a robot's motion, roughly: where a calibration from motion begins. Pure.

Every station has tracked some prism of the same robot. First all tracks are laid over that of station 1 as if all prisms
were one point; then frames are sought that give the prisms their distances on the robot.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from tsgt.errors import GeometryError
from tsgt.geometry.rigid import exp_so3, rotate

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory import Observations

STEP_S = 0.5
GAP_S = 1.0
"""Epochs between measurements of a station that are further apart are left out."""

LEAST_EPOCHS = 20
LEAST_EXTENT_M = 2.0
"""Root mean square distance from the middle that a robot must have driven at least: a few times its own size."""

LOSS_M = 0.05
"""Distances that are off by more count less: straight lines between measurements, late stamps, prisms mistaken."""


class _Track(NamedTuple):
    """One station's measurements at common epochs: where, of which prism, and whether there are any."""

    points_m: FloatArray
    prism: NDArray[np.intp]
    valid: NDArray[np.bool_]


def frames_from_motion(observations: Observations) -> FloatArray:
    """Find frames without knowing any, (S, 4, 4), for stations that are more or less level.

    Parameters
    ----------
    observations
        Polar measurements in the order of time; their frames are not looked at, except that of station 1 (row 0).

    Raises
    ------
    GeometryError
        Two stations have too little in common, or the robot hardly moved.
    """
    seen = np.unique(observations.station)
    if 0 not in seen:
        raise GeometryError("station 1 has measured nothing; frames are those beside station 1")
    epochs_s = np.arange(observations.time_s[0], observations.time_s[-1], STEP_S)
    tracks = [_track(observations, station, epochs_s) for station in seen]
    first = observations.frames[0]
    tracks[0] = tracks[0]._replace(points_m=rotate(first[:3, :3], tracks[0].points_m) + first[:3, 3])
    start = [
        _laid_over(tracks[0], track, observations.layout, int(seen[i + 1]) + 1)
        for i, track in enumerate(tracks[1:])
    ]
    pairs = [_Pair.of(a, b, tracks, observations.layout) for a, b in combinations(range(len(tracks)), 2)]

    def residuals_m(unknowns: FloatArray) -> FloatArray:
        placed = [tracks[0].points_m] + [
            _placed(track.points_m, four)
            for track, four in zip(tracks[1:], unknowns.reshape(-1, 4), strict=True)
        ]
        return np.concatenate([pair.residuals_m(placed) for pair in pairs])

    found = least_squares(
        residuals_m,
        np.concatenate(start),
        loss="soft_l1",
        f_scale=LOSS_M,
        x_scale=np.tile([0.01, 1, 1, 1], len(start)),
    )
    frames = observations.frames.copy()
    for station, four in zip(seen[1:], found.x.reshape(-1, 4), strict=True):
        frames[station] = np.eye(4)
        frames[station, :3, :3] = exp_so3(np.array([0.0, 0.0, four[0]]))
        frames[station, :3, 3] = four[1:]
    return frames


class _Pair(NamedTuple):
    """Two stations at the epochs that they share, and how far apart their prisms are on the robot."""

    a: int
    b: int
    epochs: NDArray[np.intp]
    apart_m: FloatArray

    @classmethod
    def of(cls, a: int, b: int, tracks: list[_Track], layout: FloatArray) -> _Pair:
        epochs = np.flatnonzero(tracks[a].valid & tracks[b].valid)
        arms = layout[tracks[a].prism[epochs]] - layout[tracks[b].prism[epochs]]
        return cls(a, b, epochs, np.linalg.norm(arms, axis=1))

    def residuals_m(self, placed: list[FloatArray]) -> FloatArray:
        apart: FloatArray = np.linalg.norm(placed[self.a][self.epochs] - placed[self.b][self.epochs], axis=1)
        return apart - self.apart_m


def _track(observations: Observations, station: np.intp, epochs_s: FloatArray) -> _Track:
    rows = np.flatnonzero(observations.station == station)
    time_s = observations.time_s[rows]
    points = observations.points_m[rows]
    after = np.clip(np.searchsorted(time_s, epochs_s), 1, max(len(rows) - 1, 1))
    if len(rows) < 2:
        nothing = np.zeros(len(epochs_s), np.bool_)
        return _Track(np.zeros((len(epochs_s), 3)), np.zeros(len(epochs_s), np.intp), nothing)
    prism = observations.prism[rows]
    inside = (epochs_s >= time_s[after - 1]) & (epochs_s <= time_s[after])
    valid = inside & (time_s[after] - time_s[after - 1] <= GAP_S) & (prism[after] == prism[after - 1])
    lines = np.stack([np.interp(epochs_s, time_s, points[:, axis]) for axis in range(3)], axis=1)
    return _Track(lines, prism[after], valid)


def _laid_over(first: _Track, track: _Track, layout: FloatArray, number: int) -> FloatArray:
    """Heading and position, (4,), that lay one track over that of station 1, for a robot that is upright on average."""
    both = first.valid & track.valid
    if np.count_nonzero(both) < LEAST_EPOCHS:
        raise GeometryError(
            f"stations 1 and {number} have only {np.count_nonzero(both) * STEP_S:.0f} s in common, "
            f"{LEAST_EPOCHS * STEP_S:.0f} s are needed"
        )
    target, source = first.points_m[both], track.points_m[both]
    target_middle, source_middle = target.mean(axis=0), source.mean(axis=0)
    towards, away = (target - target_middle)[:, :2], (source - source_middle)[:, :2]
    extent_m = float(np.sqrt((towards**2).sum(axis=1).mean()))
    if extent_m < LEAST_EXTENT_M:
        raise GeometryError(
            f"the robot went no further than {extent_m:.1f} m (rms) from the middle of its way; that does not tell "
            f"where station {number} stands, {LEAST_EXTENT_M:g} m are needed"
        )
    heading = np.arctan2(
        (away[:, 0] * towards[:, 1] - away[:, 1] * towards[:, 0]).sum(), (away * towards).sum()
    )
    above = (layout[track.prism[both], 2] - layout[first.prism[both], 2]).mean()
    four = np.concatenate([[heading], np.zeros(3)])
    four[1:] = target_middle - _placed(source_middle, four)
    four[3] += above
    return four


def _placed(points_m: FloatArray, four: FloatArray) -> FloatArray:
    cosine, sine = np.cos(four[0]), np.sin(four[0])
    x, y, z = points_m[..., 0], points_m[..., 1], points_m[..., 2]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=-1) + four[1:]
