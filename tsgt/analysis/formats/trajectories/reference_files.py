"""Reference poses from files: TUM with a comment of its point, CSV as ``tsgt export`` writes it, recordings with poses."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.analysis.compare import ReferencePoses
from tsgt.analysis.evaluation import read_tum
from tsgt.analysis.formats.number_table import read_number_table
from tsgt.analysis.formats.trajectories.raw import ordered
from tsgt.analysis.formats.trajectories.text_files import raw_and_valid
from tsgt.errors import InputFileError
from tsgt.geometry import rotation_from_quaternion, transform_from
from tsgt.model import ROBOT_FRAME, ROBOT_ORIGIN, Parameters
from tsgt.recording import PoseRecord, decode_line, read_lines

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.analysis.formats.number_table import NumberTable
    from tsgt.estimation import PoseBatch
    from tsgt.geometry import FloatArray
    from tsgt.model import ReferencePoint

_FINAL = ("interpolated", "smoothed")
_MEASURED = ("measurement", "point")
_UNKNOWN = (np.nan,) * 36
_MIN_POSES = 2
_TUM_COLUMNS = 8


def reference_of_poses(batch: PoseBatch) -> ReferencePoses:
    """Return the poses of a recording as reference."""
    return _reference(
        batch.stamp_ns,
        batch.position_m,
        batch.orientation_xyzw,
        batch.covariance,
        batch.covariance_common,
        batch.valid,
        batch.reference_point,
    )


def read_reference_poses(path: Path) -> ReferencePoses:
    """Read reference poses from a recording that has them (its final ones), a TUM file or a CSV file.

    A TUM file states their point in a comment, a CSV file must be of the robot's origin. A CSV file has the diagonal of the covariance
    alone, a TUM file none. Raises InputFileError, and RecordingError or CorruptLineError for a recording.
    """
    if is_recording(path):
        return _recorded(path)
    table = read_number_table(path)
    if table.header_line is None and len(table.columns) == _TUM_COLUMNS:
        reference = read_tum(path)
        T = transform_from(rotation_from_quaternion(reference.orientation_xyzw), reference.position_m)
        valid = np.ones(len(T), dtype=np.bool_)
        return ReferencePoses(reference.stamp_ns, T, None, None, valid, reference.reference_point)
    return _table(table)


def is_recording(path: Path) -> bool:
    """Whether a file begins as a recording does, with JSON."""
    try:
        with path.open("rb") as file:
            return file.read(1) == b"{"
    except OSError as error:
        raise InputFileError(f"cannot be read: {error.strerror}", path=path) from error


def is_measured(path: Path) -> bool:
    """Whether the first measurement or pose of a recording is a measurement, so that poses are computed from it."""
    return next(
        (line.type in _MEASURED for line in read_lines(path) if line.type in (*_MEASURED, "pose")), True
    )


def _recorded(path: Path) -> ReferencePoses:
    point = ROBOT_ORIGIN
    parameters: Parameters | None = None  # of the run
    set_up: Parameters | None = None  # of the last pose
    poses: dict[int, PoseRecord] = {}
    for line in read_lines(path):
        if line.type == "parameters":
            parameters = decode_line(Parameters, line, path)
            if poses and parameters.reference_point != point:
                raise InputFileError("has poses of several points", path=path, line=line.number)
            point = parameters.reference_point
        elif line.type == "pose":
            pose = decode_line(PoseRecord, line, path)
            if pose.series not in _FINAL:
                continue
            if set_up is not None and parameters is not None and not parameters.same_set_up(set_up):
                raise InputFileError(
                    "its set-up is not that of the pose before: runs with different set-ups were joined; use the poses of one",
                    path=path,
                    line=line.number,
                )
            poses[pose.stamp_ns], set_up = pose, parameters
    if len(poses) < _MIN_POSES:
        raise InputFileError("has fewer than two final poses; compute them with tsgt process", path=path)
    rows = [poses[stamp_ns] for stamp_ns in sorted(poses)]
    position_m = np.array([pose.position_m or _UNKNOWN[:3] for pose in rows])
    orientation = np.array([pose.orientation_xyzw or _UNKNOWN[:4] for pose in rows])
    return _reference(
        np.array([pose.stamp_ns for pose in rows], dtype=np.int64),
        position_m,
        orientation,
        _matrices([pose.covariance for pose in rows]),
        _matrices([pose.covariance_common for pose in rows]),
        np.array([pose.valid for pose in rows]),
        point,
    )


def _table(table: NumberTable) -> ReferencePoses:
    path = table.path
    raw, valid = raw_and_valid(table, None)
    if raw.orientation_xyzw is None:
        raise InputFileError("has positions alone; the reference needs orientations", path=path)
    kept = ordered(raw.select(valid), path)
    if kept.notes != raw.notes:
        raise InputFileError(f"cannot be the reference: {'; '.join(kept.notes)}", path=path)
    names = table.names or []
    if "child_frame" in names:
        other = set(table.columns[names.index("child_frame")]) - {ROBOT_FRAME}
        if other:
            raise InputFileError(
                f"has poses of {', '.join(sorted(other))}, but not where that is on the robot; use TUM or JSON lines, which "
                "state it",
                path=path,
            )
    return _reference(
        raw.stamp_ns, raw.position_m, raw.orientation_xyzw, raw.covariance, None, valid, ROBOT_ORIGIN
    )


def _reference(
    stamp_ns: NDArray[np.int64],
    position_m: FloatArray,
    orientation_xyzw: FloatArray,
    covariance: FloatArray | None,
    covariance_common: FloatArray | None,
    valid: NDArray[np.bool_],
    point: ReferencePoint,
) -> ReferencePoses:
    """Assemble; the transform where nothing was computed is the identity."""
    T = np.broadcast_to(np.eye(4), (len(stamp_ns), 4, 4)).copy()
    known = np.isfinite(position_m).all(axis=1) & np.isfinite(orientation_xyzw).all(axis=1)
    T[known] = transform_from(rotation_from_quaternion(orientation_xyzw[known]), position_m[known])
    return ReferencePoses(
        stamp_ns,
        T,
        _where_known(covariance, valid),
        _where_known(covariance_common, valid),
        valid & known,
        point,
    )


def _where_known(covariance: FloatArray | None, valid: NDArray[np.bool_]) -> FloatArray | None:
    """Return covariances if all valid poses have one."""
    if covariance is None or not np.isfinite(covariance[valid]).all():
        return None
    return covariance


def _matrices(rows: Sequence[tuple[float, ...] | None]) -> FloatArray:
    return np.array([_UNKNOWN if row is None else row for row in rows]).reshape(-1, 6, 6)
