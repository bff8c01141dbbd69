"""Recovery after faults: a component that does not recover shows as a low rate."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tsgt.estimation import usable
from tsgt.model import MIN_PRISMS
from tsgt.simulation.checks.poses import apparent_poses
from tsgt.simulation.checks.poses.late_stamps import stamps_are_late
from tsgt.simulation.checks.readings import median_stamp_error_s
from tsgt.simulation.faults import FaultKind

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from tsgt.simulation.mission import JournalIndex, MasterLog, MissionResult, StationLog

RECOVERY_TIME_S = 10.0
"""Rates are measured from this time after the last fault."""

MIN_READ_SHARE = 0.8
"""Minimum share of an instrument's measurements that the client reads."""

MIN_DELIVERED_SHARE = {"superframe": 0.9, "classic": 0.35}
"""Minimum share of a client's readings that reach the master. Classic, which polls one station at a time and pauses to
synchronise, reaches 0.55 to 0.65 in half a minute without faults, with 2 % packet loss.
"""

MIN_VALID_SHARE = {"superframe": 0.5, "classic": 0.35}
"""Minimum share of valid poses. Superframe with 10 % packet loss had 0.96 to 1 in sixteen missions, and 0.59 and 0.69 in two in which
stations delivered backlogs of a minute or two, with frames of 0.8 s: up to four measurements of a station arrive before those of the
others from the same time. Classic yields no poses while it synchronises: in the
half minute after its master's start it has 0.39 to 0.80 with ``linear`` and 2 % loss, without faults; a synchronisation
costs 0.06, each of about five unanswered polls 0.03. Predicted poses do not count, because their validity depends on the
age of the newest measurement.
"""

MAX_MISFIT_M = 0.002
"""No poses are expected if stations that have moved distort the prisms' triangle by more: the measurements contradict each other."""

START_MOVE_M, START_S = 0.3, 5.0
"""With one station a trajectory is not searched before the robot has moved so far, and found within this time."""

CONTRADICTION_S, SETUP_CHECK_S = 5.0, 50.0
"""Measurements of these times before the events ``station_contradicted`` and ``imu_setup_wrong`` are looked at for their cause."""

MIN_LATE_S = 0.004
"""Stamps of a station that are later may contradict the IMU: so much is named as a wrong latency. A client that starts while its
instrument is slow takes slow responses for usual ones (docs/explanation/instrument-time.md).
"""


def liveness_failures(result: MissionResult, indices: Mapping[int, JournalIndex]) -> Iterator[str]:
    """Yield what has not recovered at the end of a mission with faults, one line each."""
    if result.faults_end_s is None:
        return
    from_s, to_s = result.faults_end_s + RECOVERY_TIME_S, result.duration_s
    master_log, seconds = result.master_logs[-1], to_s - from_s
    delivered: dict[int, int] = dict.fromkeys(result.station_logs, 0)
    for measurement in master_log.measurements:
        true_ns = indices[measurement.station].true_ns(measurement)
        delivered[measurement.station] += true_ns is not None and from_s <= true_ns / 1e9 < to_s
    protocol = "superframe" if result.superframe else "classic"
    min_share = MIN_DELIVERED_SHARE[protocol]
    for number, station_log in result.station_logs.items():
        usable_ns = {m.host_time_ns for m in indices[number].journalled if usable(m)}
        read = sum(
            from_s <= true_ns / 1e9 < to_s
            for host_ns, true_ns in station_log.true_times_ns.items()
            if host_ns in usable_ns
        )
        if read < MIN_READ_SHARE * result.rate_hz[number] * seconds:
            yield (
                f"station {number}: {read} readings in the {seconds:g} s from {from_s:g} s on, "
                f"minimum {MIN_READ_SHARE:g} of {result.rate_hz[number]:g} Hz"
            )
        if delivered[number] < min_share * read:
            yield (
                f"station {number}: {delivered[number]} of {read} readings in the {seconds:g} s from {from_s:g} s on "
                f"delivered, minimum share {min_share:g}"
            )
    poses = master_log.valid_poses()
    at_s = (
        poses.stamp_ns[np.isin(poses.series, ("interpolated", "smoothed"))] - master_log.unix_at_zero_ns
    ) / 1e9
    due_s = poses_due_from_s(result, from_s, to_s)
    valid = np.count_nonzero((due_s <= at_s) & (at_s < to_s))
    min_valid_share = pose_share(
        protocol,
        stations=len(result.parameters.stations),
        knocked=FaultKind.IMU_KNOCK in result.faults,
        contradicted=contradicted_by_station(result, master_log, indices, from_s),
    )
    expected = (to_s - due_s) * 1e9 / result.parameters.pipeline.period_ns
    misfit_m = apparent_poses(result, master_log, np.arange(from_s, to_s)).misfit_m
    if misfit_m.max(initial=0.0) > MAX_MISFIT_M:
        min_valid_share = 0.0
    if valid < min_valid_share * expected:
        yield (
            f"poses: {valid} of {expected:.0f} in the {to_s - due_s:g} s from {due_s:g} s on valid, "
            f"minimum share {min_valid_share:g}"
        )


