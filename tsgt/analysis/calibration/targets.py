"""Station frames and prism positions from measured targets."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.formats import InstrumentErrors
from tsgt.errors import DegenerateGeometryError, InputFileError
from tsgt.geometry import check_layout, measurement_covariance, polar_to_cartesian
from tsgt.geometry.target_calibration import (
    CONSISTENCY,
    ERRORS,
    CauseKind,
    InstrumentError,
    PointSet,
    TargetReadings,
    calibrate_network,
    calibrate_prisms,
    checks,
    station_frames,
    unweighted_frames,
)
from tsgt.model import TARGET_NOISE, SetupCovariance, TargetResidual

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence
    from pathlib import Path

    from tsgt.analysis.formats import PrismFile, TargetFile, TargetMeasurement
    from tsgt.geometry import FloatArray
    from tsgt.geometry.target_calibration import (
        Check,
        Column,
        ErrorEstimate,
        FrameCalibration,
        NetworkCalibration,
        PointName,
        PrismCalibration,
    )

REPEAT_LIMIT_M = 0.02  # From the mean; beyond is a mistake. An index error of 30" is within up to 130 m
CAD_SIGMA_M = 0.001  # Per axis of a body point relative to CAD: machining, and the adhesive target


Exclusion = tuple[int | None, int]  # Numbers of a station, None: all, and a target


@dataclass(frozen=True, slots=True, eq=False)
class TargetCalibration:
    """Station frames from targets, with all that is known about their quality."""

    network: NetworkCalibration
    frames: dict[int, FrameCalibration]  # By number of the stations but 1
    covariance: SetupCovariance  # Of frames and instrument errors
    applied: bool  # The frames are those of the corrected readings; False: unweighted, nothing is corrected
    atmospheric_ppm: dict[int, float]  # Mean correction of the distances, by number of the station

    @property
    def checks(self) -> list[Check]:
        """Limits that decide whether the frames may be used; the same with and without weights."""
        return checks(self.network)

    @property
    def consistent(self) -> bool:
        """Whether the frames may be used, be they weakly determined or not."""
        return all(check.ok for check in self.checks if check.name in CONSISTENCY)

    def errors(self, station: int) -> dict[InstrumentError, ErrorEstimate]:
        """Instrument errors of a station by number."""
        row = self.network.readings.stations.index(station)
        return {error: self.network.errors[row, error] for error in ERRORS}

    def instrument_errors(self) -> dict[int, InstrumentErrors]:
        """Errors that also hold for prisms, by station; the range constant is that of the targets.

        A scale only where the targets show one: it replaces ``atmospheric_ppm`` of the configuration, and a scale that all
        stations have in common deforms nothing. So it contains the correction that the distances of the targets had already.
        """
        if not self.applied:
            return {}
        result = {}
        scaled = self._scaled_stations()
        for station in self.network.readings.stations:
            errors = self.errors(station)
            result[station] = InstrumentErrors(
                vertical_index_rad=errors[InstrumentError.VERTICAL_INDEX].value,
                collimation_rad=errors[InstrumentError.COLLIMATION].value,
                range_scale_ppm=self._total_ppm(station, errors[InstrumentError.RANGE_SCALE].value)
                if station in scaled
                else None,
            )
        return result

    def _total_ppm(self, station: int, scale: float) -> float:
        return 1e6 * ((1.0 + 1e-6 * self.atmospheric_ppm[station]) * (1.0 + scale) - 1.0)

    def _scaled_stations(self) -> set[int]:
        """Stations for which a scale of the distances is a cause, or is not told apart from one."""
        return {
            self.network.readings.stations[each.station]
            for cause in self.network.causes
            if cause.kind is CauseKind.INSTRUMENT
            for each in (cause, *cause.alternatives)
            if each.error is InstrumentError.RANGE_SCALE
        }


def solve_stations(
    file: TargetFile,
    *,
    target_constant_m: float,
    weighted: bool = True,
    levelled: bool = False,
    exclude: Collection[Exclusion] = (),
    max_residual_m: float | None = None,
) -> TargetCalibration:
    """Solve the frames of all stations but 1 jointly from the targets.

    ``target_constant_m`` is added to slope distances without a constant of their own; ``weighted`` False: frames by Arun's
    unweighted least squares, from the same targets; ``levelled``: heading and position only; ``max_residual_m``: leave out
    sights until no residual is larger. Raises DegenerateGeometryError if fewer than three targets are in common with station
    1 or they lie in a line, InputFileError as :func:`mean_points`, or if an exclusion names no measurement.
    """
    readings = target_readings(file, target_constant_m, exclude)
    try:
        network = calibrate_network(readings, TARGET_NOISE, levelled=levelled, max_residual_m=max_residual_m)
    except DegenerateGeometryError as error:
        raise DegenerateGeometryError(f"{file.path}: {error}") from error
    frames, columns, covariance = station_frames(network), network.columns, network.covariance
    if not weighted:
        frames, columns, covariance = unweighted_frames(network, TARGET_NOISE)
    ppm = {
        station: float(np.mean([sight.atmospheric_ppm for sights in targets.values() for sight in sights]))
        for station, targets in file.measurements.items()
    }
    return TargetCalibration(
        network, frames, _setup_covariance(readings.stations, columns, covariance), weighted, ppm
    )


def target_readings(
    file: TargetFile, constant_m: float, exclude: Collection[Exclusion] = ()
) -> TargetReadings:
    """Return the measurements of targets that two or more stations have measured, in the order of the file.

    Raises InputFileError as :func:`mean_points` for measurements in the same face, or if an exclusion names none.
    """
    for station, target in exclude:
        seen = file.measurements.values() if station is None else [file.measurements.get(station, {})]
        if not any(target in targets for targets in seen):
            whose = "" if station is None else f" of station {station}"
            raise InputFileError(f"holds no measurement of target {target}{whose} to exclude", path=file.path)
    rows = [
        (measurement.line, station, target, measurement)
        for station, targets in file.measurements.items()
        for target, repeats in targets.items()
        if not {(None, target), (station, target)} & set(exclude)
        for measurement in repeats
    ]
    rows.sort(key=lambda row: row[0])
    for station, targets in file.measurements.items():
        check_repeats(file.path, targets, constant_m, f"target {{}} of station {station}")
    common = {target for target, count in _station_counts(rows).items() if count > 1}
    rows = [row for row in rows if row[2] in common]
    stations = (1, *sorted(station for station in file.measurements if station != 1))
    names = tuple(sorted(common))
    return TargetReadings(
        stations=stations,
        targets=names,
        station=np.array([stations.index(station) for _, station, _, _ in rows], dtype=np.intp),
        target=np.array([names.index(target) for _, _, target, _ in rows], dtype=np.intp),
        horizontal_rad=np.array([each.horizontal_angle_rad for *_, each in rows]),
        zenith_rad=np.array([each.zenith_angle_rad for *_, each in rows]),
        distance_m=np.array([each.distance_m(constant_m) for *_, each in rows]),
    )


def _station_counts(rows: Sequence[tuple[int, int, int, TargetMeasurement]]) -> Counter[int]:
    return Counter(target for target, _ in {(target, station) for _, station, target, _ in rows})


_COMPONENTS = ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z", *ERRORS)


def _setup_covariance(
    stations: Sequence[int], columns: Sequence[Column], covariance: FloatArray
) -> SetupCovariance:
    """Keep frames and the instrument errors that also hold for prisms."""
    kept = [
        place
        for place, (_, component) in enumerate(columns)
        if component < len(_COMPONENTS) and _COMPONENTS[component] != InstrumentError.RANGE_CONSTANT
    ]
    matrix = covariance[np.ix_(kept, kept)]
    return SetupCovariance(
        components=tuple(
            f"station{stations[row]}.{_COMPONENTS[component]}"
            for row, component in (columns[place] for place in kept)
        ),
        matrix=tuple(tuple(map(float, row)) for row in (matrix + matrix.T) / 2),
    )


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


def layout_covariance(calibration: PrismCalibration) -> SetupCovariance:
    """Return the joint covariance of all prisms; the error of the robot frame is common to them."""
    prisms = calibration.prisms
    names = tuple(f"prism{name}.{axis}" for name in prisms.names for axis in "xyz")
    matrix = calibration.joint_covariance_m2
    return SetupCovariance(components=names, matrix=tuple(tuple(map(float, row)) for row in matrix))


def check_repeats(
    path: Path, measured: Mapping[int, Sequence[TargetMeasurement]], constant_m: float, what: str
) -> None:
    """Raise InputFileError as :func:`mean_points` for measurements of a target in the same face."""
    for face in (1, 2):
        same = {
            target: [each for each in repeats if each.face == face] for target, repeats in measured.items()
        }
        mean_points(path, {target: each for target, each in same.items() if each}, constant_m, what)


def same_face_points(
    path: Path,
    before: Mapping[int, Sequence[TargetMeasurement]],
    now: Mapping[int, Sequence[TargetMeasurement]],
    constant_m: float,
    what: str,
) -> tuple[PointSet, PointSet]:
    """Return the targets of ``now`` as they were measured before, and now, both as :func:`mean_points`.

    A target counts in the face in which it was first measured now: an index error and a collimation then shift both points
    alike, by 30 mm at 100 m for 0.3 mrad. It must have been measured before in this face.
    """
    then, again = (
        {
            target: [each for each in measured[target] if each.face == repeats[0].face]
            for target, repeats in now.items()
        }
        for measured in (before, now)
    )
    return mean_points(path, then, constant_m, what), mean_points(path, again, constant_m, what)


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
        d = np.array([measurement.distance_m(constant_m) for measurement in repeats])
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
    n = len(names)
    return PointSet(tuple(names), np.reshape(points, (n, 3)), np.reshape(covariances, (n, 3, 3)))
