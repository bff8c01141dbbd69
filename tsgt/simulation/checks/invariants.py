"""What must hold in every simulated run, whatever goes wrong in it.

Each check goes its own way to what it checks: journals are read from disk, poses fitted again from scratch.
"""

from __future__ import annotations

import math
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

from tsgt.errors import RecordingError
from tsgt.estimation import usable
from tsgt.master import replayed
from tsgt.master.classic import UNTIMED_SIGMA_NS
from tsgt.model import Status
from tsgt.recording import load_recording
from tsgt.simulation.checks.liveness import stuck
from tsgt.simulation.checks.pose_consistency import doubtful_poses
from tsgt.simulation.mission import Measured

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from tsgt.model import PolarMeasurement
    from tsgt.simulation.instrument.geocom import Offered
    from tsgt.simulation.mission import Run, Session, StationWitness

_ROUNDING_NS = 1_000
# Half of a unit on the air, and what is lost in the sums on either side.
_ANGLE_ROUNDING_RAD = math.tau / 2**25 * 1.001
_DISTANCE_ROUNDING_M = 0.0501e-3
# More than any station's latency, which is taken off the stamps.
_LATENCY_NS = 5_000_000_000
# Ten digits behind the point are on the line.
_LINE_ROUNDING = 1e-9
# A stamp is less than this before or after the measurement: the slowest answer against the fastest, when few have come.
_STAMP_LIMIT_NS = 40_000_000
# Of so many stamps of a station half are less than this off, on either side: a whole run's are within 1 ms.
_FEWEST_STAMPS = 40
_MIDDLE_STAMP_NS = 5_000_000


class Violation(NamedTuple):
    """Something that must not happen has happened.

    Attributes
    ----------
    check
        Name of the check.
    detail
        What was found, one line.
    """

    check: str
    detail: str


def violations(run: Run) -> list[Violation]:
    """Check a run.

    What a client has read is in its journal, once, as its instrument gave it and with the time at which it was measured;
    and as it is there it was delivered; none is delivered twice; over the
    protocol ``superframe`` all that was not delivered still waits; none has a time stamp off by more than its bound; no
    valid pose rests on an unusable measurement; poses are where the robot was, as well as they say; a replay of the
    recording gives the stream again.
    """
    found: list[Violation] = []
    measured = {number: Measured(witness) for number, witness in run.witnesses.items()}
    recorded = recorded_numbers(run.sessions) if run.superframe else set()
    for number, witness in run.witnesses.items():
        if witness.journals:
            found += altered(witness, measured[number], run.sessions)
            found += misread(witness, measured[number])
        if run.superframe:
            found += lost(witness, measured[number], recorded, run.sessions[-1].number)
    for session in run.sessions:
        found += delivered_twice(session)
        found += beyond_bound(session, measured, start_ns=session.zero_ns)
        found += (Violation("pose", what) for what in doubtful_poses(session, run))
        found += replayed_otherwise(session)
    found += (Violation("stuck", what) for what in stuck(run, measured))
    found += (Violation("memory", what) for what in run.overgrown)
    return found


def altered(witness: StationWitness, measured: Measured, sessions: Sequence[Session]) -> Iterator[Violation]:
    """Compare what was read and what was delivered of one station with its journals."""
    for host_time_ns in sorted(witness.stamps_ns.keys() - {m.host_time_ns for m in measured.journalled}):
        if witness.may_be_unwritten(witness.read_ns.get(host_time_ns, 0)):
            continue
        yield Violation(
            "journal",
            f"not in the journal of station {witness.station}, which has read it at {host_time_ns} ns",
        )
    for session in sessions:
        for measurement in session.measurements:
            if measurement.station != witness.station:
                continue
            journalled = measured.in_journal(measurement)
            if journalled is None and _may_be_lost(witness, measurement, session.zero_ns):
                continue
            if journalled is None or not _same_content(journalled, measurement):
                yield Violation(
                    "journal", f"not in the journal of station {witness.station} as delivered: {measurement}"
                )


