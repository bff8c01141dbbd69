"""What must hold in every simulated run, whatever goes wrong in it.

Each check goes its own way to what it checks: journals are read from disk, poses fitted again from scratch.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict
from hashlib import blake2b
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.errors import RecordingError
from tsgt.geometry import rotation_from_quaternion
from tsgt.master.intake import UNTIMED_SIGMA_NS
from tsgt.master.replay import replayed
from tsgt.master.tracks import build_tracks, usable
from tsgt.recording.journal import load_journal

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from tsgt.master.tracks import Track
    from tsgt.model import Parameters, PolarMeasurement
    from tsgt.simulation.scenario import Run
    from tsgt.simulation.witness import Session, StationWitness, ValidPoses

# Until the next statement a bound may grow, by no more than two crystals can disagree.
_BOUND_GROWTH = 100e-6
_ROUNDING_NS = 1_000
_RESIDUAL_TOLERANCE_M = 1e-6


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

    What a client has read is in its journal, and as it is there it was delivered; none is delivered twice; none has a time
    stamp off by more than the bound stated; no valid pose rests on an unusable measurement; a replay of the recording
    gives the stream again.
    """
    found: list[Violation] = []
    for witness in run.witnesses.values():
        if witness.journals:
            found += altered(witness, run.sessions)
    for session in run.sessions:
        found += delivered_twice(session)
        found += beyond_bound(session, run.witnesses, start_ns=run.start_ns)
        found += wrong_poses(session, run.parameters)
        found += replayed_otherwise(session)
    return found


def altered(witness: StationWitness, sessions: Sequence[Session]) -> Iterator[Violation]:
    """Compare what was read and what was delivered of one station with its journals."""
    read = set()
    for folder in witness.journals:
        for path in sorted(folder.glob("*.jsonl")):
            read |= {_content(measurement) for measurement in load_journal(path).measurements}
    for host_time_ns in sorted(witness.stamps_ns.keys() - {time_ns for _, time_ns, *_ in read}):
        yield Violation(
            "journal",
            f"not in the journal of station {witness.station}, which has read it at {host_time_ns} ns",
        )
    for session in sessions:
        for measurement in session.measurements:
            if measurement.station == witness.station and _content(measurement) not in read:
                yield Violation(
                    "journal", f"not in the journal of station {witness.station} as delivered: {measurement}"
                )


def delivered_twice(session: Session) -> Iterator[Violation]:
    """Look for measurements that the pipeline was handed more than once."""
    seen = set()
    for measurement in session.measurements:
        key = (measurement.station, measurement.host_time_ns, measurement.status)
        if measurement.stamp_sigma_ns < UNTIMED_SIGMA_NS and key in seen:
            yield Violation("twice", f"delivered again: {measurement}")
        seen.add(key)


def beyond_bound(
    session: Session, witnesses: dict[int, StationWitness], *, start_ns: int
) -> Iterator[Violation]:
    """Compare time stamps with the truth and with the bound that the master stated before and after them."""
    stated = _stated_bounds(session)
    for measurement in session.measurements:
        if measurement.stamp_sigma_ns >= UNTIMED_SIGMA_NS and not usable(measurement):
            continue  # an error without a time of its own claims none
        true_ns = witnesses[measurement.station].stamps_ns.get(measurement.host_time_ns)
        if true_ns is None:
            yield Violation("time", f"nobody has read this measurement: {measurement}")
            continue
        error_ns = measurement.stamp_ns - start_ns - true_ns
        bound_ns = _bound_ns(stated[measurement.station], measurement)
        if bound_ns is None:
            yield Violation("time", f"delivered before any bound was stated: {measurement}")
        elif abs(error_ns) > bound_ns:
            yield Violation(
                "time",
                f"station {measurement.station} at {(measurement.stamp_ns - start_ns) / 1e9:.3f} s: stamp off by "
                f"{error_ns / 1e3:.0f} us, stated were {bound_ns / 1e3:.0f} us",
            )


