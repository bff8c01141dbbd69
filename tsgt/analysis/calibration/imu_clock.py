"""Align the clock of IMU samples that another computer recorded with that of a recording, by the motion of the robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import GeometryError
from tsgt.estimation import build_observations
from tsgt.geometry.inertial import Gravity, InertialSamples
from tsgt.geometry.inertial_calibration import align_clock
from tsgt.model import MIN_PRISMS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from tsgt.geometry.inertial_calibration import ClockAlignment
    from tsgt.model import ImuNoise, ImuSamples
    from tsgt.recording import Recording

_GRAVITY = Gravity(9.81, 0.01, np.zeros(2))
"""Roughly: an error of it becomes one of the accelerometer's bias and scale, which are estimated."""


@dataclass(frozen=True, slots=True)
class AlignedClock:
    """Relation of the clock of imported samples to the master's Unix clock."""

    origin_ns: int  # From which the seconds of ``alignment`` count
    alignment: ClockAlignment

    def to_master_ns(self, stamp_ns: int) -> int:
        """Time on the master's clock of a stamp, both in ns."""
        since_reference_ns = stamp_ns - self.origin_ns - round(1e9 * self.alignment.reference_s)
        offset_ns = round(1e9 * self.alignment.offset_s)
        return stamp_ns - offset_ns - round(self.alignment.drift * since_reference_ns)


def align_recorded_clock(
    recording: Recording,
    records: Iterable[ImuSamples],
    noise: ImuNoise,
    *,
    on_progress: Callable[[float], None] | None = None,
) -> AlignedClock:
    """Find offset and drift of samples on their own clock against the measurements of three prisms.

    ``noise``: of the data sheet, roughly.

    Raises GeometryError: no measurements, fewer than three prisms, or as
    :func:`~tsgt.geometry.inertial_calibration.align_clock`.
    """
    if not recording.measurements:
        raise GeometryError("the recording has no measurements")
    origin_ns = min(measurement.stamp_ns for measurement in recording.measurements)
    observations, _ = build_observations(recording.parameters, recording.measurements, origin_ns=origin_ns)
    if len(np.unique(observations.prism)) < MIN_PRISMS:
        raise GeometryError(
            f"fewer than {MIN_PRISMS} prisms do not tell how the robot turns; give --offset-ms"
        )
    found = align_clock(observations, _samples(records, origin_ns), noise, _GRAVITY, on_progress=on_progress)
    return AlignedClock(origin_ns, found)


def _samples(records: Iterable[ImuSamples], origin_ns: int) -> InertialSamples:
    """Return samples at their stamps, in the axes of the IMU."""
    rows = [
        (stamp_ns - origin_ns, *values)
        for record in records
        for stamp_ns, *values in zip(
            record.stamp_ns,
            record.duration_ns,
            record.angular_rate_radps,
            record.specific_force_mps2,
            strict=True,
        )
    ]
    end_ns, duration_ns, rates, forces = zip(*rows, strict=True)
    return InertialSamples(
        np.array(end_ns) / 1e9, np.array(duration_ns) / 1e9, np.array(rates), np.array(forces)
    )
