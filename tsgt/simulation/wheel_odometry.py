"""Wheel odometry of the simulated robot: speed of its origin along its x axis, and its yaw rate, with scale error and slip.

Incremental encoders count over an interval: a sample is the mean over the time since the one before.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import lfilter

from tsgt.geometry import rotate
from tsgt.simulation.imu import DeviceProgram, Silence, StuckValues

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from tsgt.clock import Clock
    from tsgt.simulation.rigid_motion import RigidMotion


ODOMETRY_DELAY_S = 0.008
"""From the end of a sample's interval to its earliest arrival at the host."""

_MEAN_JITTER_S = 0.002
_PARTS = 4  # Instants in an interval whose mean a sample is


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryModel:
    """Errors of wheels or tracks; one sigma. The defaults are assumptions: a robot on tracks, on firm ground."""

    rate_hz: float = 20.0
    scale_error: float = 0.01
    """Relative error of the scale, constant over a mission."""
    slip: float = 0.03
    """Slip in proportion to the speed: a Gauss-Markov process."""
    slip_correlation_time_s: float = 5.0
    speed_noise_mps: float = 0.01
    """White noise of a sample."""
    yaw_rate_noise_radps: float = 0.01
    """White noise of a sample; slip and scale of the yaw rate are drawn like those of the speed, but by themselves."""


@dataclass(frozen=True, slots=True)
class WheelSlip:
    """The wheels spin, slide or are locked: they turn ``factor`` times as fast as the robot moves, and as they would turn it."""

    at_s: float
    duration_s: float
    factor: float


OdometryCondition = Silence | StuckValues | WheelSlip


@dataclass(frozen=True, slots=True)
class OdometrySamples:
    """N samples of wheel odometry, each the mean over the interval that ends at ``time_s``."""

    counter: NDArray[np.int64]  # (N,) of each sample; those that are not delivered are counted
    time_s: NDArray[np.float64]  # (N,) in s from the start of the mission
    arrival_s: NDArray[np.float64]  # (N,) at the host
    speed_mps: NDArray[np.float64]  # (N,) of the robot's origin along its x axis, positive forwards
    yaw_rate_radps: NDArray[np.float64]  # (N,) about the robot's z axis, positive to the left

    def select(self, rows: NDArray[np.bool_]) -> OdometrySamples:
        """Return the samples of some rows."""
        return OdometrySamples(*(getattr(self, each.name)[rows] for each in fields(self)))


def simulate_odometry(
    model: OdometryModel,
    motion_at: Callable[[NDArray[np.float64]], RigidMotion],
    until_s: float,
    *,
    seed: Sequence[int],
    conditions: Sequence[OdometryCondition] = (),
) -> OdometrySamples:
    """Simulate wheel odometry from the start of a mission to ``until_s``; ``motion_at`` covers this time.

    ``conditions``: faults; without any, or with others, the samples outside their times are the same.
    """
    rng = np.random.default_rng([*seed, 0x0D])
    time_s = np.arange(rng.uniform(0.0, 1.0 / model.rate_hz), until_s, 1.0 / model.rate_hz)
    parts = (np.arange(_PARTS) + 0.5) / _PARTS - 1.0
    motion = motion_at(np.maximum(time_s[:, None] + parts / model.rate_hz, 0.0).ravel())
    velocity = rotate(np.swapaxes(motion.rotation, 1, 2), motion.velocity_mps)
    speed, yaw_rate = (
        each.reshape(-1, _PARTS).mean(axis=1) for each in (velocity[:, 0], motion.angular_rate_radps[:, 2])
    )
    scale = 1.0 + rng.normal(0.0, model.scale_error, 2) + _gauss_markov(model, len(time_s), rng)
    noise = rng.standard_normal((2, len(time_s)))
    delay_s = ODOMETRY_DELAY_S + rng.exponential(_MEAN_JITTER_S, len(time_s))
    samples = OdometrySamples(
        np.arange(len(time_s)),
        time_s,
        np.maximum.accumulate(time_s + delay_s),
        scale[:, 0] * speed + model.speed_noise_mps * noise[0],
        scale[:, 1] * yaw_rate + model.yaw_rate_noise_radps * noise[1],
    )
    for condition in conditions:
        samples = _under(condition, samples)
    return samples


def _under(condition: OdometryCondition, samples: OdometrySamples) -> OdometrySamples:
    """Return the samples as they are under a condition."""
    within = (samples.time_s >= condition.at_s) & (samples.time_s < condition.at_s + condition.duration_s)
    rows = np.flatnonzero(within)
    if isinstance(condition, Silence):
        return samples.select(~within)
    speed, yaw_rate = samples.speed_mps.copy(), samples.yaw_rate_radps.copy()
    if isinstance(condition, WheelSlip):
        speed[rows] *= condition.factor
        yaw_rate[rows] *= condition.factor
    elif len(rows):
        last = max(int(rows[0]) - 1, 0)
        speed[rows], yaw_rate[rows] = speed[last], yaw_rate[last]
    return replace(samples, speed_mps=speed, yaw_rate_radps=yaw_rate)


class OdometryProgram(DeviceProgram):
    """The program that reads the simulated wheel odometry; ``clock`` as for that of the IMU."""

    def __init__(self, samples: OdometrySamples, clock: Clock) -> None:
        hello: dict[str, object] = {
            "type": "hello",
            "odometry": 1,
            "make": "Simulated",
            "rate_hz": round(1.0 / float(np.median(np.diff(samples.time_s))), 6),
            "clock": "time since start-up",
        }

        def line_of(rows: slice) -> dict[str, object]:
            return {
                "type": "samples",
                "counter": samples.counter[rows].tolist(),
                "instrument_time_ns": np.rint(samples.time_s[rows] * 1e9).astype(np.int64).tolist(),
                "host_time_ns": np.rint(samples.arrival_s[rows] * 1e9).astype(np.int64).tolist(),
                "speed_mps": np.round(samples.speed_mps[rows], 6).tolist(),
                "yaw_rate_radps": np.round(samples.yaw_rate_radps[rows], 6).tolist(),
            }

        super().__init__(hello, samples.arrival_s, line_of, clock)


def _gauss_markov(model: OdometryModel, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Two stationary first-order Gauss-Markov processes with the slip's sigma, (count, 2)."""
    kept = np.exp(-1.0 / (model.rate_hz * model.slip_correlation_time_s))
    steps = rng.standard_normal((count, 2)) * np.sqrt(1.0 - kept**2)
    steps[:1] /= np.sqrt(1.0 - kept**2)
    slip: NDArray[np.float64] = model.slip * lfilter([1.0], [1.0, -kept], steps, axis=0)
    return slip
