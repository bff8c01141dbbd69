"""Which measurement of a station is the newest, as others arrive late. Sans-I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from tsgt.model.measurements import Measurement

MAX_SEQUENCE_STEP = 100_000
"""By which a client continues its numbers, four restarts included. One that cannot write its journal takes random ones, up to 4 million above."""


class NewestMeasurement(NamedTuple):
    """The newest measurement of a station so far."""

    sequence: int
    stamp_ns: int

    def is_newer_than(self, measurement: Measurement) -> bool:
        """Whether a measurement was made before this one: its stamp is earlier, and its number does not continue this one's.

        One that continues the numbers is newer; an earlier stamp then means that the station's clock was stepped.
        """
        step = measurement.sequence - self.sequence
        return measurement.stamp_ns < self.stamp_ns and not 0 <= step <= MAX_SEQUENCE_STEP

    @classmethod
    def of(cls, measurement: Measurement) -> NewestMeasurement:
        """Return a measurement's numbers."""
        return cls(measurement.sequence, measurement.stamp_ns)


NO_MEASUREMENT = NewestMeasurement(-1, 0)
