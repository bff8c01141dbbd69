"""What must hold in every simulated run, whatever goes wrong in it.

Each check goes its own way to what it checks: journals are read from disk, poses fitted again from scratch.
"""

from __future__ import annotations

import math
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tsgt.errors import RecordingError
from tsgt.geometry import log_so3, rotation_from_quaternion
from tsgt.master.intake import UNTIMED_SIGMA_NS
from tsgt.master.replay import replayed
from tsgt.master.tracks import build_tracks, usable
from tsgt.model import Status
from tsgt.recording import load_recording
from tsgt.simulation.liveness import stuck
from tsgt.simulation.witness import Measured

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from tsgt.master.tracks import Track
    from tsgt.model import Parameters, PolarMeasurement
    from tsgt.simulation.geocom_answers import Offered
    from tsgt.simulation.scenario import Run
    from tsgt.simulation.witness import Session, StationWitness, ValidPoses

_ROUNDING_NS = 1_000
# Half of a unit on the air, and what is lost in the sums on either side.
_ANGLE_ROUNDING_RAD = math.tau / 2**25 * 1.001
_DISTANCE_ROUNDING_M = 0.0501e-3
# More than any station's latency, which is taken off the stamps.
_LATENCY_NS = 5_000_000_000
_RESIDUAL_TOLERANCE_M = 1e-6
# Squared error of a pose in its sigmas, six degrees of freedom. A robot that does what its motion prior thinks unlikely is
# now and then off by more than honest sigmas would allow in a lifetime: in them, 60 has a chance of 5e-11.
_MOST_NEES = 60.0
# In m and rad. Times of an instrument's first seconds, and those of the authors' nodes, are off by milliseconds that no
# sigma states; of a moving robot that is millimetres.
_STATE_TOLERANCE = 0.02
# Ten digits behind the point are on the line.
_LINE_ROUNDING = 1e-9
# A stamp is less than this before or after the measurement: the slowest answer against the fastest, when few have come.
_STAMP_LIMIT_NS = 40_000_000
# Of so many stamps of a station half are less than this off, on either side: a whole run's are within 1 ms.
_FEWEST_STAMPS = 40
_MIDDLE_STAMP_NS = 5_000_000
# Of so many poses (half a minute) half have a squared error below this. What is honest has half of them below 5.3.
_FEWEST_POSES = 600
_MIDDLE_NEES = 12.0
# In m and rad: what they are off by in the middle of all, in each direction. Noise leaves a tenth of that.
_MIDDLE_ERROR = 0.005


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
        found += wrong_poses(session, run.parameters)
        found += wrong_states(session, run)
        found += too_sure(session, run)
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


def wrong_poses(session: Session, parameters: Parameters) -> Iterator[Violation]:
    """Fit the prisms of each valid pose of the estimator ``linear`` again, from usable measurements alone."""
    poses = session.valid_poses()
    poses = poses.select(poses.kind == "interpolated")
    tracks = build_tracks(parameters, [m for m in session.measurements if usable(m)])
    missed = np.flatnonzero(~_explained(poses, slice(None), tracks, parameters))
    stamps_ns = np.array([m.stamp_ns for m in session.measurements], dtype=np.int64)
    around_ns = parameters.pipeline.outage_limit_ns + _LATENCY_NS
    for index in missed.tolist():
        # Later measurements may have come between those that the pose was made from: look at the past alone.
        before = stamps_ns[: poses.after[index]]
        near = np.flatnonzero(np.abs(before - poses.stamp_ns[index]) <= around_ns).tolist()
        tracks = build_tracks(parameters, [m for i in near if usable(m := session.measurements[i])])
        if not _explained(poses, [index], tracks, parameters)[0]:
            yield Violation(
                "pose",
                f"the pose at {poses.stamp_ns[index]} ns is called valid, but no usable measurements explain it",
            )


def wrong_states(session: Session, run: Run) -> Iterator[Violation]:
    """Compare each valid pose of the estimator ``continuous`` with the truth and with the uncertainty that it states."""
    poses = session.valid_poses()
    poses = poses.select(poses.kind != "interpolated")
    errors, nees = _errors(poses, session, run)
    off = np.linalg.norm(errors.reshape(-1, 2, 3), axis=2)
    for index in np.flatnonzero((nees > _MOST_NEES) & (off.max(axis=1) > _STATE_TOLERANCE)).tolist():
        yield Violation(
            "pose",
            f"the {poses.kind[index]} pose at {poses.stamp_ns[index]} ns is called valid and off by "
            f"{off[index, 0]:.4f} m and {off[index, 1]:.4f} rad; its squared error in sigmas is {nees[index]:.0f}",
        )


def too_sure(session: Session, run: Run) -> Iterator[Violation]:
    """Compare all valid poses of a kind with the truth, and how far they are off with what they state.

    A single pose has to be far off before chance is no excuse; half of them need not be. In the middle of half a minute
    noise has no direction, as the robot turns this way and that: what is left is a wrong set-up.
    """
    every = session.valid_poses()
    for kind in ("interpolated", "predicted", "smoothed"):
        poses = every.select(every.kind == kind)
        if len(poses.stamp_ns) < _FEWEST_POSES:
            continue
        errors, nees = _errors(poses, session, run)
        beside_m, beside_rad = np.linalg.norm(np.median(errors, axis=0).reshape(2, 3), axis=1)
        if beside_m > _MIDDLE_ERROR or beside_rad > _MIDDLE_ERROR:
            yield Violation(
                "pose",
                f"the {len(nees)} {kind} poses are {beside_m:.4f} m and {beside_rad:.4f} rad beside the truth in the middle",
            )
        if np.median(nees) > _MIDDLE_NEES:
            yield Violation(
                "pose",
                f"half of {len(nees)} {kind} poses have a squared error in sigmas above {np.median(nees):.1f}: they "
                "are not where they should be, or state too little uncertainty",
            )


def _errors(poses: ValidPoses, session: Session, run: Run) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(N, 6) errors in place and rotation in m and rad, and (N,) their squares in the sigmas that the poses state."""
    truth = run.world.pose_at((poses.stamp_ns - session.zero_ns) / 1e9)
    turned = rotation_from_quaternion(poses.orientation_xyzw) @ np.swapaxes(truth[:, :3, :3], 1, 2)
    errors = np.concatenate([poses.position_m - truth[:, :3, 3], log_so3(turned)], axis=1)
    return errors, np.einsum("ni,ni->n", errors, np.linalg.solve(poses.covariance, errors[..., None])[..., 0])


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
