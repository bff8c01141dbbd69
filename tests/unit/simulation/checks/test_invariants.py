"""Invariant checks: none is violated by a good mission, and each detects its defect."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
from array import array
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.missions.missions import QUICK, SUPERFRAME, run_mission

from tsgt.config import ScenarioConfig
from tsgt.model import Status
from tsgt.recording import EventRecord, encode_line
from tsgt.recording.journal import AcknowledgedRecord
from tsgt.simulation.checks import check_invariants
from tsgt.simulation.checks.acknowledgements import missing_acknowledgements
from tsgt.simulation.checks.invariants import reading_mismatches
from tsgt.simulation.checks.poses import consistency
from tsgt.simulation.mission import JournalIndex
from tsgt.simulation.mission.disk import UNWRITTEN_WINDOW_NS

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tsgt.simulation.mission import MissionResult, StationLog


pytestmark = pytest.mark.slow  # whole missions


@pytest.fixture(scope="module", params=["classic", "superframe"])
def good(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> MissionResult:
    """Half a minute without faults, with each protocol and each estimator."""
    folder = tmp_path_factory.mktemp("run")
    if request.param == "superframe":
        return run_mission(folder, protocol=SUPERFRAME)
    plain = ScenarioConfig()
    linear = plain.pipeline.model_copy(update={"estimator": "linear"})
    return run_mission(folder, plain.model_copy(update={"pipeline": linear}), protocol=QUICK)


@pytest.fixture
def result(good: MissionResult) -> MissionResult:
    """Return a copy whose records may be changed."""
    (session,) = good.master_logs
    modified = copy.copy(session)
    modified.measurements = list(session.measurements)
    modified.line_hashes = session.line_hashes[:]
    modified._pose_numbers = copy.copy(session._pose_numbers)
    return dataclasses.replace(good, master_logs=[modified])


def _checks(result: MissionResult) -> set[str]:
    return {violation.check for violation in check_invariants(result)}


def test_good_mission_has_no_violations(good: MissionResult) -> None:
    """The mission has enough data to check."""
    assert check_invariants(good) == []
    (session,) = good.master_logs
    assert len(session.measurements) > 60
    assert len(session.valid_poses().stamp_ns) > 300


@pytest.mark.parametrize(
    "change",
    [
        {"horizontal_angle_rad": 1.0},
        {"zenith_angle_rad": 1.0},
        {"slope_distance_m": 60.0},
        {"status": Status.TILT},
    ],
    ids=str,
)
def test_altered_measurement_is_detected(result: MissionResult, change: dict[str, Any]) -> None:
    """A delivered measurement whose content differs from the journal."""
    measurements = result.master_logs[0].measurements
    measurements[40] = dataclasses.replace(measurements[40], **change)
    assert "journal" in _checks(result)


@pytest.mark.parametrize("units", [0.49, 0.51])
@pytest.mark.parametrize("key", ["horizontal_angle_rad", "zenith_angle_rad", "slope_distance_m"])
def test_rounding_by_the_radio_is_accepted(result: MissionResult, key: str, units: float) -> None:
    """Half a unit of an angle or a distance over ``superframe``; ``classic`` rounds nothing."""
    measurements = result.master_logs[0].measurements
    journalled = JournalIndex(result.station_logs[measurements[40].station]).find(measurements[40])
    assert journalled is not None
    unit = 1e-4 if key == "slope_distance_m" else math.tau / 2**24
    rounded = getattr(journalled, key) + units * unit
    measurements[40] = dataclasses.replace(measurements[40], **{key: rounded})
    assert ("journal" in _checks(result)) == (units > 0.5 or not result.superframe)


def test_unknown_measurement_is_detected(result: MissionResult) -> None:
    """A host time or sequence number that no client has violates two invariants."""
    measurements = result.master_logs[0].measurements
    host_time_ns = measurements[40].host_time_ns
    if host_time_ns is None:
        measurements[40] = dataclasses.replace(measurements[40], sequence=99_999)
    else:
        measurements[40] = dataclasses.replace(measurements[40], host_time_ns=host_time_ns + 1)
    assert {"journal", "time"} <= _checks(result)


def test_unjournalled_reading_is_detected(result: MissionResult) -> None:
    """Although it was not delivered either."""
    station_log = dataclasses.replace(
        result.station_logs[1], true_times_ns=result.station_logs[1].true_times_ns | {12_345: 0}
    )
    result = dataclasses.replace(result, station_logs=result.station_logs | {1: station_log})
    assert _checks(result) == {"journal"}


def test_unreported_distance_is_detected(result: MissionResult) -> None:
    """A journalled distance that differs from all reported ones by 0.01 mm."""
    station_log = result.station_logs[1]
    reported_distances = list(station_log.reported_distances)
    reported_distances[20] = reported_distances[20]._replace(
        distance_m=reported_distances[20].distance_m + 1e-5
    )
    station_log = dataclasses.replace(station_log, reported_distances=reported_distances)
    (found,) = check_invariants(
        dataclasses.replace(result, station_logs=result.station_logs | {1: station_log})
    )
    assert found.check == "reading"
    assert "never reported" in found.detail


def test_duplicate_journal_entry_is_detected(result: MissionResult, tmp_path: Path) -> None:
    """The same response under two sequence numbers."""
    station_log = result.station_logs[1]
    (path,) = station_log.journals
    *_, line = [line for line in path.read_bytes().splitlines() if b'"type":"measurement"' in line]
    again = json.loads(line)
    again["sequence"] += 1
    (tmp_path / path.name).write_bytes(path.read_bytes() + json.dumps(again).encode() + b"\n")
    station_log = dataclasses.replace(station_log, folder=tmp_path)
    (found,) = reading_mismatches(station_log, JournalIndex(station_log))
    assert found.check == "reading"
    assert "twice" in found.detail


@pytest.mark.parametrize("off_ms", [-41, -39, 39, 41])
def test_timestamp_error_of_a_reading_is_detected(result: MissionResult, off_ms: int) -> None:
    """The limit is 40 ms in either direction."""
    station_log = result.station_logs[1]
    journalled = JournalIndex(station_log).journalled[20]
    assert journalled.instrument_time_ns is not None
    instrument_ms = journalled.instrument_time_ns // 1_000_000
    (truth,) = [each for each in station_log.reported_distances if each.instrument_ms == instrument_ms]
    assert journalled.host_time_ns is not None
    stamps_ns = station_log.true_times_ns | {journalled.host_time_ns: truth.true_ns + off_ms * 1_000_000}
    station_log = dataclasses.replace(station_log, true_times_ns=stamps_ns)
    assert [found.check for found in reading_mismatches(station_log, JournalIndex(station_log))] == [
        "reading"
    ] * (abs(off_ms) > 40)


def test_systematic_timestamp_error_is_detected(result: MissionResult) -> None:
    """An uncorrected latency is below the limit of a single timestamp, but not below that of the median."""
    station_log = result.station_logs[1]
    for late_ns, found in ((0, []), (20_000_000, ["reading"])):
        stamps_ns = {host_ns: true_ns + late_ns for host_ns, true_ns in station_log.true_times_ns.items()}
        late = dataclasses.replace(station_log, true_times_ns=stamps_ns)
        assert [violation.check for violation in reading_mismatches(late, JournalIndex(late))] == found


def _append(line: bytes, lines: list[bytes]) -> None:
    lines.append(line)


def _with_modified_journal(
    station_log: StationLog, folder: Path, modify: Callable[[list[bytes]], None]
) -> StationLog:
    """Return a station log with a modified copy of its only journal."""
    (path,) = station_log.journals
    lines = path.read_bytes().splitlines(keepends=True)
    modify(lines)
    (folder / path.name).write_bytes(b"".join(lines))
    return dataclasses.replace(station_log, folder=folder)


@pytest.mark.parametrize("full", [False, True])
def test_unjournalled_delivery_is_detected(result: MissionResult, tmp_path: Path, *, full: bool) -> None:
    """Over ``superframe`` a kill is no excuse, only a write error, because delivery waits for the write."""
    station_log = result.station_logs[1]
    delivered = [m for m in result.master_logs[0].measurements if m.station == 1][20]
    journalled = JournalIndex(station_log).find(delivered)
    assert journalled is not None
    host_time_ns = journalled.host_time_ns
    assert host_time_ns is not None
    read_times_ns = station_log.read_times_ns[host_time_ns]
    since_ns = read_times_ns - 1 if full else read_times_ns + 50_000_000 - UNWRITTEN_WINDOW_NS

    def remove(lines: list[bytes]) -> None:
        lines[:] = [line for line in lines if b'"host_time_ns":%d' % host_time_ns not in line]

    station_log = _with_modified_journal(station_log, tmp_path, remove)
    station_log = dataclasses.replace(station_log, crash_windows_ns=[(since_ns, read_times_ns + 50_000_000)])
    found = _checks(dataclasses.replace(result, station_logs=result.station_logs | {1: station_log}))
    assert ("journal" in found) == (result.superframe and not full)


def test_missing_acknowledgement_is_detected(result: MissionResult, tmp_path: Path) -> None:
    """A measurement delivered twenty seconds ago that is still queued."""
    arrived = zip(result.master_logs[0].measurements, result.master_logs[0].arrived_ns, strict=True)
    first = next(m.sequence for m, at_ns in arrived if m.station == 2 and at_ns > 5_000_000_000)
    for oldest, count in ((first, 1), (first + 10_000, 0)):
        record = encode_line(AcknowledgedRecord(stamp_ns=1, oldest=oldest)) + b"\n"
        station_log = _with_modified_journal(result.station_logs[2], tmp_path, partial(_append, record))
        station_logs = result.station_logs | {2: station_log}
        indices = {number: JournalIndex(each) for number, each in station_logs.items()}
        modified = dataclasses.replace(result, station_logs=station_logs)
        assert len(list(missing_acknowledgements(modified, indices))) == count * result.superframe


def test_acknowledged_but_lost_measurement_is_detected(result: MissionResult, tmp_path: Path) -> None:
    """Over ``superframe`` an unrecorded measurement must be in the queue."""
    session = result.master_logs[0]
    recording = session.recording()
    assert recording is not None
    lines = recording.read_bytes().splitlines(keepends=True)
    index = next(i for i, line in enumerate(lines) if line.startswith(b'{"type":"measurement","station":2'))
    (tmp_path / recording.name).write_bytes(b"".join(lines[:index] + lines[index + 1 :]))
    session.folder = tmp_path
    station_log = result.station_logs[2]
    delivered = sum(measurement.station == 2 for measurement in session.measurements)
    missing = len(JournalIndex(station_log).journalled) - delivered + 1
    for queued in (missing - 1, missing):
        statuses = [dataclasses.replace(status, queued=queued) for status in station_log.statuses]
        emptied = dataclasses.replace(station_log, statuses=statuses)
        found = _checks(dataclasses.replace(result, station_logs=result.station_logs | {2: emptied}))
        assert ("lost" in found) == (result.superframe and queued < missing)


def test_duplicate_delivery_is_detected(result: MissionResult) -> None:
    """Over ``classic`` even under another sequence number."""
    measurements = result.master_logs[0].measurements
    number = measurements[40].sequence if result.superframe else 999
    measurements.append(dataclasses.replace(measurements[40], sequence=number))
    assert _checks(result) == {"duplicate"}


@pytest.mark.parametrize("ahead", [-1, 1])
def test_timestamp_beyond_its_bound_is_detected(result: MissionResult, ahead: int) -> None:
    """A timestamp error of 50 ms exceeds all bounds stated here."""
    measurements = result.master_logs[0].measurements
    late_ns = ahead * 50_000_000
    measurements[40] = dataclasses.replace(measurements[40], stamp_ns=measurements[40].stamp_ns + late_ns)
    assert "time" in _checks(result)


def test_pose_from_an_unusable_measurement_is_detected(result: MissionResult) -> None:
    """Only for ``linear``: a pose of ``continuous`` rests on many measurements."""
    if result.parameters.pipeline.estimator == "continuous":
        return
    measurements = result.master_logs[0].measurements
    measurements[40] = dataclasses.replace(measurements[40], status=Status.TILT)
    assert "pose" in _checks(result)


def test_wrong_pose_is_detected(result: MissionResult) -> None:
    """A pose of ``linear`` is checked to a millimetre, one of ``continuous`` to its covariance."""
    linear = result.parameters.pipeline.estimator == "linear"
    result.master_logs[0]._pose_numbers[52 * 100] += 1e-3 if linear else 1.0
    assert _checks(result) == {"pose"}


@pytest.mark.parametrize("part", [slice(9, 45), slice(0, 3)], ids=["covariance", "position"])
def test_overconfident_or_biased_poses_are_detected(
    result: MissionResult, part: slice, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Poses with a sixteenth of the covariance, or all of them with an error of 10 mm."""
    monkeypatch.setattr(consistency, "_MIN_POSES", 300)
    session = result.master_logs[0]
    assert list(consistency.distribution_failures(session, result, {})) == []
    numbers = np.array(session._pose_numbers).reshape(-1, 52)
    if part.start:
        numbers[:, part] /= 16
    else:
        numbers[:, part] += 0.01
    session._pose_numbers = array("d", numbers.ravel())
    assert list(consistency.distribution_failures(session, result, {}))


def test_unrecorded_line_is_detected(result: MissionResult) -> None:
    """The replay of a recording that lacks a line differs from the stream."""
    planted = EventRecord(stamp_ns=1, event="planted", message="not in the recording")
    result.master_logs[0].observe(planted, encode_line(planted))
    assert _checks(result) == {"recording", "replay"}


@pytest.mark.parametrize("crashed", [False, True])
def test_recording_without_a_header(result: MissionResult, tmp_path: Path, *, crashed: bool) -> None:
    """A master that was killed as it wrote it leaves none; any other one must have a recording."""
    session = result.master_logs[0]
    session.folder, session.crashed = tmp_path, crashed
    (tmp_path / "master.jsonl").write_bytes(b'{"type":"recor')
    found = check_invariants(result)
    assert any("has no recording" in each.detail for each in found) != crashed
