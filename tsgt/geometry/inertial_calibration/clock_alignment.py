"""Offset and drift of the clock that stamped an IMU's samples, from the motion of the robot. Sans-I/O.

The turns of one part of a drive find the offset, however large; the latencies that calibrations from several parts give, each by
itself, find how it changes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.errors import GeometryError
from tsgt.geometry.batch import fit_trajectory
from tsgt.geometry.inertial_calibration.alignment import (
    MAX_LATENCY_S,
    align,
    series_of_samples,
    series_of_trajectory,
)
from tsgt.geometry.inertial_calibration.calibration import MIN_DURATION_S, calibrate_imu
from tsgt.geometry.inertial_calibration.setup import LATENCY

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.geometry.inertial import Gravity, InertialSamples
    from tsgt.geometry.rigid import FloatArray
    from tsgt.geometry.trajectory import Observations
    from tsgt.model import ImuNoise

PART_S = 150.0  # Tells the latency to half a millisecond
MIN_PARTS, MAX_PARTS = 2, 12  # Evenly distributed; more would take minutes of computing
MIN_OVERLAP_S = 60.0
"""Of a part of the drive with the samples, to find the offset: the turns of 20 s resemble others at one of all the shifts that are tried."""

STEADY_DRIFT = (
    2e-5  # Changes the offset by 3 ms within a part: below it, the latencies are those of the middle
)
MAX_ROUNDS = 4
MAX_DRIFT = 2e-4  # Of an oscillator that nothing adjusts
MAX_UNEVEN_S = (
    0.01  # rms of the latencies about a line, which clocks that are not stepped follow to a few milliseconds
)


@dataclass(frozen=True, slots=True)
class ClockAlignment:
    """Clock of an IMU's stamps against that of the measurements. The latency of the stamps is part of the offset."""

    reference_s: float  # Stamp at which ``offset_s`` holds
    offset_s: float  # Stamp less time of the measurements
    drift: float  # Change of the offset per second of the stamps
    offset_sigma_s: float
    drift_sigma: float
    parts: int  # Of the drive that were compared
    rms_s: float  # Of their offsets about the line

    def to_measurements_s(self, stamp_s: FloatArray) -> FloatArray:
        """(N,) times on the clock of the measurements."""
        return stamp_s - self.offset_s - self.drift * (stamp_s - self.reference_s)


class PartOffset(NamedTuple):
    """Offset of the stamps in the middle of a part of the drive."""

    stamp_s: float
    offset_s: float
    sigma_s: float


def align_clock(
    observations: Observations,
    samples: InertialSamples,
    noise: ImuNoise,
    gravity: Gravity,
    *,
    on_progress: Callable[[float], None] | None = None,
) -> ClockAlignment:
    """Find offset and drift, without a first guess.

    Raises GeometryError: the robot turns too little, the samples are not of this drive, or their clock did not run evenly.

    Parameters
    ----------
    observations : Of three prisms, in the order of time, with the layout in the axes of the robot and the stated noise.
    samples : At their stamps.
    noise : Of the data sheet, roughly.
    on_progress : Called with the completed share of the work, 0 to 1.
    """
    report = on_progress or (lambda _: None)
    parts = _parts(observations)
    clock = ClockAlignment(0.0, _offset_s(parts, samples, gravity), 0.0, 0.0, 0.0, 0, 0.0)
    for number in range(MAX_ROUNDS):
        found = []
        for done, part in enumerate(parts):
            # One round as a rule, sometimes two.
            report(1.0 - 0.5 ** (number + done / len(parts)))
            try:
                found.append(_part_offset(part, samples, noise, gravity, clock))
            except GeometryError:
                continue  # A robot that stands, an outage, a wrong prism
        before, clock = clock, fit_clock(found)
        if abs(clock.drift - before.drift) < STEADY_DRIFT:
            break
    report(1.0)
    return clock