def wrong_poses(session: Session, parameters: Parameters) -> Iterator[Violation]:
    """Fit the prisms of each valid pose again, from usable measurements alone."""
    poses = session.valid_poses()
    tracks = build_tracks(parameters, [m for m in session.measurements if usable(m)])
    missed = np.flatnonzero(~_explained(poses, slice(None), tracks, parameters))
    for index in missed.tolist():
        # Later measurements may have come between those that the pose was made from: look at the past alone.
        before = session.measurements[: poses.after[index]]
        tracks = build_tracks(parameters, [m for m in before if usable(m)])
        if not _explained(poses, [index], tracks, parameters)[0]:
            yield Violation(
                "pose",
                f"the pose at {poses.stamp_ns[index]} ns is called valid, but no usable measurements explain it",
            )


def replayed_otherwise(session: Session) -> Iterator[Violation]:
    """Compare the lines of the stream with those of a replay of the recording."""
    path = session.recording()
    if path is None:
        if session.measurements or session.poses:
            yield Violation("replay", "there is no recording of what was streamed")
        return
    digest = blake2b()
    try:
        for _, lines in replayed(path):
            for line in lines:
                digest.update(line + b"\n")
    except RecordingError as error:
        yield Violation("replay", str(error))
        return
    if digest.digest() != session.digest.digest():
        yield Violation("replay", f"a replay of {path.name} is not what was streamed")


def _content(measurement: PolarMeasurement) -> tuple[object, ...]:
    """Return what must not change on the way."""
    return (
        measurement.station,
        measurement.host_time_ns,
        measurement.horizontal_angle_rad,
        measurement.zenith_angle_rad,
        measurement.slope_distance_m,
        measurement.status,
    )


def _stated_bounds(session: Session) -> dict[int, list[tuple[int, int]]]:
    """By station: when a bound was stated, and which, both in ns, in the order of time."""
    stated: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for clock in session.clocks:
        stated[clock.station].append((clock.stamp_ns, clock.bound_ns))
    for status in session.statuses:
        for station in status.stations:
            if station.clock_bound_ns is not None:
                stated[station.id].append((status.stamp_ns, station.clock_bound_ns))
    for bounds in stated.values():
        bounds.sort()
    return stated


def _bound_ns(stated: Sequence[tuple[int, int]], measurement: PolarMeasurement) -> float | None:
    """Return the larger of the bounds that were stated around the arrival; None where there was none before it."""
    after = bisect_right(stated, (measurement.received_ns, 2**63))
    if after == 0:
        return None
    around = stated[after - 1 : after + 1]
    apart_ns = max(abs(measurement.stamp_ns - stamp_ns) for stamp_ns, _ in around)
    return max(bound_ns for _, bound_ns in around) + apart_ns * _BOUND_GROWTH + _ROUNDING_NS


def _explained(
    poses: ValidPoses,
    rows: slice | list[int],
    tracks: dict[int, Track],
    parameters: Parameters,
) -> NDArray[np.bool_]:
    """Tell, for the given poses, whether the prisms lie where measurements put them, to the residual stated."""
    stamps = poses.stamp_ns[rows]
    rotation = rotation_from_quaternion(poses.orientation_xyzw[rows])
    explained = np.ones(len(stamps), dtype=np.bool_)
    squares = np.zeros(len(stamps))
    for prism in parameters.prisms:
        track = tracks[prism.prism]
        if len(track) == 0:
            return np.zeros(len(stamps), dtype=np.bool_)
        after = np.searchsorted(track.times_ns, stamps).clip(1, max(1, len(track) - 1))
        before = after - 1
        after = np.minimum(after, len(track) - 1)
        from_ns, to_ns = track.times_ns[before], track.times_ns[after]
        explained &= (from_ns <= stamps) & (stamps <= to_ns)
        explained &= to_ns - from_ns <= parameters.pipeline.outage_limit_ns
        fraction = (stamps - from_ns) / np.maximum(to_ns - from_ns, 1)
        seen = track.points_m[before] + fraction[:, None] * (track.points_m[after] - track.points_m[before])
        placed = poses.position_m[rows] + rotation @ np.array(prism.position_m)
        squares += np.sum((placed - seen) ** 2, axis=1)
    residual_m = np.sqrt(squares / len(parameters.prisms))
    explained &= np.abs(residual_m - poses.residual_m[rows]) <= _RESIDUAL_TOLERANCE_M
    return explained
