"""Invariants of every simulated mission, whatever faults occur.

Each check uses its own path to the data: journals are read from disk, poses are refitted.
"""

from __future__ import annotations

import math
from functools import partial
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

from tsgt.errors import RecordingError
from tsgt.estimation import usable
from tsgt.master.classic import UNTIMED_SIGMA_NS
from tsgt.master.replay import replayed
from tsgt.model import Status
from tsgt.recording import load_recording
from tsgt.simulation.checks.acknowledgements import missing_acknowledgements
from tsgt.simulation.checks.devices import imu_failures, imu_status_failures, odometry_failures
from tsgt.simulation.checks.heard_lines import heard_failures
from tsgt.simulation.checks.liveness import liveness_failures
from tsgt.simulation.checks.outstanding import outstanding_failures
from tsgt.simulation.checks.poll_replies import unpublished_replies
from tsgt.simulation.checks.poses import (
    age_failures,
    lateness_failures,
    layout_failures,
    missing_poses,
    pose_failures,
    rule_failures,
    scale_failures,
    twist_failures,
)
from tsgt.simulation.checks.readings import readings_by_start
from tsgt.simulation.checks.recorded_lines import lost_lines, recording_failures, size_failures
from tsgt.simulation.checks.setup_lines import beacon_failures, parameter_failures, setup_failures
from tsgt.simulation.checks.station_events import event_failures
from tsgt.simulation.checks.station_reports import report_failures
from tsgt.simulation.checks.status_numbers import status_failures
from tsgt.simulation.faults import NTP_SLEW_PPM
from tsgt.simulation.mission import JournalIndex

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from tsgt.model import PolarMeasurement
    from tsgt.simulation.instrument import ReportedDistance
    from tsgt.simulation.mission import MasterLog, MissionResult, StationLog

_ROUNDING_NS = 1_000
# Half a unit of the radio encoding, plus floating-point rounding.
_ANGLE_ROUNDING_RAD = math.tau / 2**25 * 1.001
_DISTANCE_ROUNDING_M = 0.0501e-3
# Above the latency of any station, which is subtracted from the timestamps.
_MAX_LATENCY_NS = 5_000_000_000
# Spread of response times, which limits the first timestamps.
_MAX_TIMESTAMP_ERROR_NS = 40_000_000
# The fastest response, which the configuration subtracts.
_FASTEST_RESPONSE_NS = 20_000_000
# Limit of the median over at least this number; the median of a whole mission is within 1 ms.
_MIN_TIMESTAMPS = 40
_MAX_MEDIAN_ERROR_NS = 5_000_000
# Longer than any outage of the radio that a fault causes.
_SLEW_SHOWS_S = 30.0


class Violation(NamedTuple):
    """A violated invariant."""

    check: str  # name of the invariant
    detail: str  # subject, measured value and limit, in one line


