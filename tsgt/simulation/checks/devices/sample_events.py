"""Invariant of a device of the robot, its IMU or wheels: a silence and its end are events."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tsgt.geometry import FloatArray
    from tsgt.simulation.mission import MasterLog

LOSS_EVENT_S = 2.5
"""A silence that lasts longer must be an event by then: the timeout is 1 s, 2 s after a start of the master, and looked at each quarter of
a second.
"""

TIMEOUT_S = 1.0
"""A shorter silence is none."""

RECOVERY_EVENT_S = 5.0
"""From the first sample after a silence to the event: the program is restarted in vain every 2 s, and its clock fitted anew."""


def missing_events(
    log: MasterLog, arrival_s: FloatArray, device: Literal["imu", "odometry"]
) -> Iterator[str]:
    """Yield each silence, while the master ran, of whose begin or end it gave no event.

    A device that falls silent again soon after a silence may count as lost throughout, and one that has recovered may be lost again
    for a clock that was set.

    ``arrival_s``: (N,) of the samples, in their order, on true time.
    """
    statuses_s = [(status.stamp_ns - log.unix_at_zero_ns) / 1e9 for status in log.statuses]
    if not statuses_s:
        return
    lost, recovered = f"{device}_lost", f"{device}_recovered"
    events = [((event.stamp_ns - log.unix_at_zero_ns) / 1e9, event.event) for event in log.events]

    def newest(until_s: float) -> str:
        """Return the newest of both events; a master begins as with a device that gives samples."""
        return next(
            (name for at_s, name in reversed(events) if at_s <= until_s and name in (lost, recovered)),
            recovered,
        )

    gap_s = np.diff(arrival_s)
    after = np.flatnonzero(gap_s > LOSS_EVENT_S)
    for begin_s, end_s in zip(arrival_s[after].tolist(), arrival_s[after + 1].tolist(), strict=True):
        for due, from_s, until_s in (
            (lost, begin_s, begin_s + LOSS_EVENT_S),
            (recovered, end_s, end_s + RECOVERY_EVENT_S),
        ):
            # It knew the samples before.
            ran = statuses_s[0] + 1.0 < begin_s and until_s < statuses_s[-1]
            silent_again = due == recovered and np.any(
                gap_s[np.searchsorted(arrival_s, from_s) : np.searchsorted(arrival_s, until_s)] > TIMEOUT_S
            )
            recovers = due == recovered and any(
                from_s <= at_s <= until_s and name == due for at_s, name in events
            )
            if ran and not silent_again and not recovers and newest(until_s) != due:
                yield f"silence from {begin_s:.1f} to {end_s:.1f} s: no event {due} by {until_s:.1f} s"
