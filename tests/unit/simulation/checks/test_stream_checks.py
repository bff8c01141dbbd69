"""Checks of stream, status and recording, on small made-up logs."""

from __future__ import annotations

from array import array
from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from harness.files.records import (
    CLOCK,
    EVENT,
    HEADER,
    PARAMETERS,
    POSE,
    SECOND,
    START,
    STATUS,
    imu_samples,
    measurement,
)

from tsgt.model import Status
from tsgt.radio.classic import OK, MeasurementMessage
from tsgt.recording import RecordingStatus, StationStatus, StatusRecord, encode_line
from tsgt.recording.recorder import MAX_PENDING_LINES
from tsgt.simulation.checks.acknowledgements import missing_acknowledgements
from tsgt.simulation.checks.heard_lines import heard_failures
from tsgt.simulation.checks.outstanding import outstanding_failures
from tsgt.simulation.checks.poll_replies import unpublished_replies
from tsgt.simulation.checks.poses.ages import age_failures
from tsgt.simulation.checks.poses.expected import missing_poses
from tsgt.simulation.checks.recorded_lines import lost_lines, recording_failures, size_failures
from tsgt.simulation.checks.station_events import event_failures
from tsgt.simulation.checks.status_numbers import status_failures
from tsgt.simulation.mission import MasterLog
from tsgt.simulation.mission.observed import PollReply

if TYPE_CHECKING:
    from pathlib import Path

_INDICES: Any = {1: SimpleNamespace(find=lambda m: m)}
"""Journals of a station whose clock is that of the master."""


def _log(folder: Path, *records: object) -> MasterLog:
    log = MasterLog(folder, lambda: 0, START)
    for record in records:
        log.observe(record, encode_line(record))
    return log


@pytest.mark.parametrize(
    ("crashed", "changed", "count"), [(False, b"", 0), (True, b"0.0023", 1), (False, b"0.0023", 1)]
)
def test_recorded_line_that_differs_from_the_stream(
    tmp_path: Path, *, crashed: bool, changed: bytes, count: int
) -> None:
    """In one digit; lines that are not on the stream do not count."""
    log = _log(tmp_path, measurement(0), imu_samples(0), POSE, STATUS)
    log.crashed = crashed
    records = (HEADER, PARAMETERS, measurement(0), imu_samples(0), POSE, STATUS)
    content = b"".join(encode_line(record) + b"\n" for record in records)
    assert b"0.0021" in content
    (tmp_path / "a.jsonl").write_bytes(content.replace(b"0.0021", changed or b"0.0021"))
    assert len(list(recording_failures(log))) == count


@pytest.mark.parametrize("crashed", [False, True])
def test_recording_that_ends_early(tmp_path: Path, *, crashed: bool) -> None:
    """Allowed to a master that was killed, also in the middle of a line."""
    log = _log(tmp_path, measurement(0), POSE)
    log.crashed = crashed
    whole = b"".join(encode_line(record) + b"\n" for record in (HEADER, PARAMETERS, measurement(0), POSE))
    (tmp_path / "a.jsonl").write_bytes(whole[:-9])
    assert bool(list(recording_failures(log))) != crashed


@pytest.mark.parametrize(
    ("stated", "waiting", "count"), [(2, MAX_PENDING_LINES, 0), (1, MAX_PENDING_LINES, 1), (2, 99, 1)]
)
def test_lines_that_are_lost(tmp_path: Path, stated: int, waiting: int, count: int) -> None:
    """Only as many as the status counts, and only of more than a master keeps for a full disk."""
    recording = RecordingStatus(
        file="a.jsonl", bytes=0, last_write_ns=None, waiting_lines=waiting, lost_lines=stated
    )
    status = replace(STATUS, recording=recording)
    log = _log(tmp_path, measurement(0), POSE, EVENT, status)
    records = (HEADER, PARAMETERS, measurement(0), status)
    (tmp_path / "a.jsonl").write_bytes(b"".join(encode_line(record) + b"\n" for record in records))
    assert len(list(recording_failures(log))) == count
    assert lost_lines(log) == [range(1, 3)]


