"""From hand-made measurement files to station frames and prism positions."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import DegenerateGeometryError, InputFileError
from tsgt.geometry import check_layout, corrected_distance, measurement_covariance, polar_to_cartesian
from tsgt.geometry.calibration import PointSet, calibrate_frame, calibrate_prisms
from tsgt.model import TARGET_NOISE, TargetResidual

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from tsgt.analysis.formats import PrismFile, TargetFile, TargetMeasurement
    from tsgt.geometry.calibration import FrameCalibration, PointName, PrismCalibration

REPEAT_LIMIT_M = 0.02
"""Two measurements of one target are a mistake when they lie further than this from their mean: another target,
a mistyped digit. An uncorrected index error of 30" stays within it in two faces up to 130 m."""

CAD_SIGMA_M = 0.001
"""One sigma per axis of a body point on the real robot against its CAD: machining and sticking on the foil."""


def solve_stations(
    file: TargetFile, *, target_constant_m: float, weighted: bool = True, levelled: bool = False
) -> dict[int, FrameCalibration]:
    """Solve the frame of each station from the targets that it has in common with station 1.

    Parameters
    ----------
    file
        Targets as measured.
    target_constant_m
        Added to each slope distance whose line has no constant of its own, in m.
    weighted, levelled
        As for :func:`tsgt.geometry.calibration.targets.calibrate_frame`.

    Returns
    -------
    dict
        By station number, station 1 excepted; ``T`` is ``T_station1_station``.

    Raises
    ------
    DegenerateGeometryError
        A station, which is named, has fewer than three targets in common with station 1, or they lie in a line.
    InputFileError
        Repeated measurements of one target contradict each other, or a constant exceeds a distance.
    """
    points = {
        station: mean_points(file.path, targets, target_constant_m, f"target {{}} of station {station}")
        for station, targets in file.sights.items()
    }
    frames: dict[int, FrameCalibration] = {}
    for station, seen in points.items():
        if station == 1:
            continue
        try:
            frames[station] = calibrate_frame(seen, points[1], weighted=weighted, levelled=levelled)
        except DegenerateGeometryError as error:
            raise DegenerateGeometryError(
                f"{file.path}: station {station} against station 1: {error}"
            ) from error
    return frames


def target_residuals(frame: FrameCalibration) -> tuple[TargetResidual, ...]:
    """Tell how well each target fits a station's solved frame; the rejected ones come last."""
    used = zip(frame.used, frame.residuals_m.tolist(), frame.leave_one_out_m.tolist(), strict=True)
    return (
        *(
            TargetResidual(
                target=int(name),
                residual_m=residual_m,
                leave_one_out_m=leave_one_out_m if math.isfinite(leave_one_out_m) else None,
            )
            for name, residual_m, leave_one_out_m in used
        ),
        *(
            TargetResidual(target=int(bad.name), residual_m=None, leave_one_out_m=float(bad.prediction_error_m))
            for bad in frame.rejected
        ),
    )


def solve_prisms(file: PrismFile, *, target_constant_m: float, prism_constant_m: float) -> PrismCalibration:
    """Solve the prisms' positions in the robot frame.

    Parameters
    ----------
    file
        Prisms and body points as one station measured them.
    target_constant_m, prism_constant_m
        Added to the slope distances of body points and of prisms whose line has no constant of its own, in m.

    Returns
    -------
    PrismCalibration
        Names of the prisms are their numbers.

    Raises
    ------
    DegenerateGeometryError
        There are fewer than three body points or they lie in a line; or three or more prisms do.
    InputFileError
        Repeated measurements of one point contradict each other, or a constant exceeds a distance.
    """
    body = mean_points(file.path, file.body, target_constant_m, "body point {}")
    prisms = mean_points(file.path, file.prisms, prism_constant_m, "prism {}")
    cad = PointSet(
        names=tuple(file.cad_m),
        points_m=np.array(list(file.cad_m.values())),
        covariances_m2=np.broadcast_to(CAD_SIGMA_M**2 * np.eye(3), (len(file.cad_m), 3, 3)),
    )
    try:
        solved = calibrate_prisms(body, cad, prisms)
        if len(prisms.names) >= 3:
            check_layout(solved.prisms.points_m, prisms.names)
    except DegenerateGeometryError as error:
        raise DegenerateGeometryError(f"{file.path}: {error}") from error
    return solved


def mean_points(
    path: Path,
    measured: Mapping[int, Sequence[TargetMeasurement]] | Mapping[str, Sequence[TargetMeasurement]],
    constant_m: float,
    what: str,
) -> PointSet:
    """Return the mean position of each target in the frame of the station, with its covariance.

    Parameters
    ----------
    path
        Where the measurements come from, for messages.
    measured
        By name of the target: its measurements, at least one.
    constant_m
        Added to the slope distances that have no constant of their own, in m.
    what
        How to call a target in messages, with ``{}`` for its name.

    Raises
    ------
    InputFileError
        Repeated measurements of one target contradict each other, or a constant exceeds a distance.
    """
    names: list[PointName] = []
    points, covariances = [], []
    for name, sights in measured.items():
        # Of either face: the formula for the first gives the same point for the angles of the second.
        h = np.array([sight.horizontal_angle_rad for sight in sights])
        z = np.array([sight.zenith_angle_rad for sight in sights])
        constants = [constant_m if sight.constant_m is None else sight.constant_m for sight in sights]
        d = np.array(
            [
                corrected_distance(sight.slope_distance_m, constant_m=constant, ppm=0.0)
                for sight, constant in zip(sights, constants, strict=True)
            ]
        )
        if d.min() <= 0:
            raise InputFileError(
                f"{what.format(name)}: with its constant the distance is {d.min():.3f} m; correct the constant",
                path=path,
                line=sights[int(d.argmin())].line,
            )
        positions = polar_to_cartesian(h, z, d)
        mean = positions.mean(axis=0)
        misses_m = np.linalg.norm(positions - mean, axis=1)
        worst = int(misses_m.argmax())
        if misses_m[worst] > REPEAT_LIMIT_M:
            raise InputFileError(
                f"{what.format(name)}: this measurement lies {1e3 * misses_m[worst]:.0f} mm from the mean of the "
                f"{len(sights)} of this point; remove the wrong one",
                path=path,
                line=sights[worst].line,
            )
        names.append(name)
        points.append(mean)
        covariances.append(measurement_covariance(h, z, d, TARGET_NOISE).mean(axis=0) / len(sights))
    return PointSet(tuple(names), np.array(points), np.array(covariances))