def poses_due_from_s(result: MissionResult, from_s: float, to_s: float) -> float:
    """Return the time from which poses are due: with one station not before the robot has moved, because standing tells no heading."""
    if len(result.parameters.stations) > 1:
        return from_s
    times_s = np.arange(from_s - RECOVERY_TIME_S, to_s, 0.1)
    positions = result.true_poses(times_s)[:, :3, 3]
    moved = np.flatnonzero(np.linalg.norm(positions - positions[0], axis=1) > START_MOVE_M)
    return min(max(from_s, times_s[moved[0]] + START_S), to_s) if len(moved) else to_s


def pose_share(protocol: str, *, stations: int, knocked: bool, contradicted: bool) -> float:
    """Minimum share of valid poses.

    An IMU that was knocked is set up wrongly for good. Fewer than three stations have no poses without it. A station with late stamps,
    or on another prism or with its number, contradicts the IMU as one that has moved, also for good, or as one whose set-up is wrong:
    ``contradicted``.
    """
    return 0.0 if (knocked or contradicted) and stations < MIN_PRISMS else MIN_VALID_SHARE[protocol]


def contradicted_by_station(
    result: MissionResult, master_log: MasterLog, indices: Mapping[int, JournalIndex], from_s: float
) -> bool:
    """Whether measurements are said to contradict the IMU for what a station did.

    Its stamps were late, or it followed another prism or had another's number in its configuration. The set-up of the IMU is not
    checked again before new measurements suffice for that.
    """
    prisms = {station.station: station.prism for station in result.parameters.stations}

    def by_station(at_s: float, before_s: float) -> bool:
        others = (
            follows_another(index.station_log, prisms[number], at_s, before_s)
            for number, index in indices.items()
        )
        renumbered = (
            m.prism != prisms[m.station]
            and at_s - before_s <= (m.stamp_ns - master_log.unix_at_zero_ns) / 1e9 <= at_s
            for m in master_log.measurements
        )
        late = (median_stamp_error_s(index, at_s - before_s, at_s) > MIN_LATE_S for index in indices.values())
        return stamps_are_late(indices.values(), at_s) or any(late) or any(others) or any(renumbered)

    setup_wrong = False
    for event in master_log.events:
        at_s = (event.stamp_ns - master_log.unix_at_zero_ns) / 1e9
        if event.event == "station_contradicted" and by_station(at_s, CONTRADICTION_S):
            return True
        if event.event == "imu_setup_wrong":
            setup_wrong = by_station(at_s, SETUP_CHECK_S)
        elif event.event == "imu_setup_confirmed" and at_s < from_s:
            setup_wrong = False
    return setup_wrong


def follows_another(station_log: StationLog, prism: int, at_s: float, before_s: float) -> bool:
    """Whether a station has measured another prism than its own in a time before a true time."""
    return any(
        at_s - before_s <= each.true_ns / 1e9 <= at_s and each.prism not in (None, prism)
        for each in station_log.reported_distances
    )