@pytest.mark.parametrize(
    ("change", "count"),
    [
        ({}, 0),
        ({"bytes": 100_000}, 1),
        ({"bytes": 0}, 1),
        ({"bytes": 0, "waiting_lines": 9}, 0),
        ({"file": "b"}, 1),
    ],
)
def test_status_with_a_wrong_size_of_the_recording(
    tmp_path: Path, change: dict[str, Any], count: int
) -> None:
    """The second of two; a pose is written between them."""
    lines = [encode_line(record) + b"\n" for record in (HEADER, PARAMETERS)]
    stated = RecordingStatus(file="a.jsonl", bytes=0, last_write_ns=None, waiting_lines=0, lost_lines=0)
    statuses = []
    for each in ({}, change):
        here = replace(stated, **({"bytes": sum(map(len, lines))} | each))
        statuses.append(replace(STATUS, recording=here))
        lines += [encode_line(statuses[-1]) + b"\n", encode_line(POSE) + b"\n"]
    (tmp_path / "a.jsonl").write_bytes(b"".join(lines))
    assert len(list(size_failures(_log(tmp_path, *statuses)))) == count


@pytest.mark.parametrize(
    ("heard", "count"),
    [
        ([0, 3, 4, 5], 0),
        ([0, 3, 4, 6], 1),
        ([0, 3, 4, 4], 1),
        ([0, 3, 4, 9], 1),
        ([0, 9, 4], 1),
        ([0, 4, 5, 6], 1),
        ([0, 3], 0),
        ([], 0),
    ],
)
def test_lines_that_a_reader_got(tmp_path: Path, heard: list[int], count: int) -> None:
    """Line 0 is a greeting, 3 the set-up, 4 to 6 follow, 9 is unknown."""
    log = _log(tmp_path)
    log.line_hashes, log.setup_hashes = array("q", [3, 4, 5, 6]), {3}
    assert len(list(heard_failures(log, [heard]))) == count


def _status(**changes: Any) -> StatusRecord:
    """Return the status a second after the start, with two measurements, the last of which came half a second before."""
    station = StationStatus(
        id=1,
        measurements=2,
        usable=2,
        age_s=0.6,
        rate_hz=2.0,
        status=Status.OK,
        locked=True,
        last_heard_s=0.5,
    )
    counts = {name: changes.pop(name, 1) for name in ("poses", "valid_poses")}
    return replace(STATUS, stamp_ns=START + SECOND, stations=(replace(station, **changes),), **counts)


@pytest.mark.parametrize(
    ("change", "count"),
    [
        ({}, 0),
        ({"poses": 2}, 0),  # the second is published just before the status
        ({"poses": 3}, 1),
        ({"valid_poses": 2}, 1),
        ({"measurements": 1}, 1),
        ({"usable": 1}, 1),
        ({"age_s": 0.0}, 1),
        ({"age_s": None}, 1),
        ({"rate_hz": 2.5}, 1),
        ({"status": Status.TILT}, 1),
        ({"locked": False}, 1),
        ({"stamp_bound_ns": 7}, 1),
        ({"last_heard_s": 0.1}, 0),
        ({"last_heard_s": 0.6}, 1),
        ({"last_heard_s": None}, 1),
    ],
)
def test_status_with_a_wrong_number(tmp_path: Path, change: dict[str, Any], count: int) -> None:
    """Numbers of poses and measurements, age, rate and words; a smoothed pose is of an epoch that was counted before."""
    smoothed = replace(POSE, kind="smoothed")
    invalid = replace(POSE, valid=False, reason="outage")
    log = _log(tmp_path, measurement(0), POSE, smoothed, measurement(1), invalid, _status(**change))
    assert len(list(status_failures(log, _INDICES))) == count