def check_invariants(result: MissionResult, *, replay: bool = True) -> list[Violation]:
    """Check all invariants of a mission; ``replay``: also that of the replay, which computes all poses again.

    - Every reading of a client is journalled once, with the instrument's values and the time of the measurement.
    - Measurements are delivered as journalled, and at most once.
    - Over ``superframe``, every measurement is recorded or still queued; over ``classic``, every one that was polled is published.
    - Timestamp errors are within the stated bounds.
    - Valid poses rest on usable measurements and agree with the truth within their covariance, which is not too large; they are
      neither late nor early, and state the right ages.
    - Without faults, poses are valid where the measurements allow it.
    - The recording is the stream, and the status counts what is on it.
    - A replay of the recording reproduces the stream.
    - Recorded samples of IMU and wheel odometry are those that they gave, at their true times; silent wheels are an event.
    - A station that moves so that the prisms' triangle is distorted is an event.
    - After the faults, rates recover; collections in memory stay bounded.
    """
    found: list[Violation] = []
    indices = {number: JournalIndex(station_log) for number, station_log in result.station_logs.items()}
    recorded = recorded_sequences(result.master_logs) if result.superframe else set()
    for number, station_log in result.station_logs.items():
        if station_log.journals:
            found += journal_mismatches(station_log, indices[number], result.master_logs)
            found += reading_mismatches(station_log, indices[number])
        if result.superframe:
            found += lost_measurements(
                station_log, indices[number], recorded, result.master_logs[-1].session_number
            )
    found += (Violation("liveness", what) for what in missing_acknowledgements(result, indices))
    found += (Violation("liveness", what) for what in missing_poses(result))
    found += (Violation("status", what) for what in outstanding_failures(result))
    found += (Violation("status", what) for what in report_failures(result))
    for master_log in result.master_logs:
        in_force = result.in_force(master_log)
        lost = lost_lines(master_log)
        found += (Violation("setup", what) for what in parameter_failures(master_log, in_force.parameters))
        found += (Violation("recording", what) for what in recording_failures(master_log))
        found += (Violation("status", what) for what in size_failures(master_log))
        found += (Violation("stream", what) for what in heard_failures(master_log, master_log.heard))
        found += (Violation("setup", what) for what in setup_failures(master_log, in_force))
        found += (Violation("recording", what) for what in beacon_failures(master_log, indices))
        found += (Violation("status", what) for what in status_failures(master_log, indices))
        found += (Violation("lost", what) for what in unpublished_replies(master_log))
        found += (Violation("pose", what) for what in age_failures(master_log, in_force.parameters))
        found += (Violation("pose", what) for what in lateness_failures(master_log, in_force, indices))
        found += (Violation("pose", what) for what in scale_failures(master_log, in_force))
        found += (Violation("pose", what) for what in twist_failures(master_log, in_force))
        found += (Violation("pose", what) for what in rule_failures(master_log, in_force.parameters))
        found += (
            Violation("event", what) for what in event_failures(master_log, superframe=result.superframe)
        )
        found += (Violation("event", what) for what in layout_failures(master_log, result))
        found += duplicate_deliveries(master_log, lost)
        found += timestamp_violations(
            master_log, indices, start_ns=master_log.unix_at_zero_ns, slewed_ns=partial(_slewed_ns, result)
        )
        found += (Violation("pose", what) for what in pose_failures(master_log, in_force, indices))
        if replay:
            found += replay_mismatches(master_log, lost)
    found += (Violation("imu", what) for what in imu_failures(result))
    found += (Violation("imu", what) for what in imu_status_failures(result))
    found += (Violation("odometry", what) for what in odometry_failures(result))
    found += (Violation("liveness", what) for what in liveness_failures(result, indices))
    found += (Violation("memory", what) for what in result.oversized_collections)
    return found


def journal_mismatches(
    station_log: StationLog, journal_index: JournalIndex, master_logs: Sequence[MasterLog]
) -> Iterator[Violation]:
    """Compare readings and deliveries of a station with its journals."""
    for host_time_ns in sorted(
        station_log.true_times_ns.keys() - {m.host_time_ns for m in journal_index.journalled}
    ):
        if station_log.may_be_unwritten(station_log.read_times_ns.get(host_time_ns, 0)):
            continue
        yield Violation(
            "journal",
            f"station {station_log.station}: reading at host time {host_time_ns} ns is not in its journals",
        )
    for master_log in master_logs:
        for measurement in master_log.measurements:
            if measurement.station != station_log.station:
                continue
            journalled = journal_index.find(measurement)
            if journalled is None and _may_be_unwritten(station_log, measurement, master_log.unix_at_zero_ns):
                continue
            if journalled is None or not _same_content(journalled, measurement):
                yield Violation(
                    "journal",
                    f"station {station_log.station}: journalled as {journalled}, delivered as {measurement}",
                )


def _may_be_unwritten(station_log: StationLog, delivered: PolarMeasurement, start_ns: int) -> bool:
    """Whether a delivered measurement may be missing in the journals because its client was killed.

    Over ``superframe`` (no host time) a measurement is delivered only after its write has succeeded or failed.
    """
    return station_log.may_be_unwritten(
        delivered.stamp_ns - start_ns,
        before_ns=_MAX_LATENCY_NS,
        write_errors_only=delivered.host_time_ns is None,
    )


