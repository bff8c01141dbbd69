"""Hypotheses on what of a set-up is wrong, each a direction or a few in the space of its parameters. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from tsgt.geometry.rigid import skew

if TYPE_CHECKING:
    from tsgt.geometry.motion_calibration.setup_parameters import SetupParameters
    from tsgt.geometry.rigid import FloatArray

HypothesisKind = Literal[
    "frame", "turned", "latency", "vertical_index", "collimation", "prism_constant", "range_scale", "prism"
]

WIDE_TRANSLATION_M, WIDE_ROTATION_RAD, WIDE_TURN_RAD = 0.02, 1e-3, 5e-4
WIDE_LATENCY_S = 0.02
WIDE_INSTRUMENT: dict[HypothesisKind, float] = {
    "vertical_index": 5e-4,
    "collimation": 5e-4,
    "prism_constant": 0.02,
    "range_scale": 5e-5,
}
WIDE_PRISM_M = 0.02
"""One sigma of what went wrong in the field, where something did."""

RARE_KINDS: tuple[HypothesisKind, ...] = ("collimation", "range_scale")
RARE_LOG_PRIOR = -2.0
"""Instruments measure their collimation and correct it; a scale of the range has no cause but a wrong temperature."""


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """One station or prism is wrong in one way.

    ``turned``: about the vertical through its tripod after the frames were calibrated. Station 1 defines the frame, so that
    its own displacement is that of all others, reversed.
    """

    kind: HypothesisKind
    row: int  # of the station, or of the prism
    directions: FloatArray  # (G, m) by what is wrong, in m, rad, s or 1
    sigmas: FloatArray  # (m,) if it is wrong
    components: tuple[str, ...]  # Names of the m directions

    @property
    def log_prior(self) -> float:
        """Log prior odds. Where the lines of sight are level, collimation and a turned tripod are the same to the data."""
        return RARE_LOG_PRIOR if self.kind in RARE_KINDS else 0.0

    @property
    def factor(self) -> FloatArray:
        """(G, m) factor of the covariance that the hypothesis adds to the prior's."""
        return self.directions * self.sigmas


def hypotheses(parameters: SetupParameters) -> list[Hypothesis]:
    """Everything that is tested, simpler explanations first."""
    found: list[Hypothesis] = []
    count = parameters.count

    def single(kind: HypothesisKind, row: int, at: int, sigma: float) -> None:
        found.append(Hypothesis(kind, row, np.eye(count)[:, [at]], np.array([sigma]), ("",)))

    displacements = [_displacement(parameters, int(row)) for row in parameters.measured]
    for row, moved in zip(parameters.measured.tolist(), displacements, strict=True):
        up = parameters.reference.frames[row, :3, 2]
        found.append(Hypothesis("turned", row, moved[:, 3:] @ up[:, None], np.array([WIDE_TURN_RAD]), ("",)))
    for i, row in enumerate(parameters.stations.tolist()):
        single("latency", row, int(parameters.latencies[i]), WIDE_LATENCY_S)
    for i, row in enumerate(parameters.measured.tolist()):
        for column, (kind, sigma) in enumerate(WIDE_INSTRUMENT.items()):
            single(kind, row, int(parameters.instrument[i, column]), sigma)
    for row, at in enumerate(parameters.prisms):
        found.append(
            Hypothesis("prism", row, np.eye(count)[:, at], np.full(3, WIDE_PRISM_M), ("x", "y", "z"))
        )
    wide = np.repeat([WIDE_TRANSLATION_M, WIDE_ROTATION_RAD], 3)
    names = ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")
    for row, moved in zip(parameters.measured.tolist(), displacements, strict=True):
        # The translation at the robot, where it is seen, not at the tripod.
        at_robot = moved.copy()
        lever_arm = parameters.pivot - parameters.reference.frames[row, :3, 3]
        at_robot[:, 3:] = moved[:, 3:] + moved[:, :3] @ skew(lever_arm)
        found.append(Hypothesis("frame", row, at_robot, wide, names))
    return found


def _displacement(parameters: SetupParameters, row: int) -> FloatArray:
    """(G, 6) parameters by a displacement of a station: translation of its origin, rotation about the origin."""
    directions = np.zeros((parameters.count, 6))
    lever_arm = parameters.pivot - parameters.reference.frames[row, :3, 3]
    moved = np.flatnonzero(parameters.stations == row) if row else np.arange(len(parameters.stations))
    sign = 1.0 if row else -1.0
    for i in moved:
        directions[np.ix_(parameters.translations[i], range(3))] = sign * np.eye(3)
        directions[np.ix_(parameters.translations[i], range(3, 6))] = -sign * skew(lever_arm)
        directions[np.ix_(parameters.rotations[i], range(3, 6))] = sign * np.eye(3)
    return directions
