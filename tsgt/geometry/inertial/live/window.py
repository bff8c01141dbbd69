"""The window of a fixed-lag smoother: knots, the factors between them, and what new ones follow from. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.geometry.inertial.factors import InertialFactors, assemble_inertial
from tsgt.geometry.inertial.query import strapdown
from tsgt.geometry.inertial.solver import MAX_BIAS_ROTATION_RAD, MAX_KNOT_SPACING_S
from tsgt.geometry.rigid import dot
from tsgt.geometry.trajectory.motion_prior import transition

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tsgt.geometry.inertial.anchor import InertialAnchor
    from tsgt.geometry.inertial.bordered import BorderedCholesky
    from tsgt.geometry.inertial.factors import InertialEquations
    from tsgt.geometry.inertial.odometry import Odometry
    from tsgt.geometry.inertial.preintegration import ContiguousSamples
    from tsgt.geometry.inertial.sensitivity import Linearised
    from tsgt.geometry.inertial.states import Gravity, InertialStates
    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory.measurement_factors import Observations
    from tsgt.model import ImuNoise, MotionPrior


@dataclass(frozen=True, slots=True)
class KnotWindow:
    """Knots, the factors between them, and the anchor prior on the first."""

    knots: InertialStates
    factors: InertialFactors
    kinematics: tuple[FloatArray, FloatArray]  # Angular rate and specific force at the knots
    anchor: InertialAnchor
    samples: ContiguousSamples

    def select(self, rows: slice) -> KnotWindow:
        """Return some knots, all from the first or all up to the last."""
        steps = slice(rows.start, None if rows.stop is None else rows.stop - 1)
        kinematics = self.kinematics[0][rows], self.kinematics[1][rows]
        return KnotWindow(
            self.knots.select(rows), self.factors.select(steps), kinematics, self.anchor, self.samples
        )

    def assemble(
        self,
        observations: Observations,
        knot_index: NDArray[np.intp],
        knots: InertialStates,
        gravity: Gravity,
        *,
        rejectable: NDArray[np.bool_],
        active: NDArray[np.bool_] | None = None,
    ) -> InertialEquations:
        """Assemble the normal equations at states of the knots."""
        return assemble_inertial(
            observations,
            knot_index,
            knots,
            self.kinematics,
            gravity,
            self.factors,
            self.anchor,
            active=active,
            rejectable=rejectable,
        )

    def factors_at(
        self,
        knots: InertialStates,
        samples: ContiguousSamples,
        noise: ImuNoise,
        *,
        stale_from_s: float,
        gyro_only: MotionPrior | None,
        odometry: Odometry | None,
    ) -> InertialFactors:
        """Factors between knots: those of the window where neither knots nor samples nor the gyro's bias have changed.

        ``stale_from_s``: from this time on samples have changed.
        """
        old, old_s, times_s = self.factors, self.knots.time_s, knots.time_s
        row = old_s.searchsorted(times_s[:-1])
        row[row >= len(old)] = 0
        kept = np.zeros(len(times_s) - 1, np.bool_)
        if len(old):
            kept = (old_s[row] == times_s[:-1]) & (old_s[row + 1] == times_s[1:])
            kept &= times_s[1:] <= stale_from_s
            moved = knots.gyro_bias[:-1] - old.preintegrated.gyro_bias[row]
            kept &= np.sqrt(dot(moved, moved)) * np.diff(times_s) < MAX_BIAS_ROTATION_RAD
        if kept.all():
            return old.select(row)
        changed = np.flatnonzero(~kept)
        found = InertialFactors.between(
            samples,
            knots.select(changed),
            times_s[changed + 1],
            noise,
            gyro_only=gyro_only,
            odometry=odometry,
        )
        if not kept.any():
            return found
        row[changed] = len(old) + np.arange(len(changed))
        return old.joined(found).select(row)


class SolvedWindow(NamedTuple):
    """A solution of the window."""

    window: KnotWindow  # With the solution's knots
    gravity: Gravity
    factor: BorderedCholesky
    linearised: Linearised


def propagate(
    states: InertialStates, row: int, factors: InertialFactors, gravity: Gravity, prior: MotionPrior | None
) -> None:
    """Set a state, in place, to what follows from the one before."""
    start, motion = states.select(slice(row - 1, row)), factors.preintegrated.select(slice(row - 1, row))
    if prior is None:
        found = strapdown(start, gravity, motion)
        states.position[row] = found.position[0]
        states.rotation[row] = found.rotation[0]
        states.velocity[row] = found.velocity[0]
        states.bias_or_acceleration[row] = start.bias_or_acceleration[0]
    else:
        phi = transition(motion.duration_s, np.array(prior.acceleration_correlation_time_s))[0]
        axes = np.concatenate([start.position, start.velocity, start.bias_or_acceleration])
        moved = phi @ axes
        states.position[row], states.velocity[row], states.bias_or_acceleration[row] = moved
        states.rotation[row] = start.rotation[0] @ motion.rotation[0]
    states.gyro_bias[row] = start.gyro_bias[0]
    if factors.odometry is not None:
        states.wheels[row] = factors.odometry.kept[row - 1] * start.wheels[0]


def divided(times_s: FloatArray) -> FloatArray:
    """Insert times so that none is further than the largest spacing from the next."""
    steps = np.ceil(np.diff(times_s) / MAX_KNOT_SPACING_S - 1e-9).astype(np.int64)
    parts = [
        times_s[i] + (times_s[i + 1] - times_s[i]) * np.arange(count) / count
        for i, count in enumerate(steps.tolist())
    ]
    return np.concatenate([*parts, times_s[-1:]])
