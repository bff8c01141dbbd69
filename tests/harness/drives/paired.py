"""Paired poses of a simulated drive, made by hand."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tsgt.analysis.compare import PairedPoses
from tsgt.geometry import transform_from


def drive(count: int, rate_hz: float, *, speed_mps: float = 1.0, stop_s: float = 5.0) -> np.ndarray:
    """Return true poses, (N, 4, 4), of a drive in circles of 20 m that begins with a stop."""
    t = np.maximum(0.0, np.arange(count) / rate_hz - stop_s)
    yaw = speed_mps * t / 20.0
    angles = np.stack([yaw + 0.4, 0.05 * np.sin(t), 0.04 * np.cos(t)], axis=1)
    position_m = np.stack([20 * np.sin(yaw), 20 - 20 * np.cos(yaw), 0.02 * t], axis=1)
    return transform_from(Rotation.from_euler("ZYX", angles).as_matrix(), position_m)


def paired(
    estimated: np.ndarray,
    reference: np.ndarray,
    *,
    rate_hz: float = 10.0,
    covariance: np.ndarray | None = None,
    common: np.ndarray | None = None,
    estimate_covariance: np.ndarray | None = None,
    has_orientation: bool = True,
) -> PairedPoses:
    """Pair poses, (N, 4, 4); covariances, (6, 6), hold for all of them."""

    def everywhere(one: np.ndarray | None) -> np.ndarray | None:
        return None if one is None else np.broadcast_to(one, (len(reference), 6, 6))

    return PairedPoses(
        row=np.arange(len(reference)),
        stamp_ns=np.round(np.arange(len(reference)) * 1e9 / rate_hz).astype(np.int64),
        estimated=estimated,
        reference=reference,
        reference_covariance=everywhere(covariance),
        reference_covariance_common=everywhere(common),
        estimate_covariance=everywhere(estimate_covariance),
        has_orientation=has_orientation,
        n_estimate=len(reference),
        n_outside=0,
        n_reference_gap=0,
        n_reference_weak=0,
    )


def noisy(
    true: np.ndarray, random: np.random.Generator, *, position_m: float, rotation_rad: float
) -> np.ndarray:
    """Add white noise to poses, (N, 4, 4), in the axes of ``station1``."""
    turns = Rotation.from_rotvec(random.normal(scale=rotation_rad, size=(len(true), 3))).as_matrix()
    found = true.copy()
    found[:, :3, :3] = turns @ true[:, :3, :3]
    found[:, :3, 3] += random.normal(scale=position_m, size=(len(true), 3))
    return found
