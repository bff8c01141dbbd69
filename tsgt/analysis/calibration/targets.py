"""Station frames and prism positions from measured targets."""

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

REPEAT_LIMIT_M = 0.02  # From the mean; beyond is a mistake. An index error of 30" is within up to 130 m
CAD_SIGMA_M = 0.001  # Per axis of a body point relative to CAD: machining, and the adhesive target


def solve_stations(
    file: TargetFile, *, target_constant_m: float, weighted: bool = True, levelled: bool = False
) -> dict[int, FrameCalibration]:
    """Solve ``T_station1_station`` of each station but 1 from the targets that it has in common with station 1.

    ``target_constant_m`` is added to slope distances without a constant of their own; ``weighted``, ``levelled``: see
    :func:`tsgt.geometry.calibration.targets.calibrate_frame`. Raises DegenerateGeometryError if fewer than three targets are
    in common or they lie in a line, InputFileError as :func:`mean_points`.
    """
    points = {
        station: mean_points(file.path, targets, target_constant_m, f"target {{}} of station {station}")
        for station, targets in file.measurements.items()
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
    """Return the residual of each target in a station's solved frame; the rejected ones come last."""
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
            TargetResidual(
                target=int(bad.name), residual_m=None, leave_one_out_m=float(bad.prediction_error_m)
            )
            for bad in frame.rejected
        ),
    )


def solve_prisms(file: PrismFile, *, target_constant_m: float, prism_constant_m: float) -> PrismCalibration:
    """Solve the prisms' positions in the robot frame, named by their numbers.

    The constants are added to slope distances, of body points and of prisms, without one of their own. Raises
    DegenerateGeometryError if there are fewer than three body points or they lie in a line, or three or more prisms do;
    InputFileError as :func:`mean_points`.
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

    ``constant_m`` is added to slope distances without one of their own; ``what`` names a target in messages, ``{}`` for its
    number. Raises InputFileError if repeated measurements are inconsistent, or a constant exceeds a distance.
    """
    names: list[PointName] = []
    points, covariances = [], []
    for name, repeats in measured.items():
        # Both faces: the formula of face 1 yields the same point for the angles of face 2.
        h = np.array([measurement.horizontal_angle_rad for measurement in repeats])
        z = np.array([measurement.zenith_angle_rad for measurement in repeats])
        constants = [
            constant_m if measurement.constant_m is None else measurement.constant_m
            for measurement in repeats
        ]
        d = np.array(
            [
                corrected_distance(measurement.slope_distance_m, constant_m=constant, ppm=0.0)
                for measurement, constant in zip(repeats, constants, strict=True)
            ]
        )
        if d.min() <= 0:
            raise InputFileError(
                f"{what.format(name)}: with its constant the distance is {d.min():.3f} m; correct the constant",
                path=path,
                line=repeats[int(d.argmin())].line,
            )
        positions = polar_to_cartesian(h, z, d)
        mean = positions.mean(axis=0)
        deviations_m = np.linalg.norm(positions - mean, axis=1)
        worst = int(deviations_m.argmax())
        if deviations_m[worst] > REPEAT_LIMIT_M:
            raise InputFileError(
                f"{what.format(name)}: this measurement is {1e3 * deviations_m[worst]:.0f} mm from the mean of the "
                f"{len(repeats)} of this point; remove the wrong one",
                path=path,
                line=repeats[worst].line,
            )
        names.append(name)
        points.append(mean)
        covariances.append(measurement_covariance(h, z, d, TARGET_NOISE).mean(axis=0) / len(repeats))
    return PointSet(tuple(names), np.array(points), np.array(covariances))