def reading_mismatches(station_log: StationLog, journal_index: JournalIndex) -> Iterator[Violation]:
    """Compare the distances in a station's journals with those that its instrument reported."""
    seen: set[ReportedDistance] = set()
    errors_ns: list[int] = []  # of clients that know how fast the instrument usually responds
    for readings in readings_by_start(journal_index):
        previous: ReportedDistance | None = None
        slowed_by = 1.0  # when the client began to fit the instrument's clock
        for journalled, truth in readings:
            if truth is None:
                yield Violation(
                    "reading",
                    f"station {station_log.station}: journalled, but never reported by the instrument: {journalled}",
                )
                continue
            if truth in seen:
                yield Violation("reading", f"station {station_log.station}: journalled twice: {journalled}")
            seen.add(truth)
            if previous is None or truth.switched_on_since(previous):
                slowed_by = truth.slowed_by
            previous = truth
            stamp_ns = journal_index.true_ns(journalled)
            if stamp_ns is None:
                continue
            error_ns, limit_ns = stamp_ns - truth.true_ns, _timestamp_limit_ns(slowed_by)
            if slowed_by <= 1.0:
                errors_ns.append(error_ns)
            if abs(error_ns) > limit_ns:
                yield Violation(
                    "reading",
                    f"station {station_log.station}: timestamp error {error_ns / 1e6:.1f} ms, "
                    f"limit {limit_ns / 1e6:g} ms: {journalled}",
                )
    if len(errors_ns) >= _MIN_TIMESTAMPS and abs(median_ns := median(errors_ns)) > _MAX_MEDIAN_ERROR_NS:
        yield Violation(
            "reading",
            f"station {station_log.station}: median timestamp error of {len(errors_ns)} measurements "
            f"{median_ns / 1e6:.1f} ms, limit {_MAX_MEDIAN_ERROR_NS / 1e6:g} ms",
        )


def _timestamp_limit_ns(slowed_by: float) -> float:
    """Return the limit for a client that has seen only responses that take this many times longer than usual.

    Nothing tells it that the fastest of them is late, see docs/explanation/instrument-time.md.
    """
    return slowed_by * _MAX_TIMESTAMP_ERROR_NS + (slowed_by - 1.0) * _FASTEST_RESPONSE_NS


def recorded_sequences(master_logs: Sequence[MasterLog]) -> set[tuple[int, int]]:
    """Return station and sequence number of all recorded measurements."""
    return {
        (measurement.station, measurement.sequence)
        for master_log in master_logs
        if (path := master_log.recording()) is not None
        for measurement in load_recording(path).measurements
    }


def lost_measurements(
    station_log: StationLog,
    journal_index: JournalIndex,
    recorded: set[tuple[int, int]],
    session_number: int | None,
) -> Iterator[Violation]:
    """Compare the number of journalled but unrecorded measurements of a station with the length of its queue.

    The master acknowledges what it has recorded, and the station keeps what is not acknowledged. A measurement missing on
    both sides was acknowledged and lost, unless it has no timestamp in the master's session.
    """
    missing = [
        m.sequence
        for m in journal_index.journalled
        if (station_log.station, m.sequence) not in recorded
        and not journal_index.has_no_timestamp(m.sequence, session_number)
    ]
    queued = (station_log.statuses[-1].queued or 0) if station_log.statuses else 0
    if len(missing) > queued:
        yield Violation(
            "lost",
            f"station {station_log.station}: {len(missing)} journalled measurements are in no recording, "
            f"{queued} are in its queue; first sequence number {missing[0]}",
        )


def duplicate_deliveries(master_log: MasterLog, lost: Sequence[range] = ()) -> Iterator[Violation]:
    """Find measurements that were delivered more than once.

    One whose line is among the ``lost`` ones of the recording is not acknowledged, and is delivered again.
    """
    come_again = {
        number
        for number, line in enumerate(master_log.measurement_lines)
        if any(line in each for each in lost)
    }
    seen = set()
    for number, measurement in enumerate(master_log.measurements):
        over_superframe = measurement.host_time_ns is None
        identity = measurement.sequence if over_superframe else (measurement.host_time_ns, measurement.status)
        key = (measurement.station, identity)
        if measurement.stamp_sigma_ns < UNTIMED_SIGMA_NS and key in seen:
            yield Violation("duplicate", f"station {measurement.station}: delivered twice: {measurement}")
        if number not in come_again:
            seen.add(key)


