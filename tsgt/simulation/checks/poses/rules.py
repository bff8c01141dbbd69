"""What the documentation promises of every pose: its epoch, when it is sent, its quaternion, and the limits of a valid one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry import rotation_from_quaternion

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from tsgt.model import Parameters
    from tsgt.simulation.mission import MasterLog, ValidPoses

MAX_SMOOTHING_S = 0.5
"""Final poses are smoothed about twice a second."""

_SENT_TOLERANCE_S = 1e-3
_UNIT_TOLERANCE = 1e-6
_RESIDUAL_TOLERANCE_M = 1e-9
_LIMIT_TOLERANCE = 1.01  # sigmas are compared before they are rounded, and before terms of second order

GOOD_SHARE = 0.5
"""Share of the limits of residual and sigmas up to which a pose is good; beyond it is degraded."""

GOOD_AGE_SHARE = 0.75
"""Share of the outage limit up to which a prediction's newest measurement is not old."""


def rule_failures(master_log: MasterLog, parameters: Parameters) -> Iterator[str]:
    """Yield the broken rules of a master's poses, each once for each series."""
    period_ns = parameters.pipeline.period_ns
    for series, stamps in master_log.epochs_ns.items():
        stamps_ns = np.array(stamps, dtype=np.int64)
        if (stamps_ns % period_ns).any():
            yield f"{series} poses: not all epochs are multiples of the period of {period_ns / 1e9:g} s"
        wrong = np.flatnonzero(np.diff(stamps_ns) != period_ns)
        if len(wrong):
            at_s = (stamps_ns[wrong[0]] - master_log.unix_at_zero_ns) / 1e9
            yield f"{series} poses: the epoch after {at_s:.3f} s is not the next one ({len(wrong)} times)"
    known = {(station.station, station.prism) for station in parameters.stations}
    known.update((measurement.station, measurement.prism) for measurement in master_log.measurements)
    for station, prism in sorted(master_log.trackers - known):
        yield f"poses name station {station} for prism {prism}, which it has never tracked"
    valid = master_log.valid_poses()
    for series in np.unique(valid.series).tolist():
        poses = valid.select(valid.series == series)
        for what, is_wrong in _broken(poses, series, parameters):
            if is_wrong.any():
                row = int(np.argmax(is_wrong))
                at_s = (poses.stamp_ns[row] - master_log.unix_at_zero_ns) / 1e9
                yield f"{series} pose at {at_s:.3f} s: {what} ({np.count_nonzero(is_wrong)} of {len(is_wrong)} poses)"


def _broken(
    poses: ValidPoses, series: str, parameters: Parameters
) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield rules with the poses that break them."""
    limits = parameters.pipeline
    quaternion = poses.orientation_xyzw
    yield (
        "its quaternion is no unit quaternion",
        abs(np.linalg.norm(quaternion, axis=1) - 1) > _UNIT_TOLERANCE,
    )
    yield "its quaternion has w < 0", quaternion[:, 3] < 0
    sent_s = poses.sent_age_s
    earliest_s, latest_s = sent_window_s(series, parameters)
    out = (sent_s < earliest_s - _SENT_TOLERANCE_S) | (sent_s > latest_s + _SENT_TOLERANCE_S)
    yield f"it was not sent {earliest_s:g} to {latest_s:g} s after its epoch", out
    upright = rotation_from_quaternion(quaternion)[:, 2, 2]
    yield "valid in spite of its tilt", upright < np.cos(limits.tilt_limit_rad * _LIMIT_TOLERANCE)
    different = abs(poses.residual_m - poses.station_residual_m) > _RESIDUAL_TOLERANCE_M
    yield "its residual is not that of its stations", different
    shares = [("residual", poses.residual_m / limits.residual_limit_m)]
    if series != "interpolated":
        shares += _sigma_shares(poses, series, parameters)
    for name, share in shares:
        yield f"valid in spite of its {name}", share > _LIMIT_TOLERANCE
        yield f"good in spite of its {name}", poses.good & (share > GOOD_SHARE * _LIMIT_TOLERANCE)
    if series == "predicted":
        old = poses.newest_age_s > GOOD_AGE_SHARE * limits.outage_limit_ns / 1e9 * _LIMIT_TOLERANCE
        yield "good in spite of old measurements", poses.good & old


def _sigma_shares(
    poses: ValidPoses, series: str, parameters: Parameters
) -> list[tuple[str, NDArray[np.float64]]]:
    """Return the sigmas of position and rotation along the least certain direction, as shares of their limits."""
    limits = parameters.pipeline
    position_limit_m, rotation_limit_rad = limits.position_sigma_limit_m, limits.rotation_sigma_limit_rad
    if series == "predicted":
        position_limit_m = limits.predicted_position_sigma_limit_m
        rotation_limit_rad = limits.predicted_rotation_sigma_limit_rad
    parts = (("position", slice(0, 3), position_limit_m), ("rotation", slice(3, 6), rotation_limit_rad))
    return [
        (f"sigma of the {name}", np.sqrt(np.linalg.eigvalsh(poses.covariance[:, part, part])[:, -1]) / limit)
        for name, part, limit in parts
    ]


def sent_window_s(series: str, parameters: Parameters) -> tuple[float, float]:
    """Return the earliest and the latest age of a pose when it is sent."""
    limits = parameters.pipeline
    lag_s, period_s = limits.lag_ns / 1e9, limits.period_ns / 1e9
    if series == "predicted":
        return 0.0, period_s
    if series == "smoothed":
        return lag_s, lag_s + MAX_SMOOTHING_S
    if series == "interpolated":
        return 0.0, limits.outage_limit_ns / 1e9 + limits.transport_limit_ns / 1e9 + period_s
    delay_s = float(series.removeprefix("smoothed_").removesuffix("s"))
    return delay_s, delay_s + period_s
