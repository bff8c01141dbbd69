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
    a restart, are dropped. ``origin_ns``: time origin of the observations, on the master's Unix clock.
    """
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
    end_s = (np.array(end_ns, dtype=np.int64) - (origin_ns + parameters.latency_ns)) / 1e9
    duration_s = np.array(duration_ns, dtype=np.float64) / 1e9
    rate = np.array(rates, dtype=np.float64).reshape(-1, 3) @ np.array(parameters.gyro_matrix).T
    force = np.array(forces, dtype=np.float64).reshape(-1, 3)
    order = np.argsort(end_s, kind="stable")
    samples = InertialSamples(end_s[order], duration_s[order], rate[order], force[order])
    latest = np.concatenate([[-np.inf], np.maximum.accumulate(samples.end_s)[:-1]])
    samples = samples.select(samples.end_s - latest > _TOUCHING * samples.duration_s)
    between = np.diff(samples.end_s)
    touching = between < (1 + _TOUCHING) * samples.duration_s[1:]
    samples.duration_s[1:][touching] = between[touching]
    return samples
