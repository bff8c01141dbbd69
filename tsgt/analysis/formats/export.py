"""Poses and measurements as TUM for evo, and as CSV for spreadsheets (columns: docs/reference/csv.md)."""

from __future__ import annotations

import csv
import math
from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation import POINT_COMMENT, reference_point_text
from tsgt.model import WORLD_FRAME, PointMeasurement

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from tsgt.estimation import PoseBatch
    from tsgt.model import Measurement, ReferencePoint
    from tsgt.recording import PoseRecord

POSE_COLUMNS = (
    *("stamp_ns", "valid", "reason", "quality", "degraded_by", "estimator", "kind"),
    *("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"),
    *("sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_rx_rad", "sigma_ry_rad", "sigma_rz_rad"),
    *("vx_mps", "vy_mps", "vz_mps", "wx_radps", "wy_radps", "wz_radps"),
    *("residual_m", "child_frame"),
)

_ROWS_AT_ONCE = 4096  # Python numbers take five times the memory of the arrays

MEASUREMENT_COLUMNS = (
    *("type", "station", "prism", "sequence", "stamp_ns", "received_ns", "status"),
    *("horizontal_angle_rad", "zenith_angle_rad", "slope_distance_m"),
    *("x_m", "y_m", "z_m"),
    *("stamp_sigma_ns", "stamp_bound_ns", "raw_status", "host_time_ns", "instrument_time_ns"),
)


def tum_lines(
    poses: Iterable[tuple[int, Sequence[float], Sequence[float]]], point: ReferencePoint
) -> Iterator[str]:
    """Format valid poses (Unix ns; m; unit quaternion x, y, z, w) as the TUM benchmark does: ``stamp_s x y z qx qy qz qw``.

    Seconds with nine decimals, exact to the nanosecond; metres to the nanometre. A comment states the point of the poses.
    """
    yield f"# {point.name} in {WORLD_FRAME}: stamp_s x y z qx qy qz qw\n"
    yield f"{POINT_COMMENT} {reference_point_text(point)}\n"
    row = "{:d}.{:09d} {:.9f} {:.9f} {:.9f} {:.12f} {:.12f} {:.12f} {:.12f}\n".format
    for stamp_ns, position_m, orientation_xyzw in poses:
        yield row(*divmod(stamp_ns, 1_000_000_000), *position_m, *orientation_xyzw)


def valid_rows(batch: PoseBatch) -> Iterator[tuple[int, Sequence[float], Sequence[float]]]:
    """Yield time, position and orientation of the valid poses of a batch, for :func:`tum_lines`."""
    columns = (batch.stamp_ns, batch.position_m, batch.orientation_xyzw)
    rows = np.flatnonzero(batch.valid)
    for some in np.split(rows, range(_ROWS_AT_ONCE, len(rows), _ROWS_AT_ONCE)):
        yield from zip(*(column[some].tolist() for column in columns), strict=True)


def valid_records(
    poses: Iterable[PoseRecord],
) -> Iterator[tuple[int, Sequence[float], Sequence[float]]]:
    """Yield time, position and orientation of the valid records, for :func:`tum_lines`."""
    for pose in poses:
        if pose.valid and pose.position_m is not None and pose.orientation_xyzw is not None:
            yield pose.stamp_ns, pose.position_m, pose.orientation_xyzw


def pose_csv(poses: Iterable[PoseRecord]) -> Iterator[str]:
    """Yield the header and one CSV line per pose, valid or not; cells without a value are empty."""
    line = _line_writer()
    yield line(POSE_COLUMNS)
    for pose in poses:
        sigmas = (
            [None] * 6 if pose.covariance is None else [math.sqrt(pose.covariance[7 * i]) for i in range(6)]
        )
        yield line(
            (
                *(pose.stamp_ns, int(pose.valid), pose.reason, pose.quality, " ".join(pose.degraded_by)),
                *(pose.estimator, pose.kind),
                *(pose.position_m or [None] * 3),
                *(pose.orientation_xyzw or [None] * 4),
                *sigmas,
                *(pose.velocity_mps or [None] * 3),
                *(pose.angular_velocity_radps or [None] * 3),
                *(pose.residual_m, pose.child_frame),
            )
        )


def measurement_csv(measurements: Iterable[Measurement]) -> Iterator[str]:
    """Yield the header and one CSV line per measurement; cells without a value are empty."""
    line = _line_writer()
    yield line(MEASUREMENT_COLUMNS)
    for m in measurements:
        polar: Sequence[float | None] = [None] * 3
        position: Sequence[float | None] = [None] * 3
        times: Sequence[int | None] = [None] * 5
        if isinstance(m, PointMeasurement):
            position = m.position_m
        else:
            polar = (m.horizontal_angle_rad, m.zenith_angle_rad, m.slope_distance_m)
            times = (m.stamp_sigma_ns, m.stamp_bound_ns, m.raw_status, m.host_time_ns, m.instrument_time_ns)
        identification = (m.type, m.station, m.prism, m.sequence, m.stamp_ns, m.received_ns, m.status.value)
        yield line((*identification, *polar, *position, *times))


def _line_writer() -> Callable[[Iterable[object]], str]:
    """Return a function that formats a row as one line of CSV: ``writerow`` returns what ``write`` returns."""
    return csv.writer(_Echo(), lineterminator="\n").writerow


class _Echo:
    def write(self, line: str) -> str:
        return line
