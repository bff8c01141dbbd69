"""Priors on the set-up, as factors of their covariance: of a calibration from motion, and of calibrated days. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.motion_calibration.setup_parameters import INSTRUMENT_ERRORS, deformation_modes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.geometry.motion_calibration.setup_parameters import SetupParameters
    from tsgt.geometry.rigid import FloatArray
    from tsgt.model import SetupCovariance

ARCSECOND_RAD = np.pi / 648_000

FRAME_SIGMA_M, FRAME_SIGMA_RAD = 3e-3, 1e-4
"""Of a frame whose covariance is unknown: that of eight targets at 20 to 100 m with residuals of a few mm."""

LATENCY_SIGMA_S = 1e-3
INSTRUMENT_SIGMAS = {
    "vertical_index": 5 * ARCSECOND_RAD,
    "collimation": 5 * ARCSECOND_RAD,
    "prism_constant": 1e-3,
    "range_scale": 2e-6,
}
"""Of an adjusted instrument (data sheets of tracking total stations), and of a prism constant from its maker."""

PRISM_SIGMA_M = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class SetupPrior:
    """What to estimate, and its prior: one sigma each, 0 for what is fixed."""

    translation_sigma_m: float = 0.0  # Of each coordinate of the robot as seen by each station but the first
    rotation_sigma_rad: float = 0.0  # Of a station's rotation about each axis
    levelled: bool = False  # Stations rotate about the vertical only: 4 instead of 6 degrees of freedom
    latency_sigma_s: float = 0.0  # Of a station's latency relative to that of station 1
    prism_sigma_m: float = 0.0  # Of each coordinate of a prism relative to the others

    def factor(self, parameters: SetupParameters) -> FloatArray:
        """(G, r) factor of the prior covariance. Raises GeometryError: nothing to estimate."""
        sigmas = np.zeros(parameters.count)
        sigmas[parameters.translations] = self.translation_sigma_m
        if self.translation_sigma_m > 0:
            sigmas[parameters.rotations[:, 2:] if self.levelled else parameters.rotations] = (
                self.rotation_sigma_rad
            )
        sigmas[parameters.latencies] = self.latency_sigma_s
        columns = np.diag(sigmas)[:, sigmas > 0]
        if self.prism_sigma_m > 0:
            modes = deformation_modes(parameters.reference.layout)
            prisms = np.zeros((parameters.count, modes.shape[1]))
            prisms[parameters.prisms.ravel()] = self.prism_sigma_m * modes
            columns = np.concatenate([columns, prisms], axis=1)
        if not columns.shape[1]:
            raise GeometryError("nothing to estimate: frames, latencies and prisms are all fixed")
        return columns


def calibrated_covariance(
    parameters: SetupParameters, names: Sequence[str], known: SetupCovariance | None
) -> FloatArray:
    """(G, G) covariance of a calibrated set-up: the ``known`` one, and defaults for what it does not contain.

    ``names``: components that the parameters stand for, see :meth:`SetupParameters.names`.
    """
    sigmas = np.zeros(parameters.count)
    sigmas[parameters.translations], sigmas[parameters.rotations] = FRAME_SIGMA_M, FRAME_SIGMA_RAD
    sigmas[parameters.latencies] = LATENCY_SIGMA_S
    for column, error in enumerate(INSTRUMENT_ERRORS):
        sigmas[parameters.instrument[:, column]] = INSTRUMENT_SIGMAS[error]
    sigmas[parameters.prisms] = PRISM_SIGMA_M
    covariance = np.diag(sigmas**2)
    if known is not None:
        rows = {name: row for row, name in enumerate(known.components)}
        ours = [i for i, name in enumerate(names) if name in rows]
        theirs = [rows[names[i]] for i in ours]
        covariance[np.ix_(ours, ours)] = np.array(known.matrix)[np.ix_(theirs, theirs)]
    to_pivot = parameters.from_station_origins()
    return to_pivot @ covariance @ to_pivot.T


def factor_of(covariance: FloatArray) -> FloatArray:
    """(G, r) factor of a covariance that may be singular, in mixed units."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    used = values > 1e-12 * max(float(values[-1]), 1e-300)
    factor: FloatArray = scale[:, None] * vectors[:, used] * np.sqrt(values[used])
    return factor