@pytest.mark.parametrize(("late_ms", "count"), [(48, 0), (0, 0), (20, 1)])
def test_age_of_a_distance_stamped_before_the_angles_that_precede_it(
    tmp_path: Path, late_ms: int, count: int
) -> None:
    """Measurement 1 precedes 0 by 48 ms; then an older one arrives."""
    old, first, second = (
        replace(measurement(number), sequence=sequence, stamp_ns=START + 400_000_000 - late * 1_000_000)
        for number, sequence, late in ((0, 100, 0), (1, 101, 48), (2, 20, 300))
    )
    status = _status(
        measurements=3, usable=3, rate_hz=3.0, age_s=0.6 + late_ms / 1e3, status=Status.OK, last_heard_s=0.0
    )
    found = list(status_failures(_log(tmp_path, old, first, second, POSE, POSE, status), _INDICES))
    assert len(found) == count


@pytest.mark.parametrize(
    ("offset_ns", "bound_ns", "count"),
    [(5_000, 0, 0), (50_000, 0, 1), (-50_000, 0, 1), (-50_000, 45_000, 0), (50_000, None, 0)],
)
def test_clock_offset_beyond_its_bound(
    tmp_path: Path, offset_ns: int, bound_ns: int | None, count: int
) -> None:
    """In each of 30 statuses; the station's clock is that of the master. A stamp without a bound, the arrival of an error, tells no offset."""
    statuses = [
        replace(
            _status(clock_offset_ns=offset_ns, clock_bound_ns=10_000, age_s=0.6 + number, last_heard_s=0.0),
            stamp_ns=START + (number + 1) * SECOND,
        )
        for number in range(30)
    ]
    records: list[object] = []
    for number, status in enumerate(statuses):
        fresh = replace(
            measurement(number),
            stamp_ns=status.stamp_ns - SECOND // 2,
            received_ns=status.stamp_ns,
            stamp_bound_ns=bound_ns,
        )
        records += [fresh, status]
    found = [each for each in status_failures(_log(tmp_path, *records), _INDICES) if "offsets" in each]
    assert len(found) == count


def test_status_that_comes_late(tmp_path: Path) -> None:
    """Two seconds after the one before."""
    first, second = (
        replace(STATUS, stamp_ns=START + at * SECOND, stations=(), poses=0, valid_poses=0) for at in (1, 3)
    )
    assert "2.000 s later" in next(status_failures(_log(tmp_path, first, second), _INDICES))


@pytest.mark.parametrize(("stated", "count"), [(10, 0), (13, 0), (0, 1), (400, 1)])
def test_outstanding_measurements_are_counted(tmp_path: Path, stated: int, count: int) -> None:
    """Ten have been read and not delivered, in each of 30 statuses."""
    statuses = [
        replace(_status(outstanding=stated, joined=True), stamp_ns=START + number * SECOND)
        for number in range(1, 31)
    ]
    log = _log(tmp_path, *map(measurement, range(5)), *statuses)
    log.arrived_ns = [0] * 5
    station_log = SimpleNamespace(read_times_ns=dict.fromkeys(range(15), 0) | {15: 10**12})
    result: Any = SimpleNamespace(
        faults_end_s=None, moves=(), superframe=True, master_logs=[log], station_logs={1: station_log}
    )
    assert len(list(outstanding_failures(result))) == count


