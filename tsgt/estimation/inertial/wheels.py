"""The recorded samples of the wheel odometry as arrays, with the latency applied."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.geometry.inertial import WheelSamples

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tsgt.model import OdometryParameters, OdometrySamples


_MAX_SPEED_MPS = 50.0  # As of the lines of a program; a damaged recording may hold more


def wheel_samples(
    records: Iterable[OdometrySamples], parameters: OdometryParameters, origin_ns: int
) -> WheelSamples:
    """Return the valid samples of records in the order of time; ``origin_ns``: time origin of the observations, on Unix time."""
    return WheelConverter(parameters, origin_ns).convert(records)


class WheelConverter:
    """Converts records as they arrive: the same samples as :func:`wheel_samples` gives of all records at once."""

    def __init__(self, parameters: OdometryParameters, origin_ns: int) -> None:
        self._zero_ns = origin_ns + parameters.latency_ns
        self._latest_s = -np.inf

    def convert(self, records: Iterable[OdometrySamples]) -> WheelSamples:
        """Return the samples of further records; those that are not after earlier ones are dropped."""
        rows = [
            (stamp_ns, duration_ns, speed_mps)
            for record in records
            for stamp_ns, duration_ns, speed_mps, valid in zip(
                record.stamp_ns, record.duration_ns, record.speed_mps, record.valid, strict=True
            )
            if valid and duration_ns > 0 and abs(speed_mps) <= _MAX_SPEED_MPS
        ]
        # Differences of integers: a Unix time in ns exceeds the precision of a float.
        end_s = (np.array([each[0] for each in rows], dtype=np.int64) - self._zero_ns) / 1e9
        duration_s = np.array([each[1] for each in rows], dtype=np.float64) / 1e9
        speed = np.array([each[2] for each in rows], dtype=np.float64)
        order = np.argsort(end_s, kind="stable")
        samples = WheelSamples(end_s[order], duration_s[order], speed[order])
        is_later = samples.end_s > self._latest_s
        samples = samples.select(is_later & (np.diff(samples.end_s, prepend=-np.inf) > 0))
        if len(samples):
            self._latest_s = float(samples.end_s[-1])
        return samples
