"""Factors on the stated noise of the measurements, between parameters and the estimator ``continuous``. Sans-I/O.

The factor of a station's component is that of the pipeline, common to all instruments, times the station's own.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.model import Parameters, Vector3


def noise_scales(parameters: Parameters) -> FloatArray:
    """(S + 1, 3) factors by station and component; the last row is for Cartesian points, of whatever station."""
    stations = [station.noise_scale for station in parameters.stations]
    return parameters.pipeline.noise_scale * np.array([*stations, (1.0, 1.0, 1.0)])


def with_noise_scales(parameters: Parameters, scales: FloatArray, overall: float) -> Parameters:
    """Return the parameters with these factors, (S + 1, 3), of which ``overall`` is common to all."""
    stations = tuple(
        replace(station, noise_scale=cast("Vector3", tuple(map(float, scales[row] / overall))))
        for row, station in enumerate(parameters.stations)
    )
    return replace(parameters, stations=stations, pipeline=replace(parameters.pipeline, noise_scale=overall))
