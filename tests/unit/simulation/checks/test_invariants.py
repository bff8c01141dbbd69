"""The checkers of simulated runs: silent about a good run, and loud about each planted defect."""

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
from harness.missions import QUICK, SUPERFRAME, mission

from tsgt.config import ScenarioConfig
from tsgt.model import Status
from tsgt.recording import EventRecord, encode_line
from tsgt.recording.journal import AcknowledgedRecord
from tsgt.simulation.checks import check_invariants, pose_consistency
from tsgt.simulation.checks.invariants import reading_mismatches
from tsgt.simulation.checks.liveness import missing_acknowledgements
from tsgt.simulation.mission import JournalIndex
from tsgt.simulation.mission.disk import UNWRITTEN_WINDOW_NS

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tsgt.simulation.mission import MissionResult, StationLog


@pytest.fixture(scope="module", params=["classic", "superframe"])
def good(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> MissionResult:
    """Half a minute in which nothing goes wrong, with each protocol and each estimator."""
    folder = tmp_path_factory.mktemp("run")
    if request.param == "superframe":
        return mission(folder, protocol=SUPERFRAME)
    plain = ScenarioConfig()
    linear = plain.pipeline.model_copy(update={"estimator": "linear"})
    return mission(folder, plain.model_copy(update={"pipeline": linear}), protocol=QUICK)


@pytest.fixture
def run(good: MissionResult) -> MissionResult:
    """Return a copy whose records may be spoilt."""
    (session,) = good.master_logs
    spoilt = copy.copy(session)
    spoilt.measurements = list(session.measurements)
    spoilt.line_hashes = session.line_hashes[:]
    spoilt._pose_numbers = copy.copy(session._pose_numbers)
    return dataclasses.replace(good, master_logs=[spoilt])


def _checks(run: MissionResult) -> set[str]:
    return {violation.check for violation in check_invariants(run)}


def test_a_good_run_has_no_violations(good: MissionResult) -> None:
    """Nothing is found where nothing is wrong, in a run that has something to check."""
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
def test_an_altered_measurement(run: MissionResult, change: dict[str, Any]) -> None:
    """A measurement whose content has changed on its way is not in the journal like that."""
    measurements = run.master_logs[0].measurements
    measurements[40] = dataclasses.replace(measurements[40], **change)
    assert "journal" in _checks(run)


@pytest.mark.parametrize("units", [0.49, 0.51])
@pytest.mark.parametrize("key", ["horizontal_angle_rad", "zenith_angle_rad", "slope_distance_m"])
def test_what_the_radio_rounds(run: MissionResult, key: str, units: float) -> None:
    """Half a unit of an angle or of a distance is what ``superframe`` may round; ``classic`` rounds nothing."""
    measurements = run.master_logs[0].measurements
    journalled = JournalIndex(run.station_logs[measurements[40].station]).find(measurements[40])
    assert journalled is not None
    unit = 1e-4 if key == "slope_distance_m" else math.tau / 2**24
    rounded = getattr(journalled, key) + units * unit
    measurements[40] = dataclasses.replace(measurements[40], **{key: rounded})
    assert ("journal" in _checks(run)) == (units > 0.5 or not run.superframe)


def test_a_measurement_that_nobody_made(run: MissionResult) -> None:
    """A measurement with a host time, or a number, that no client ever saw is noticed twice over."""
    measurements = run.master_logs[0].measurements
    host_time_ns = measurements[40].host_time_ns
    if host_time_ns is None:
        measurements[40] = dataclasses.replace(measurements[40], sequence=99_999)
    else:
        measurements[40] = dataclasses.replace(measurements[40], host_time_ns=host_time_ns + 1)
    assert {"journal", "time"} <= _checks(run)


def test_a_measurement_that_is_read_and_not_journalled(run: MissionResult) -> None:
    """It is missed, although nobody else ever saw it."""
    station_log = dataclasses.replace(
        run.station_logs[1], true_times_ns=run.station_logs[1].true_times_ns | {12_345: 0}
    )
    run = dataclasses.replace(run, station_logs=run.station_logs | {1: station_log})
    assert _checks(run) == {"journal"}


def test_a_value_that_the_instrument_never_gave(run: MissionResult) -> None:
    """A journalled distance that differs from all that were offered, by a hundredth of a millimetre, is noticed."""
    station_log = run.station_logs[1]
    reported_distances = list(station_log.reported_distances)
    reported_distances[20] = reported_distances[20]._replace(
        distance_m=reported_distances[20].distance_m + 1e-5
    )
    station_log = dataclasses.replace(station_log, reported_distances=reported_distances)
    (found,) = check_invariants(dataclasses.replace(run, station_logs=run.station_logs | {1: station_log}))
    assert found.check == "reading"
    assert "never reported" in found.detail


def test_a_value_that_stands_in_the_journals_twice(run: MissionResult, tmp_path: Path) -> None:
    """The same answer under two numbers is one reading too many."""
    station_log = run.station_logs[1]
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
def test_a_reading_that_is_stamped_wrongly(run: MissionResult, off_ms: int) -> None:
    """A stamp may be 40 ms before or after the instant of the distance, no more."""
    station_log = run.station_logs[1]
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


def test_stamps_that_are_all_late(run: MissionResult) -> None:
    """An instrument's latency that nobody takes off is less than one stamp may be off by, and not what half of them may."""
    station_log = run.station_logs[1]
    for late_ns, found in ((0, []), (20_000_000, ["reading"])):
        stamps_ns = {host_ns: true_ns + late_ns for host_ns, true_ns in station_log.true_times_ns.items()}
        late = dataclasses.replace(station_log, true_times_ns=stamps_ns)
        assert [violation.check for violation in reading_mismatches(late, JournalIndex(late))] == found


def _append(line: bytes, lines: list[bytes]) -> None:
    lines.append(line)


def _spoilt_journal(
    station_log: StationLog, folder: Path, spoil: Callable[[list[bytes]], None]
) -> StationLog:
    """Return a witness with a copy of its only journal, whose lines have been spoilt."""
    (path,) = station_log.journals
    lines = path.read_bytes().splitlines(keepends=True)
    spoil(lines)
    (folder / path.name).write_bytes(b"".join(lines))
    return dataclasses.replace(station_log, folder=folder)


@pytest.mark.parametrize("full", [False, True])
def test_a_measurement_that_is_delivered_and_not_journalled(
    run: MissionResult, tmp_path: Path, full: bool
) -> None:
    """That a client was killed soon after is no excuse over ``superframe``, which delivers what the disk took or refused."""
    station_log = run.station_logs[1]
    delivered = [m for m in run.master_logs[0].measurements if m.station == 1][20]
    journalled = JournalIndex(station_log).find(delivered)
    assert journalled is not None
    host_time_ns = journalled.host_time_ns
    assert host_time_ns is not None
    read_times_ns = station_log.read_times_ns[host_time_ns]
    since_ns = read_times_ns - 1 if full else read_times_ns + 50_000_000 - UNWRITTEN_WINDOW_NS

    def leave_out(lines: list[bytes]) -> None:
        lines[:] = [line for line in lines if b'"host_time_ns":%d' % host_time_ns not in line]

    station_log = _spoilt_journal(station_log, tmp_path, leave_out)
    station_log = dataclasses.replace(station_log, crash_windows_ns=[(since_ns, read_times_ns + 50_000_000)])
    found = _checks(dataclasses.replace(run, station_logs=run.station_logs | {1: station_log}))
    assert ("journal" in found) == (run.superframe and not full)


def test_what_has_reached_the_master_and_still_waits(run: MissionResult, tmp_path: Path) -> None:
    """A station whose lowest number the master has had for twenty seconds is not told so."""
    arrived = zip(run.master_logs[0].measurements, run.master_logs[0].arrived_ns, strict=True)
    first = next(m.sequence for m, at_ns in arrived if m.station == 2 and at_ns > 5_000_000_000)
    for oldest, count in ((first, 1), (first + 10_000, 0)):
        record = encode_line(AcknowledgedRecord(stamp_ns=1, oldest=oldest)) + b"\n"
        station_log = _spoilt_journal(run.station_logs[2], tmp_path, partial(_append, record))
        station_logs = run.station_logs | {2: station_log}
        measured = {number: JournalIndex(each) for number, each in station_logs.items()}
        spoilt = dataclasses.replace(run, station_logs=station_logs)
        assert len(list(missing_acknowledgements(spoilt, measured))) == count * run.superframe


def test_what_is_acknowledged_and_lost(run: MissionResult, tmp_path: Path) -> None:
    """Over ``superframe`` a measurement that is in no recording has to wait in a queue still."""
    session = run.master_logs[0]
    recording = session.recording()
    assert recording is not None
    lines = recording.read_bytes().splitlines(keepends=True)
    index = next(i for i, line in enumerate(lines) if line.startswith(b'{"type":"measurement","station":2'))
    (tmp_path / recording.name).write_bytes(b"".join(lines[:index] + lines[index + 1 :]))
    session._folder = tmp_path
    station_log = run.station_logs[2]
    delivered = sum(measurement.station == 2 for measurement in session.measurements)
    missing = len(JournalIndex(station_log).journalled) - delivered + 1
    for queued in (missing - 1, missing):
        statuses = [dataclasses.replace(status, queued=queued) for status in station_log.statuses]
        emptied = dataclasses.replace(station_log, statuses=statuses)
        found = _checks(dataclasses.replace(run, station_logs=run.station_logs | {2: emptied}))
        assert ("lost" in found) == (run.superframe and queued < missing)


def test_a_repeat(run: MissionResult) -> None:
    """The same measurement handed over again is noticed, over ``classic`` even under another number."""
    measurements = run.master_logs[0].measurements
    number = measurements[40].sequence if run.superframe else 999
    measurements.append(dataclasses.replace(measurements[40], sequence=number))
    assert _checks(run) == {"duplicate"}


@pytest.mark.parametrize("ahead", [-1, 1])
def test_a_time_stamp_beyond_its_bound(run: MissionResult, ahead: int) -> None:
    """A stamp that is 50 ms off, in either direction, is further off than any bound stated here."""
    measurements = run.master_logs[0].measurements
    late_ns = ahead * 50_000_000
    measurements[40] = dataclasses.replace(measurements[40], stamp_ns=measurements[40].stamp_ns + late_ns)
    assert "time" in _checks(run)


def test_a_pose_from_an_unusable_measurement(run: MissionResult) -> None:
    """If what a valid pose rests on was unusable, the pose is wrong; one of ``continuous`` rests on many."""
    if run.parameters.pipeline.estimator == "continuous":
        return
    measurements = run.master_logs[0].measurements
    measurements[40] = dataclasses.replace(measurements[40], status=Status.TILT)
    assert "pose" in _checks(run)


def test_a_pose_that_is_somewhere_else(run: MissionResult) -> None:
    """A pose off by a millimetre is not where its measurements are; one of ``continuous`` is known less well."""
    linear = run.parameters.pipeline.estimator == "linear"
    run.master_logs[0]._pose_numbers[45 * 100] += 1e-3 if linear else 1.0
    assert _checks(run) == {"pose"}


@pytest.mark.parametrize("part", [slice(9, 45), slice(0, 3)], ids=["covariance", "position"])
def test_poses_that_state_too_little(
    run: MissionResult, part: slice, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Poses with a sixteenth of the covariance, or all of them 10 mm beside the truth, are more certain than they may be."""
    monkeypatch.setattr(pose_consistency, "_MIN_POSES", 300)
    session = run.master_logs[0]
    assert list(pose_consistency.distribution_failures(session, run)) == []
    numbers = np.array(session._pose_numbers).reshape(-1, 45)
    if part.start:
        numbers[:, part] /= 16
    else:
        numbers[:, part] += 0.01
    session._pose_numbers = array("d", numbers.ravel())
    assert list(pose_consistency.distribution_failures(session, run))


def test_a_line_that_was_streamed_but_not_recorded(run: MissionResult) -> None:
    """The replay of a recording that lacks a line is not the stream."""
    planted = EventRecord(stamp_ns=1, event="planted", message="not in the recording")
    run.master_logs[0].observe(planted, encode_line(planted))
    assert _checks(run) == {"replay"}