def fit_clock(parts: list[PartOffset]) -> ClockAlignment:
    """Fit a line. Raises GeometryError: too few parts, or offsets that are not on a line."""
    if len(parts) < MIN_PARTS:
        raise GeometryError(
            f"the drift of the IMU's clock needs {MIN_PARTS} parts of a drive, of at least {MIN_DURATION_S:g} s each, in which the "
            f"robot turns and three prisms are measured; found {len(parts)}"
        )
    stamps_s, offsets_s, sigmas_s = np.array(parts).T
    weights = sigmas_s**-2.0
    reference_s = float(weights @ stamps_s / weights.sum())
    design = np.stack([np.ones_like(stamps_s), stamps_s - reference_s], axis=1)
    covariance = np.linalg.inv(design.T @ (weights[:, None] * design))
    line = covariance @ design.T @ (weights * offsets_s)
    residuals_s = offsets_s - design @ line
    rms_s = float(np.sqrt(np.mean(residuals_s**2)))
    if rms_s > MAX_UNEVEN_S or abs(line[1]) > MAX_DRIFT:
        raise GeometryError(
            f"the clock of the IMU did not run evenly: its offsets are {1e3 * rms_s:.0f} ms (rms) from a line of {1e6 * line[1]:+.0f} ppm "
            f"(limits {1e3 * MAX_UNEVEN_S:.0f} ms and {1e6 * MAX_DRIFT:.0f} ppm). It was stepped, or adjusted by a time server: import what "
            "was recorded before and after that by itself"
        )
    freedom = len(parts) - MIN_PARTS
    scale = max(1.0, float(weights @ residuals_s**2) / freedom) if freedom else 1.0
    sigmas = np.sqrt(scale * np.diag(covariance))
    return ClockAlignment(
        reference_s, float(line[0]), float(line[1]), float(sigmas[0]), float(sigmas[1]), len(parts), rms_s
    )


def _parts(observations: Observations) -> list[Observations]:
    """Parts of a drive; those of a short one are shorter."""
    first_s, last_s = float(observations.time_s[0]), float(observations.time_s[-1])
    length_s = min(PART_S, (last_s - first_s) / MIN_PARTS)
    count = min(max(int((last_s - first_s) / PART_S), MIN_PARTS), MAX_PARTS)
    starts_s = np.linspace(first_s, last_s - length_s, count)
    return [
        observations.select((observations.time_s >= start_s) & (observations.time_s <= start_s + length_s))
        for start_s in starts_s.tolist()
    ]


def _offset_s(parts: list[Observations], samples: InertialSamples, gravity: Gravity) -> float:
    """Offset of the stamps by the turns of the first part that finds it."""
    imu, problem = series_of_samples(samples), GeometryError("the recording is too short")
    for part in parts:
        try:
            robot = series_of_trajectory(fit_trajectory(part).trajectory, gravity)
            return align(robot, imu, min_overlap_s=MIN_OVERLAP_S, max_latency_s=np.inf).latency_s
        except GeometryError as error:
            problem = error
    raise problem


def _part_offset(
    part: Observations, samples: InertialSamples, noise: ImuNoise, gravity: Gravity, clock: ClockAlignment
) -> PartOffset:
    """Offset of the stamps in a part of the drive by a calibration, with stamps corrected by a clock that is known roughly."""
    times_s = clock.to_measurements_s(samples.end_s)
    first, last = np.searchsorted(times_s, part.time_s[[0, -1]] + np.array([-MAX_LATENCY_S, MAX_LATENCY_S]))
    own = replace(samples.select(slice(first, last)), end_s=times_s[first:last])
    found = calibrate_imu(part, own, noise, gravity)
    at_s = 0.5 * float(part.time_s[0] + part.time_s[-1]) + found.setup.latency_s
    row = int(np.searchsorted(times_s, at_s).clip(0, len(times_s) - 1))
    corrected_s = float(samples.end_s[row] - times_s[row])
    return PartOffset(
        float(samples.end_s[row]), corrected_s + found.setup.latency_s, float(found.sigmas[LATENCY])
    )