def timestamp_violations(
    master_log: MasterLog,
    indices: Mapping[int, JournalIndex],
    *,
    start_ns: int,
    slewed_ns: Callable[[int, int], float] = lambda _station, _true_ns: 0.0,
) -> Iterator[Violation]:
    """Compare timestamp errors with the stated bounds; ``slewed_ns``: by station and true time, see :func:`_slewed_ns`."""
    for measurement in master_log.measurements:
        if measurement.stamp_sigma_ns >= UNTIMED_SIGMA_NS and not usable(measurement):
            continue  # a failed measurement without a time states none
        index = indices[measurement.station]
        true_ns = index.true_ns(measurement)
        if true_ns is None:
            if _may_be_unwritten(index.station_log, measurement, start_ns):
                continue
            yield Violation(
                "time",
                f"station {measurement.station}: delivered, but never read by the client: {measurement}",
            )
            continue
        error_ns = measurement.stamp_ns - start_ns - true_ns
        bound_ns = measurement.stamp_bound_ns
        if bound_ns is None:
            yield Violation(
                "time", f"station {measurement.station}: delivered without a timestamp bound: {measurement}"
            )
        elif abs(error_ns) > bound_ns + _ROUNDING_NS + slewed_ns(measurement.station, true_ns):
            yield Violation(
                "time",
                f"station {measurement.station} at {(measurement.stamp_ns - start_ns) / 1e9:.3f} s: timestamp error "
                f"{error_ns / 1e3:.0f} us, bound {bound_ns / 1e3:.0f} us",
            )


def _slewed_ns(result: MissionResult, station: int, true_ns: int) -> float:
    """Return by how much NTP has slewed a station's clock around a true time: no bound holds until that shows.

    It shows at the second beacon after the change, or over ``classic`` at the next synchronisation.
    """
    shows_s = _SLEW_SHOWS_S if result.superframe else math.inf
    return sum(
        1e3 * NTP_SLEW_PPM * (slew.to_s - slew.from_s)
        for slew in result.slews
        if slew.station == station and slew.from_s - shows_s <= true_ns / 1e9 <= slew.to_s + shows_s
    )


def replay_mismatches(master_log: MasterLog, lost: Sequence[range] = ()) -> Iterator[Violation]:
    """Compare the stream with a replay of the recording, up to the first of its ``lost`` lines."""
    path = master_log.recording()
    if path is None:
        return  # the check of the recording tells whether it should have one
    count = 0
    expected = master_log.line_hashes[: lost[0].start] if lost else master_log.line_hashes
    try:
        for _, lines in replayed(path):
            for line in lines:
                if lost and count == len(expected):
                    return
                if count == len(expected) or hash(line) != expected[count]:
                    yield Violation(
                        "replay",
                        f"{path.name}: line {count + 1} of the replay differs from the stream: {line[:200]!r}",
                    )
                    return
                count += 1
    except RecordingError as error:
        yield Violation("replay", str(error))
        return
    if count < len(expected) and not master_log.crashed:
        yield Violation("replay", f"{path.name}: the replay has {count} lines, the stream {len(expected)}")


def _same_content(journalled: PolarMeasurement, delivered: PolarMeasurement) -> bool:
    """Whether a measurement was delivered as journalled, up to the rounding of the protocol."""
    # Protocol classic cannot encode LOW_ACCURACY.
    statuses = {
        Status.OK if delivered.host_time_ns and m.status.usable else m.status for m in (journalled, delivered)
    }
    if len(statuses) > 1:
        return False
    angles_rad = [(m.horizontal_angle_rad, m.zenith_angle_rad) for m in (journalled, delivered)]
    distances_m = (journalled.slope_distance_m, delivered.slope_distance_m)
    if delivered.host_time_ns is not None:
        return angles_rad[0] == angles_rad[1] and distances_m[0] == distances_m[1]
    angle_errors_rad = [abs(math.remainder(a - b, math.tau)) for a, b in zip(*angles_rad, strict=True)]
    if journalled.prism != delivered.prism or max(angle_errors_rad) > _ANGLE_ROUNDING_RAD:
        return False
    if distances_m[0] is None or distances_m[1] is None:
        return distances_m[0] is distances_m[1]
    return abs(distances_m[0] - distances_m[1]) <= _DISTANCE_ROUNDING_M
