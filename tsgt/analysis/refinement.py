"""Refinement of the set-up of a recording within its batch solution."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from tsgt.errors import GeometryError
from tsgt.estimation import parameter_names
from tsgt.geometry.calibration import Setup, SetupParameters, calibrated_covariance, refine_setup

if TYPE_CHECKING:
    from tsgt.geometry import FloatArray
    from tsgt.geometry.calibration import RefinedSetup
    from tsgt.geometry.trajectory import Observations
    from tsgt.model import MotionPrior, Parameters

Refine = Literal["auto", "off", "prisms"]
"""What may be refined where the data disagree with the set-up: frames, latencies and instrument errors (``auto``), nothing,
or the prisms as well."""


def refine_recorded_setup(
    parameters: Parameters,
    observations: Observations,
    prior: MotionPrior,
    noise_scales: FloatArray,
    refine: Refine,
) -> RefinedSetup | None:
    """Refine the set-up of observations, whose parameters state it and its covariance.

    ``prior`` and ``noise_scales``: tuned with that set-up. None: switched off, or the measurements are too few or not polar.
    """
    if refine == "off":
        return None
    setup = Setup.of(observations)
    try:
        layout = SetupParameters.of_observations(observations, setup)
        covariance = calibrated_covariance(
            layout, parameter_names(layout, parameters), parameters.setup_covariance
        )
        return refine_setup(observations, layout, covariance, prior, noise_scales, prisms=refine == "prisms")
    except GeometryError:
        return None