def _may_be_lost(witness: StationWitness, delivered: PolarMeasurement, start_ns: int) -> bool:
    """Whether what was delivered need not be in a journal, because its client was killed soon after.

    Over ``superframe``, which has no host times, a measurement waits for the disk to take or to refuse it.
    """
    return witness.may_be_unwritten(
        delivered.stamp_ns - start_ns, before_ns=_LATENCY_NS, refused=delivered.host_time_ns is None
    )


def misread(witness: StationWitness, measured: Measured) -> Iterator[Violation]:
    """Compare the distances in a station's journals with those that its instrument has answered with."""
    seen: set[Offered] = set()
    off_ns: list[int] = []
    offered: dict[int, list[Offered]] = {}
    for each in witness.offered:
        offered.setdefault(each.instrument_ms, []).append(each)
    for journalled in measured.journalled:
        if journalled.slope_distance_m is None or journalled.instrument_time_ns is None:
            continue
        candidates = offered.get(journalled.instrument_time_ns // 1_000_000, [])
        truth = next((each for each in candidates if _same_values(each, journalled)), None)
        if truth is None:
            yield Violation("read", f"the instrument has never given this: {journalled}")
            continue
        if truth in seen:
            yield Violation("read", f"in the journals of station {witness.station} twice: {journalled}")
        seen.add(truth)
        stamp_ns = measured.true_ns(journalled)
        if stamp_ns is None:
            continue
        off_ns.append(stamp_ns - truth.true_ns)
        if abs(off_ns[-1]) > _STAMP_LIMIT_NS:
            yield Violation(
                "read",
                f"station {witness.station} has stamped a measurement {off_ns[-1] / 1e6:.1f} ms after "
                f"it was made: {journalled}",
            )
    if len(off_ns) >= _FEWEST_STAMPS and abs(middle_ns := median(off_ns)) > _MIDDLE_STAMP_NS:
        yield Violation(
            "read",
            f"station {witness.station} stamps its measurements {middle_ns / 1e6:.1f} ms after they were made, "
            f"half of {len(off_ns)} by more than that",
        )


def _same_values(offered: Offered, journalled: PolarMeasurement) -> bool:
    pairs = (
        (offered.horizontal_angle_rad, journalled.horizontal_angle_rad),
        (offered.zenith_angle_rad, journalled.zenith_angle_rad),
        (offered.distance_m, journalled.slope_distance_m),
    )
    return all(value is not None and abs(given - value) < _LINE_ROUNDING for given, value in pairs)


def recorded_numbers(sessions: Sequence[Session]) -> set[tuple[int, int]]:
    """Return station and sequence number of all that is in the recordings."""
    return {
        (measurement.station, measurement.sequence)
        for session in sessions
        if (path := session.recording()) is not None and _begun(path)
        for measurement in load_recording(path).measurements
    }


def lost(
    witness: StationWitness, measured: Measured, recorded: set[tuple[int, int]], session: int | None
) -> Iterator[Violation]:
    """Count what is in a station's journals and in no recording: so many must still wait in its queue.

    A master acknowledges what it has recorded, and a station keeps what is not acknowledged; so a measurement that is
    missing on both sides was acknowledged and lost; but for one of which nobody can tell the time any more.
    """
    missing = [
        m.sequence
        for m in measured.journalled
        if (witness.station, m.sequence) not in recorded and not measured.timeless(m.sequence, session)
    ]
    queued = (witness.statuses[-1].queued or 0) if witness.statuses else 0
    if len(missing) > queued:
        yield Violation(
            "lost",
            f"station {witness.station} has journalled {len(missing)} measurements that no recording has, but only "
            f"{queued} wait in its queue; the first is number {missing[0]}",
        )


def delivered_twice(session: Session) -> Iterator[Violation]:
    """Look for measurements that the pipeline was handed more than once."""
    seen = set()
    for measurement in session.measurements:
        over_superframe = measurement.host_time_ns is None
        identity = measurement.sequence if over_superframe else (measurement.host_time_ns, measurement.status)
        key = (measurement.station, identity)
        if measurement.stamp_sigma_ns < UNTIMED_SIGMA_NS and key in seen:
            yield Violation("twice", f"delivered again: {measurement}")
        seen.add(key)


def beyond_bound(session: Session, measured: Mapping[int, Measured], *, start_ns: int) -> Iterator[Violation]:
    """Compare time stamps with the truth and with the bound that each of them states."""
    for measurement in session.measurements:
        if measurement.stamp_sigma_ns >= UNTIMED_SIGMA_NS and not usable(measurement):
            continue  # an error without a time of its own claims none
        true_ns = measured[measurement.station].true_ns(measurement)
        if true_ns is None:
            if _may_be_lost(measured[measurement.station].witness, measurement, start_ns):
                continue
            yield Violation("time", f"nobody has read this measurement: {measurement}")
            continue
        error_ns = measurement.stamp_ns - start_ns - true_ns
        bound_ns = measurement.stamp_bound_ns
        if bound_ns is None:
            yield Violation("time", f"delivered without a bound of its time: {measurement}")
        elif abs(error_ns) > bound_ns + _ROUNDING_NS:
            yield Violation(
                "time",
                f"station {measurement.station} at {(measurement.stamp_ns - start_ns) / 1e9:.3f} s: stamp off by "
                f"{error_ns / 1e3:.0f} us, stated were {bound_ns / 1e3:.0f} us",
            )


def replayed_otherwise(session: Session) -> Iterator[Violation]:
    """Compare the lines of the stream with those of a replay of the recording."""
    path = session.recording()
    if path is None:
        if session.measurements or session.poses:
            yield Violation("replay", "there is no recording of what was streamed")
        return
    if session.crashed and not _begun(path):
        return  # it was killed before its disk took the first line
    count = 0
    try:
        for _, lines in replayed(path):
            for line in lines:
                if count == len(session.lines) or hash(line) != session.lines[count]:
                    yield Violation(
                        "replay",
                        f"line {count + 1} of a replay of {path.name} is not what was streamed: {line[:200]!r}",
                    )
                    return
                count += 1
    except RecordingError as error:
        yield Violation("replay", str(error))
        return
    if count < len(session.lines) and not session.crashed:
        yield Violation(
            "replay",
            f"a replay of {path.name} has {count} of the {len(session.lines)} lines that were streamed",
        )


def _begun(path: Path) -> bool:
    """Whether a file has a whole line."""
    with path.open("rb") as file:
        return file.readline().endswith(b"\n")


def _same_content(journalled: PolarMeasurement, delivered: PolarMeasurement) -> bool:
    """Whether a measurement has come as it stands in the journal, but for what the protocol rounds."""
    # The protocol classic has no word for a low accuracy.
    statuses = {
        Status.OK if delivered.host_time_ns and m.status.usable else m.status for m in (journalled, delivered)
    }
    if len(statuses) > 1:
        return False
    angles_rad = [(m.horizontal_angle_rad, m.zenith_angle_rad) for m in (journalled, delivered)]
    distances_m = (journalled.slope_distance_m, delivered.slope_distance_m)
    if delivered.host_time_ns is not None:
        return angles_rad[0] == angles_rad[1] and distances_m[0] == distances_m[1]
    turned_rad = [abs(math.remainder(a - b, math.tau)) for a, b in zip(*angles_rad, strict=True)]
    if journalled.prism != delivered.prism or max(turned_rad) > _ANGLE_ROUNDING_RAD:
        return False
    if distances_m[0] is None or distances_m[1] is None:
        return distances_m[0] is distances_m[1]
    return abs(distances_m[0] - distances_m[1]) <= _DISTANCE_ROUNDING_M
