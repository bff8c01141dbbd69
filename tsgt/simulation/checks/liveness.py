"""Whether a mission works again when its faults are over: a state machine that is stuck shows as a rate that is low."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation import usable

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from tsgt.simulation.mission import Measured, Run

RECOVERY_S = 10.0
"""So long after the last fault everything is as it was."""

READ_SHARE = 0.8
"""Of what an instrument can measure, a client has read at least so much."""

DELIVERED_SHARE = {"superframe": 0.9, "classic": 0.35}
"""Of what a client has read, at least so much has reached the master. Classic, which asks one station after the other and
now and then stops to synchronise, gets 0.55 to 0.65 in half a minute of a run without faults, with 2 % loss."""

VALID_SHARE = {"superframe": 0.6, "classic": 0.35}
"""Of the poses that the time has room for, at least so many are valid. Superframe with one packet in ten lost had 0.96 to 1
in sixteen runs, and 0.69 in one where a station had two minutes to tell meanwhile, which makes frames 0.8 s long. While
classic synchronises there are none: half a minute after its master's start, when every station is synchronised anew, it has
0.39 to 0.80 with ``linear`` and 2 % loss, in a run without faults; a synchronisation costs 0.06, and each of some five
unanswered polls 0.03. Predicted ones do not count: how long they are certain enough hangs on how old the newest measurement
is."""

ACKNOWLEDGED_S = 20.0
"""So long after a measurement has reached the master, its station waits for an acknowledgement no more. A beacon brings
that within a second or two; the journal tells of it every five."""


def stuck(run: Run, measured: Mapping[int, Measured]) -> Iterator[str]:
    """Look for what does not work any more at the end of a run with faults.

    Parameters
    ----------
    run
        That.
    measured
        What was read, by station number.

    Yields
    ------
    str
        What is stuck, one line each.
    """
    if run.calm_s is None:
        return
    from_s, to_s = run.calm_s + RECOVERY_S, run.duration_s
    session, seconds = run.sessions[-1], to_s - from_s
    delivered: dict[int, int] = dict.fromkeys(run.witnesses, 0)
    for measurement in session.measurements:
        true_ns = measured[measurement.station].true_ns(measurement)
        delivered[measurement.station] += true_ns is not None and from_s <= true_ns / 1e9 < to_s
    protocol = "superframe" if run.superframe else "classic"
    least = DELIVERED_SHARE[protocol]
    for number, witness in run.witnesses.items():
        usable_ns = {m.host_time_ns for m in measured[number].journalled if usable(m)}
        read = sum(
            from_s <= true_ns / 1e9 < to_s
            for host_ns, true_ns in witness.stamps_ns.items()
            if host_ns in usable_ns
        )
        if read < READ_SHARE * run.rate_hz[number] * seconds:
            yield (
                f"station {number} has read {read} measurements in the {seconds:g} s from {from_s:g} s on, "
                f"at {run.rate_hz[number]:g} Hz"
            )
        if delivered[number] < least * read:
            yield (
                f"of {read} measurements that station {number} has read in the {seconds:g} s from {from_s:g} s on, "
                f"{delivered[number]} have reached the master"
            )
    yield from unacknowledged(run, measured)
    poses = session.valid_poses()
    at_s = (poses.stamp_ns[poses.kind != "predicted"] - session.zero_ns) / 1e9
    valid = np.count_nonzero((from_s <= at_s) & (at_s < to_s))
    room = seconds * 1e9 / run.parameters.pipeline.period_ns
    if valid < VALID_SHARE[protocol] * room:
        yield f"{valid} of {room:.0f} poses in the {seconds:g} s from {from_s:g} s on are valid"


def unacknowledged(run: Run, measured: Mapping[int, Measured]) -> Iterator[str]:
    """Look for measurements that the master has, and that wait in their stations' queues all the same."""
    session = run.sessions[-1]
    if not run.superframe:
        return
    oldest = {number: measured[number].oldest_queued() for number in run.witnesses}
    for measurement, arrived_ns in zip(session.measurements, session.arrived_ns, strict=False):
        waited_s = run.duration_s - arrived_ns / 1e9
        if measurement.sequence == oldest[measurement.station] and waited_s > ACKNOWLEDGED_S:
            yield (
                f"station {measurement.station} still waits for the acknowledgement of number {measurement.sequence}, "
                f"which has reached the master {waited_s:.0f} s before the end"
            )
