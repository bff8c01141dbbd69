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
from tsgt.simulation.checks import pose_consistency, violations
from tsgt.simulation.checks.invariants import misread
from tsgt.simulation.checks.liveness import unacknowledged
from tsgt.simulation.mission import Measured
from tsgt.simulation.mission.disk import UNWRITTEN_NS

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tsgt.simulation.mission import Run, StationWitness


@pytest.fixture(scope="module", params=["classic", "superframe"])
def good(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Half a minute in which nothing goes wrong, with each protocol and each estimator."""
    folder = tmp_path_factory.mktemp("run")
    if request.param == "superframe":
        return mission(folder, protocol=SUPERFRAME)
    plain = ScenarioConfig()
    linear = plain.pipeline.model_copy(update={"estimator": "linear"})
    return mission(folder, plain.model_copy(update={"pipeline": linear}), protocol=QUICK)


@pytest.fixture
def run(good: Run) -> Run:
    """Return a copy whose records may be spoilt."""
    (session,) = good.sessions
    spoilt = copy.copy(session)
    spoilt.measurements = list(session.measurements)
    spoilt.lines = session.lines[:]
    spoilt._pose_numbers = copy.copy(session._pose_numbers)
    return dataclasses.replace(good, sessions=[spoilt])


def _checks(run: Run) -> set[str]:
    return {violation.check for violation in violations(run)}


def test_a_good_run_has_no_violations(good: Run) -> None:
    """Nothing is found where nothing is wrong, in a run that has something to check."""
    assert violations(good) == []
    (session,) = good.sessions
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
def test_an_altered_measurement(run: Run, change: dict[str, Any]) -> None:
    """A measurement whose content has changed on its way is not in the journal like that."""
    measurements = run.sessions[0].measurements
    measurements[40] = dataclasses.replace(measurements[40], **change)
    assert "journal" in _checks(run)


@pytest.mark.parametrize("units", [0.49, 0.51])
@pytest.mark.parametrize("key", ["horizontal_angle_rad", "zenith_angle_rad", "slope_distance_m"])
def test_what_the_radio_rounds(run: Run, key: str, units: float) -> None:
    """Half a unit of an angle or of a distance is what ``superframe`` may round; ``classic`` rounds nothing."""
    measurements = run.sessions[0].measurements
    journalled = Measured(run.witnesses[measurements[40].station]).in_journal(measurements[40])
    assert journalled is not None
    unit = 1e-4 if key == "slope_distance_m" else math.tau / 2**24
    rounded = getattr(journalled, key) + units * unit
    measurements[40] = dataclasses.replace(measurements[40], **{key: rounded})
    assert ("journal" in _checks(run)) == (units > 0.5 or not run.superframe)


def test_a_measurement_that_nobody_made(run: Run) -> None:
    """A measurement with a host time, or a number, that no client ever saw is noticed twice over."""
    measurements = run.sessions[0].measurements
    host_time_ns = measurements[40].host_time_ns
    if host_time_ns is None:
        measurements[40] = dataclasses.replace(measurements[40], sequence=99_999)
    else:
        measurements[40] = dataclasses.replace(measurements[40], host_time_ns=host_time_ns + 1)
    assert {"journal", "time"} <= _checks(run)


def test_a_measurement_that_is_read_and_not_journalled(run: Run) -> None:
    """It is missed, although nobody else ever saw it."""
    witness = dataclasses.replace(run.witnesses[1], stamps_ns=run.witnesses[1].stamps_ns | {12_345: 0})
    run = dataclasses.replace(run, witnesses=run.witnesses | {1: witness})
    assert _checks(run) == {"journal"}


def test_a_value_that_the_instrument_never_gave(run: Run) -> None:
    """A journalled distance that differs from all that were offered, by a hundredth of a millimetre, is noticed."""
    witness = run.witnesses[1]
    offered = list(witness.offered)
    offered[20] = offered[20]._replace(distance_m=offered[20].distance_m + 1e-5)
    witness = dataclasses.replace(witness, offered=offered)
    (found,) = violations(dataclasses.replace(run, witnesses=run.witnesses | {1: witness}))
    assert found.check == "read"
    assert "never given" in found.detail


def test_a_value_that_stands_in_the_journals_twice(run: Run, tmp_path: Path) -> None:
    """The same answer under two numbers is one reading too many."""
    witness = run.witnesses[1]
    (path,) = witness.journals
    *_, line = [line for line in path.read_bytes().splitlines() if b'"type":"measurement"' in line]
    again = json.loads(line)
    again["sequence"] += 1
    (tmp_path / path.name).write_bytes(path.read_bytes() + json.dumps(again).encode() + b"\n")
    witness = dataclasses.replace(witness, folder=tmp_path)
    (found,) = misread(witness, Measured(witness))
    assert found.check == "read"
    assert "twice" in found.detail


@pytest.mark.parametrize("off_ms", [-41, -39, 39, 41])
def test_a_reading_that_is_stamped_wrongly(run: Run, off_ms: int) -> None:
    """A stamp may be 40 ms before or after the instant of the distance, no more."""
    witness = run.witnesses[1]
    journalled = Measured(witness).journalled[20]
    assert journalled.instrument_time_ns is not None
    instrument_ms = journalled.instrument_time_ns // 1_000_000
    (truth,) = [each for each in witness.offered if each.instrument_ms == instrument_ms]
    assert journalled.host_time_ns is not None
    stamps_ns = witness.stamps_ns | {journalled.host_time_ns: truth.true_ns + off_ms * 1_000_000}
    witness = dataclasses.replace(witness, stamps_ns=stamps_ns)
    assert [found.check for found in misread(witness, Measured(witness))] == ["read"] * (abs(off_ms) > 40)


def test_stamps_that_are_all_late(run: Run) -> None:
    """An instrument's latency that nobody takes off is less than one stamp may be off by, and not what half of them may."""
    witness = run.witnesses[1]
    for late_ns, found in ((0, []), (20_000_000, ["read"])):
        stamps_ns = {host_ns: true_ns + late_ns for host_ns, true_ns in witness.stamps_ns.items()}
        late = dataclasses.replace(witness, stamps_ns=stamps_ns)
        assert [violation.check for violation in misread(late, Measured(late))] == found


def _append(line: bytes, lines: list[bytes]) -> None:
    lines.append(line)


def _spoilt_journal(
    witness: StationWitness, folder: Path, spoil: Callable[[list[bytes]], None]
) -> StationWitness:
    """Return a witness with a copy of its only journal, whose lines have been spoilt."""
    (path,) = witness.journals
    lines = path.read_bytes().splitlines(keepends=True)
    spoil(lines)
    (folder / path.name).write_bytes(b"".join(lines))
    return dataclasses.replace(witness, folder=folder)


@pytest.mark.parametrize("full", [False, True])
def test_a_measurement_that_is_delivered_and_not_journalled(run: Run, tmp_path: Path, full: bool) -> None:  # noqa: FBT001
    """That a client was killed soon after is no excuse over ``superframe``, which delivers what the disk took or refused."""
    witness = run.witnesses[1]
    delivered = [m for m in run.sessions[0].measurements if m.station == 1][20]
    journalled = Measured(witness).in_journal(delivered)
    assert journalled is not None
    host_time_ns = journalled.host_time_ns
    assert host_time_ns is not None
    read_ns = witness.read_ns[host_time_ns]
    since_ns = read_ns - 1 if full else read_ns + 50_000_000 - UNWRITTEN_NS

    def leave_out(lines: list[bytes]) -> None:
        lines[:] = [line for line in lines if b'"host_time_ns":%d' % host_time_ns not in line]

    witness = _spoilt_journal(witness, tmp_path, leave_out)
    witness = dataclasses.replace(witness, crashed_ns=[(since_ns, read_ns + 50_000_000)])
    found = _checks(dataclasses.replace(run, witnesses=run.witnesses | {1: witness}))
    assert ("journal" in found) == (run.superframe and not full)


def test_what_has_reached_the_master_and_still_waits(run: Run, tmp_path: Path) -> None:
    """A station whose lowest number the master has had for twenty seconds is not told so."""
    arrived = zip(run.sessions[0].measurements, run.sessions[0].arrived_ns, strict=True)
    first = next(m.sequence for m, at_ns in arrived if m.station == 2 and at_ns > 5_000_000_000)
    for oldest, count in ((first, 1), (first + 10_000, 0)):
        record = encode_line(AcknowledgedRecord(stamp_ns=1, oldest=oldest)) + b"\n"
        witness = _spoilt_journal(run.witnesses[2], tmp_path, partial(_append, record))
        witnesses = run.witnesses | {2: witness}
        measured = {number: Measured(each) for number, each in witnesses.items()}
        spoilt = dataclasses.replace(run, witnesses=witnesses)
        assert len(list(unacknowledged(spoilt, measured))) == count * run.superframe


def test_what_is_acknowledged_and_lost(run: Run, tmp_path: Path) -> None:
    """Over ``superframe`` a measurement that is in no recording has to wait in a queue still."""
    session = run.sessions[0]
    recording = session.recording()
    assert recording is not None
    lines = recording.read_bytes().splitlines(keepends=True)
    index = next(i for i, line in enumerate(lines) if line.startswith(b'{"type":"measurement","station":2'))
    (tmp_path / recording.name).write_bytes(b"".join(lines[:index] + lines[index + 1 :]))
    session._folder = tmp_path
    witness = run.witnesses[2]
    delivered = sum(measurement.station == 2 for measurement in session.measurements)
    missing = len(Measured(witness).journalled) - delivered + 1
    for queued in (missing - 1, missing):
        statuses = [dataclasses.replace(status, queued=queued) for status in witness.statuses]
        emptied = dataclasses.replace(witness, statuses=statuses)
        found = _checks(dataclasses.replace(run, witnesses=run.witnesses | {2: emptied}))
        assert ("lost" in found) == (run.superframe and queued < missing)


def test_a_repeat(run: Run) -> None:
    """The same measurement handed over again is noticed, over ``classic`` even under another number."""
    measurements = run.sessions[0].measurements
    number = measurements[40].sequence if run.superframe else 999
    measurements.append(dataclasses.replace(measurements[40], sequence=number))
    assert _checks(run) == {"twice"}


@pytest.mark.parametrize("ahead", [-1, 1])
def test_a_time_stamp_beyond_its_bound(run: Run, ahead: int) -> None:
    """A stamp that is 50 ms off, in either direction, is further off than any bound stated here."""
    measurements = run.sessions[0].measurements
    late_ns = ahead * 50_000_000
    measurements[40] = dataclasses.replace(measurements[40], stamp_ns=measurements[40].stamp_ns + late_ns)
    assert "time" in _checks(run)


def test_a_pose_from_an_unusable_measurement(run: Run) -> None:
    """If what a valid pose rests on was unusable, the pose is wrong; one of ``continuous`` rests on many."""
    if run.parameters.pipeline.estimator == "continuous":
        return
    measurements = run.sessions[0].measurements
    measurements[40] = dataclasses.replace(measurements[40], status=Status.TILT)
    assert "pose" in _checks(run)


def test_a_pose_that_is_somewhere_else(run: Run) -> None:
    """A pose off by a millimetre is not where its measurements are; one of ``continuous`` is known less well."""
    linear = run.parameters.pipeline.estimator == "linear"
    run.sessions[0]._pose_numbers[45 * 100] += 1e-3 if linear else 1.0
    assert _checks(run) == {"pose"}


@pytest.mark.parametrize("part", [slice(9, 45), slice(0, 3)], ids=["covariance", "position"])
def test_poses_that_state_too_little(run: Run, part: slice, monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses with a sixteenth of the covariance, or all of them 10 mm beside the truth, are more certain than they may be."""
    monkeypatch.setattr(pose_consistency, "_FEWEST_POSES", 300)
    session = run.sessions[0]
    assert list(pose_consistency.too_sure(session, run)) == []
    numbers = np.array(session._pose_numbers).reshape(-1, 45)
    if part.start:
        numbers[:, part] /= 16
    else:
        numbers[:, part] += 0.01
    session._pose_numbers = array("d", numbers.ravel())
    assert list(pose_consistency.too_sure(session, run))


def test_a_line_that_was_streamed_but_not_recorded(run: Run) -> None:
    """The replay of a recording that lacks a line is not the stream."""
    planted = EventRecord(stamp_ns=1, event="planted", message="not in the recording")
    run.sessions[0].take(planted, encode_line(planted))
    assert _checks(run) == {"replay"}