@pytest.mark.parametrize(
    ("statuses", "events", "count"),
    [
        ((Status.OK, Status.LOW_ACCURACY), 0, 0),
        ((Status.OK, Status.TILT), 1, 0),
        ((Status.OK, Status.TILT), 0, 1),
        ((Status.OK, Status.TILT, Status.TILT, Status.OK), 2, 0),
        ((Status.OK, Status.OK), 1, 1),
        ((Status.OK, Status.ANGLE_ONLY, Status.OK), 0, 0),
        ((Status.OK, *[Status.ANGLE_ONLY] * 6, Status.OK), 2, 0),
        ((Status.OK, *[Status.ANGLE_ONLY] * 6, Status.OK), 0, 1),
    ],
)
def test_events_of_an_instruments_status(
    tmp_path: Path, statuses: tuple[Status, ...], events: int, count: int
) -> None:
    """One for each change."""
    log = _log(
        tmp_path,
        *(replace(measurement(number), status=status) for number, status in enumerate(statuses)),
        *(replace(EVENT, event="instrument_status", station=1) for _ in range(events)),
    )
    assert len(list(event_failures(log, superframe=True))) == count


@pytest.mark.parametrize(
    ("heard_s", "events", "count"),
    [
        (0.1, (), 0),
        (21.0, (), 1),
        (21.0, ("station_lost",), 0),
        (0.1, ("station_lost",), 1),
        (0.1, ("station_lost", "station_recovered"), 0),
    ],
)
def test_events_of_lost_stations(tmp_path: Path, heard_s: float, events: tuple[str, ...], count: int) -> None:
    """Lost and recovered, by when the station was heard."""
    log = _log(
        tmp_path,
        *(replace(EVENT, event=event, station=1, stamp_ns=START) for event in events),
        _status(last_heard_s=heard_s),
    )
    assert len(list(event_failures(log, superframe=True))) == count


@pytest.mark.parametrize(
    ("percent", "events", "count"),
    [
        (None, (), 0),
        (20, (), 0),
        (19, (), 1),
        (19, ("battery_low",), 0),
        (29, ("battery_low",), 0),
        (30, ("battery_low",), 1),
        (30, ("battery_low", "battery_recovered"), 0),
    ],
)
def test_events_of_a_low_battery(
    tmp_path: Path, percent: int | None, events: tuple[str, ...], count: int
) -> None:
    """Low below 20 %, and no longer from 30 % on."""
    log = _log(
        tmp_path,
        *(replace(EVENT, event=event, station=1, stamp_ns=START) for event in events),
        _status(battery_percent=percent),
    )
    assert len(list(event_failures(log, superframe=True))) == count


@pytest.mark.parametrize(("age_s", "count"), [(0.05, 0), (0.0, 1), (0.45, 1), (None, 1)])
def test_pose_with_a_wrong_age(tmp_path: Path, age_s: float | None, count: int) -> None:
    """The last measurement is 0.05 s before the pose."""
    shares = (replace(POSE.stations[0], age_s=age_s),)
    pose = replace(POSE, stamp_ns=START + 450_000_000, stations=shares)
    log = _log(tmp_path, measurement(0), measurement(1), pose)
    assert len(list(age_failures(log, PARAMETERS))) == count


def test_measurement_of_a_backlog_may_be_unused(tmp_path: Path) -> None:
    """It has arrived 1.5 s late: the pose may, but need not, state its age."""
    late = replace(measurement(1), received_ns=measurement(1).stamp_ns + 1_500_000_000)
    for age_s in (0.45, 0.05):
        shares = (replace(POSE.stations[0], age_s=age_s),)
        pose = replace(POSE, stamp_ns=START + 450_000_000, stations=shares)
        assert not list(age_failures(_log(tmp_path, measurement(0), late, pose), PARAMETERS))


def _reply(sequence: int) -> PollReply:
    found = measurement(sequence)
    assert found.slope_distance_m is not None
    assert found.host_time_ns is not None
    message = MeasurementMessage(
        station=1,
        status=OK,
        zenith_angle_rad=found.zenith_angle_rad,
        horizontal_angle_rad=found.horizontal_angle_rad,
        slope_distance_m=found.slope_distance_m,
        time_ns=found.host_time_ns,
    )
    return PollReply(1, message.to_bytes(), found.received_ns - START)


