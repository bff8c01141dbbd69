"""The live side of the pipeline: what arrives goes in; out comes what belongs on stream and recording, in order.

Pure. The order of calls and the instants handed in decide everything, and all of them stand in the recording; so a
replay, which makes the same calls, gives the same lines bit for bit.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from tsgt.estimation.continuous import ContinuousPipeline
from tsgt.estimation.linear import Pipeline

if TYPE_CHECKING:
    from collections.abc import Mapping

    from tsgt.model import Measurement, Parameters
    from tsgt.recording import PoseRecord


class Feed:
    """Turns arrivals into records: each measurement, followed by the poses that it completed.

    Parameters
    ----------
    parameters
        Stations, prisms and limits in force.
    """

    def __init__(self, parameters: Parameters) -> None:
        continuous = parameters.pipeline.estimator == "continuous"
        self._pipeline = ContinuousPipeline(parameters) if continuous else Pipeline(parameters)
        self._now_ns = -(2**63)
        self._begun = False

    def measurement(self, measurement: Measurement) -> list[Measurement | PoseRecord]:
        """Take a measurement at its ``received_ns``; return it between the poses due before and those due with it.

        An instant before that of an earlier call is moved up to it, in the record as well: the recording states
        when the pipeline had the measurement, because a replay must hand it over at the same point.
        """
        if measurement.received_ns < self._now_ns:
            measurement = dataclasses.replace(measurement, received_ns=self._now_ns)
        if not self._begun:
            self._pipeline.begin_at(measurement.received_ns)
            self._begun = True
        due = self.advance(measurement.received_ns)
        self._pipeline.add(measurement)
        return [*due, measurement, *self.advance(measurement.received_ns)]

    def advance(self, now_ns: int) -> list[PoseRecord]:
        """Return the poses that are due by now. To be called before any other record is put in its place."""
        self._now_ns = max(self._now_ns, now_ns)
        return list(self._pipeline.advance(self._now_ns).records())

    def outside_lag_window(self) -> Mapping[int, int] | None:
        """Return how many measurements of which station came too late for ``continuous``; None with ``linear``."""
        return self._pipeline.outside_lag_window if isinstance(self._pipeline, ContinuousPipeline) else None

    def next_deadline_ns(self) -> int | None:
        """Return when :meth:`advance` should be called if nothing arrives before; None while nothing waits."""
        return self._pipeline.next_deadline_ns()
