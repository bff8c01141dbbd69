"""The recorded samples of the robot's IMU as arrays, with latency and gyro matrix applied."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.inertial import InertialSamples

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tsgt.model import ImuParameters, ImuSamples

_TOUCHING = 0.5
"""Samples whose gap or overlap is shorter than this share of their duration follow each other: stamps follow a fit."""


def inertial_samples(
    records: Iterable[ImuSamples], parameters: ImuParameters, origin_ns: int
) -> InertialSamples:
    """Return the samples of records as arrays in the order of time.

    Samples that follow each other are joined without gap or overlap; those that overlap others otherwise, as after
    a restart, are dropped, and so are those of a device that repeats itself. ``origin_ns``: time origin of the observations, on the master's Unix clock.
    """
    return SampleConverter(parameters, origin_ns).convert(records)


class SampleConverter:
    """Converts records as they arrive: the same samples as :func:`inertial_samples` gives of all records at once."""

    def __init__(self, parameters: ImuParameters, origin_ns: int) -> None:
        self._parameters = parameters
        self._origin_ns = origin_ns
        self._latest_s = self._kept_s = -np.inf
        self._values = np.full((2, 6), np.nan)  # of the two samples before

    def convert(self, records: Iterable[ImuSamples]) -> InertialSamples:
        """Return the samples of further records; those from before earlier ones are dropped."""
        end_ns: list[int] = []
        duration_ns: list[int] = []
        rates: list[tuple[float, float, float]] = []
        forces: list[tuple[float, float, float]] = []
        for record in records:
            end_ns += record.stamp_ns
            duration_ns += record.duration_ns
            rates += record.angular_rate_radps
            forces += record.specific_force_mps2
        # Differences of integers: a Unix time in ns exceeds the precision of a float.
        end_s = (np.array(end_ns, dtype=np.int64) - (self._origin_ns + self._parameters.latency_ns)) / 1e9
        duration_s = np.array(duration_ns, dtype=np.float64) / 1e9
        # Not a product of matrices, whose rounding depends on the number of rows.
        rate = np.array(rates, dtype=np.float64).reshape(-1, 1, 3) * np.array(self._parameters.gyro_matrix)
        rate = rate[:, :, 0] + rate[:, :, 1] + rate[:, :, 2]
        force = np.array(forces, dtype=np.float64).reshape(-1, 3)
        order = np.argsort(end_s, kind="stable")
        samples = InertialSamples(end_s[order], duration_s[order], rate[order], force[order])
        latest_s = np.maximum.accumulate(np.concatenate([[self._latest_s], samples.end_s]))
        values = np.concatenate([self._values, np.concatenate([rate, force], axis=1)[order]])
        same = (values[1:] == values[:-1]).all(axis=1)
        # A device that is asked twice as often as it measures repeats each sample once, a stuck one goes on.
        stuck = same[1:] & same[:-1]
        later = samples.end_s - latest_s[:-1] > _TOUCHING * samples.duration_s
        samples = samples.select(later & ~stuck & (samples.duration_s > 0.0))
        between_s = np.diff(samples.end_s, prepend=self._kept_s)
        touching = between_s < (1 + _TOUCHING) * samples.duration_s
        samples.duration_s[touching] = between_s[touching]
        self._latest_s, self._values = float(latest_s[-1]), values[-2:]
        if len(samples):
            self._kept_s = float(samples.end_s[-1])
        return samples