@pytest.mark.parametrize(
    ("published", "synchronised", "count"),
    [((0, 1, 2), False, 0), ((0, 2), False, 1), ((0, 2), True, 0), ((0,), False, 0), ((2,), False, 0)],
)
def test_polled_measurement_that_was_not_published(
    tmp_path: Path, *, published: tuple[int, ...], synchronised: bool, count: int
) -> None:
    """Only between two that were published, without a synchronisation between, which might have dropped it."""
    log = _log(tmp_path, *(measurement(sequence) for sequence in published))
    log.arrived_ns = [m.received_ns - START for m in log.measurements]
    if synchronised:
        log.clocks = [replace(CLOCK, station=1, stamp_ns=measurement(1).received_ns)]
    log.poll_replies = [_reply(sequence) for sequence in (0, 1, 1, 2)]
    assert len(list(unpublished_replies(log))) == count * 2  # it was polled twice


@pytest.mark.parametrize(("valid", "count"), [(100, 0), (60, 1), (0, 1)])
def test_poses_that_the_measurements_allow(tmp_path: Path, valid: int, count: int) -> None:
    """Twelve seconds of all three prisms, of which five are a start; 7 s at 20 Hz are 140 poses."""
    measured = [
        replace(measurement(sequence), station=number, prism=number)
        for sequence in range(31)
        for number in (1, 2, 3)
    ]
    poses = [replace(POSE, valid=number < valid, reason="") for number in range(140)]
    log = _log(tmp_path, *measured, *poses)
    result: Any = SimpleNamespace(parameters=PARAMETERS, faults_end_s=None, moves=(), master_logs=[log])
    result.in_force = lambda _log: result
    assert len(list(missing_poses(result))) == count
    result.faults_end_s = 180.0
    assert not list(missing_poses(result))


def test_no_poses_are_expected_of_a_backlog(tmp_path: Path) -> None:
    """Each measurement has arrived after three seconds."""
    measured = [
        replace(found, station=number, prism=number, received_ns=found.stamp_ns + 3 * SECOND)
        for found in map(measurement, range(31))
        for number in (1, 2, 3)
    ]
    log = _log(tmp_path, *measured, replace(POSE, valid=False, reason="outage"))
    result: Any = SimpleNamespace(parameters=PARAMETERS, faults_end_s=None, moves=(), master_logs=[log])
    result.in_force = lambda _log: result
    assert not list(missing_poses(result))


@pytest.mark.parametrize(("older_arrived_s", "count"), [(30, 1), (50, 0)])
def test_acknowledgement_that_waits_for_an_older_measurement(
    tmp_path: Path, older_arrived_s: int, count: int
) -> None:
    """A beacon with the acknowledgement may be lost; the cumulative one comes when all before are delivered."""
    log = _log(tmp_path, measurement(1), measurement(0))
    log.arrived_ns = [0, older_arrived_s * SECOND]
    result: Any = SimpleNamespace(superframe=True, master_logs=[log], duration_s=60.0)
    index: Any = SimpleNamespace(oldest_queued=lambda: 1)
    assert len(list(missing_acknowledgements(result, {1: index}))) == count


@pytest.mark.parametrize(("oldest", "count"), [(0, 1), (1, 0), (None, 0)])
def test_acknowledgement_that_was_not_journalled(tmp_path: Path, oldest: int | None, count: int) -> None:
    """The first measurement arrived at the start; a minute later it is still the oldest in the queue."""
    log = _log(tmp_path, measurement(0))
    log.arrived_ns = [0]
    result: Any = SimpleNamespace(superframe=True, master_logs=[log], duration_s=60.0)
    index: Any = SimpleNamespace(oldest_queued=lambda: oldest)
    assert len(list(missing_acknowledgements(result, {1: index}))) == count


def test_stations_that_classic_does_not_poll_while_it_synchronises_are_not_lost(tmp_path: Path) -> None:
    """Three stations take almost a minute."""
    log = _log(tmp_path, _status(last_heard_s=45.0))
    assert not list(event_failures(log, superframe=False))
