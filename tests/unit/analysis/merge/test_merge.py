"""Merging the journals of simulated missions: every measurement is present once, at its true time."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.missions.merging import assert_true, journals, merged_in, recording
from harness.missions.missions import SUPERFRAME, run_mission

from tsgt.analysis.merge import merge
from tsgt.analysis.merge.merge import MAX_TIME_BOUND_NS, SESSION_MARGIN_NS
from tsgt.analysis.merge.recording_index import identity
from tsgt.analysis.processing import process
from tsgt.config import ScenarioConfig
from tsgt.config.scenario import StatusFaultConfig
from tsgt.errors import CorruptLineError, RecordingError
from tsgt.estimation import Reason, build_observations, instrument_time_sigma_s
from tsgt.master.replay import replayed
from tsgt.model import PolarMeasurement, Status
from tsgt.recording import RecordingWriter, load_recording
from tsgt.recording.journal import load_journal
from tsgt.simulation.options import Outage, Restart

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.simulation.mission import Mission, MissionResult


pytestmark = pytest.mark.slow  # whole missions

S = 1_000_000_000


@pytest.fixture(scope="module")
def outage(tmp_path_factory: pytest.TempPathFactory) -> MissionResult:
    """Over classic, a minute without reception between the stations and the master."""
    return run_mission(
        tmp_path_factory.mktemp("outage"),
        duration_s=130.0,
        drift_ppm=20.0,
        drift_ramp_ppm_per_min=0.3,
        outages=(Outage((1, 2, 3), 35.0, 60.0),),
    )


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> MissionResult:
    """Over classic, some seconds."""
    return run_mission(tmp_path_factory.mktemp("short"), duration_s=12.0)


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> MissionResult:
    """Over superframe; without any reception in the last half minute."""
    return run_mission(
        tmp_path_factory.mktemp("frames"),
        protocol=SUPERFRAME,
        duration_s=60.0,
        stamp_jitter_us=20.0,
        outages=(Outage((1, 2, 3), 30.0, 60.0),),
    )


def measured(path: Path) -> Counter[object]:
    """Count the measurements of a recording by identity."""
    return Counter(
        identity(measurement)
        for measurement in load_recording(path).measurements
        if isinstance(measurement, PolarMeasurement)
    )


def journalled(run: MissionResult) -> Counter[object]:
    """Count the measurements of the journals by identity."""
    return Counter(
        identity(measurement) for path in journals(run) for measurement in load_journal(path).measurements
    )


def added_to(run: MissionResult, path: Path, *, without: int = 0) -> list[PolarMeasurement]:
    """Merge all journals of a mission into its recording; return the added measurements after checking their times."""
    recording(run, path, without=without)
    merged = merge(path, journals(run))
    added = merged_in(path)
    assert merged.added == len(added) > 0
    assert_true(run, added)
    return added


# --- Classic ----------------------------------------------------------------------------------------------------------


def test_outage_is_filled(outage: MissionResult, tmp_path: Path) -> None:
    """A merge yields poses during the outage, close to the true ones."""
    path = recording(outage, tmp_path / "r.jsonl")
    before = process(load_recording(path), path=path)
    added_to(outage, path)
    after = process(load_recording(path), path=path)
    missing, closed = (
        np.count_nonzero((poses.stamp_ns > gap_ns[0]) & (poses.stamp_ns < gap_ns[1]) & poses.valid)
        for gap_ns in [(outage.start_ns + 37 * S, outage.start_ns + 95 * S)]
        for poses in (before, after)
    )
    assert missing == 0
    assert closed > 57 * 20
    truth_m = outage.world.pose_at((after.stamp_ns[after.valid] - outage.start_ns) / 1e9)[:, :3, 3]
    error_m = np.linalg.norm(after.position_m[after.valid] - truth_m, axis=1)
    assert np.sqrt(np.mean(error_m**2)) < 0.05


def test_every_measurement_is_present_once(outage: MissionResult, tmp_path: Path) -> None:
    """Classic transmits the newest measurements only; after the merge the recording has all of them."""
    path = recording(outage, tmp_path / "r.jsonl")
    merged = merge(path, journals(outage))
    assert measured(path) == journalled(outage)
    assert max(measured(path).values()) == 1
    assert merged.added + merged.already_there == sum(journal.measurements for journal in merged.journals)
    assert merged.bounds_ns[-1] < 5_000_000


def test_merged_measurements_have_the_prism_that_the_master_names(
    outage: MissionResult, tmp_path: Path
) -> None:
    """Classic does not transmit the one of the client's configuration, which may differ."""
    path = recording(outage, tmp_path / "r.jsonl")
    renumbered = []
    for number, journal in enumerate(journals(outage)):
        renumbered.append(tmp_path / f"{number}.jsonl")
        renumbered[-1].write_bytes(re.sub(rb'"prism":\d+', b'"prism":9', journal.read_bytes()))
    assert merge(path, renumbered).added > 0
    tracked = {(each.station, each.prism) for each in load_recording(path).measurements}
    assert tracked == {(each.station, each.prism) for each in outage.parameters.stations}


def test_second_merge_adds_nothing(outage: MissionResult, tmp_path: Path) -> None:
    """Neither the same journals nor copies of them."""
    path = recording(outage, tmp_path / "r.jsonl")
    first = merge(path, journals(outage))
    content = path.read_bytes()
    copy = tmp_path / "copy.jsonl"
    copy.write_bytes(journals(outage)[0].read_bytes())
    again = merge(path, [*journals(outage), copy])
    assert path.read_bytes() == content
    assert (again.added, again.already_there) == (
        0,
        first.already_there + first.added + again.journals[3].measurements,
    )


def test_copy_of_a_journal_adds_nothing(short: MissionResult, tmp_path: Path) -> None:
    """Also together with the journal in the first merge."""
    path = recording(short, tmp_path / "r.jsonl")
    copy = tmp_path / "copy.jsonl"
    copy.write_bytes(journals(short)[0].read_bytes())
    merge(path, [copy, *journals(short), journals(short)[0]])
    assert measured(path) == journalled(short)


def test_replay_ignores_merged_measurements(outage: MissionResult, tmp_path: Path) -> None:
    """They were not in the stream."""
    path = recording(outage, tmp_path / "r.jsonl")
    before = list(replayed(path))
    merge(path, journals(outage))
    assert list(replayed(path)) == before


def test_output_file(short: MissionResult, tmp_path: Path) -> None:
    """It equals the recording with the additions, and the recording is unchanged."""
    path, output = recording(short, tmp_path / "r.jsonl"), tmp_path / "o.jsonl"
    content = path.read_bytes()
    merge(path, journals(short), output=output)
    assert path.read_bytes() == content
    merge(path, journals(short))
    assert output.read_bytes() == path.read_bytes()


def test_merge_after_a_kill_at_any_byte(short: MissionResult, tmp_path: Path) -> None:
    """Repeating the merge completes it, whatever remains of the last line."""
    path = recording(short, tmp_path / "r.jsonl")
    size = path.stat().st_size
    merge(path, journals(short))
    whole = path.read_bytes()
    for left in np.linspace(size, len(whole), 25).astype(int).tolist():
        path.write_bytes(whole[:left])
        merged = merge(path, journals(short))
        assert merged.cut_bytes == (
            0 if whole[left - 1 : left] == b"\n" else left - whole.rfind(b"\n", 0, left) - 1
        )
        assert measured(path) == journalled(short)


def test_restarts_of_master_and_station(tmp_path: Path) -> None:
    """A station restarts during an outage, and its Unix clock is set meanwhile."""

    async def set_clock(mission: Mission) -> None:
        await mission.sleep_until(50.0)
        mission.computers["station2"].clock.step(3_000_000_000)

    run = run_mission(
        tmp_path / "m",
        duration_s=110.0,
        drift_ppm=40.0,
        outages=(Outage((1, 2, 3), 30.0, 30.0),),
        restarts=(Restart(2, 40.0), Restart(2, 55.0), Restart(None, 80.0)),
        script=set_clock,
    )
    assert len(run.master_logs) == 2
    assert len(run.station_logs[2].journals) == 3
    path = tmp_path / "r.jsonl"
    # The run from 42 to 55 s had no radio contact; it shares the computer's clock with the others.
    added = added_to(run, path)
    silent = load_journal(run.station_logs[2].journals[1]).measurements
    assert {identity(m) for m in silent} <= {identity(m) for m in added}
    assert measured(path) == journalled(run)


def test_repeated_unix_time_after_a_reboot(tmp_path: Path) -> None:
    """Without a battery-backed clock, times of two journals overlap; delivered measurements resolve the ambiguity."""

    async def reboot(mission: Mission) -> None:
        await mission.sleep_until(39.0)
        mission.computers["station2"].clock.step(-35 * S)  # only the next run sees it
        await mission.reboot(2, 40.0, 15.0)

    run = run_mission(tmp_path / "m", duration_s=90.0, script=reboot)
    first, last = (load_journal(path).measurements for path in run.station_logs[2].journals)
    assert first[-1].stamp_ns > last[0].stamp_ns
    path = tmp_path / "r.jsonl"
    added_to(run, path)
    assert measured(path) == journalled(run)


def test_error_statuses_are_merged(tmp_path: Path) -> None:
    """A tilted instrument explains why ``linear`` has no poses."""
    scenario = ScenarioConfig(faults=(StatusFaultConfig(station=2, status="tilt", start_s=15.0, end_s=25.0),))
    run = run_mission(tmp_path / "m", scenario, duration_s=40.0, outages=(Outage((1, 2, 3), 10.0, 20.0),))
    path = tmp_path / "r.jsonl"
    added = added_to(run, path)
    assert any(m.station == 2 and m.status is Status.TILT for m in added)
    recorded = load_recording(path)
    pipeline = replace(recorded.parameters.pipeline, estimator="linear")
    recorded = replace(recorded, parameters=replace(recorded.parameters, pipeline=pipeline))
    poses = process(recorded, path=path)
    tilted = (poses.stamp_ns > run.start_ns + 17 * S) & (poses.stamp_ns < run.start_ns + 24 * S)
    assert set(poses.reason[tilted].tolist()) == {Reason.STATION_STATUS}
    assert merge(path, journals(run)).added == 0


def test_measurements_long_before_the_master_are_excluded(tmp_path: Path) -> None:
    """Those from two minutes before its start on are merged."""

    async def late_master(mission: Mission) -> None:
        await mission.sleep_until(1.0)
        await mission.stop("master")
        await mission.sleep_until(180.0)
        mission.start_master()

    run = run_mission(tmp_path / "m", duration_s=200.0, script=late_master)
    del run.master_logs[0]
    path = tmp_path / "r.jsonl"
    recording(run, path)
    merged = merge(path, journals(run))
    assert all(journal.outside > 100 for journal in merged.journals)
    added = merged_in(path)
    assert_true(run, added)
    earliest_ns = min(m.stamp_ns for m in added)
    assert 0 <= earliest_ns - (run.start_ns + 180 * S - SESSION_MARGIN_NS) < S
    assert merged.bounds_ns[-1] <= MAX_TIME_BOUND_NS


# --- Superframe -------------------------------------------------------------------------------------------------------


def test_undelivered_measurements_are_merged(frames: MissionResult, tmp_path: Path) -> None:
    """The mission ends without reception: the send queues are merged, for a while beyond the last beacon."""
    path = tmp_path / "r.jsonl"
    added = added_to(frames, path)
    assert sum(m.stamp_ns > frames.start_ns + 31 * S for m in added) > 3 * 60
    assert len(load_recording(path).measurements) == sum(journalled(frames).values())
    assert merge(path, journals(frames)).added == 0


def test_lost_lines_of_the_recording_are_restored(frames: MissionResult, tmp_path: Path) -> None:
    """Identified by sequence number and content, and timed by the beacons around them."""
    path = tmp_path / "r.jsonl"
    kept = len(load_recording(recording(frames, path)).measurements)
    added = added_to(frames, path, without=2)
    inside = [m for m in added if m.stamp_ns < frames.start_ns + 29 * S]
    assert kept // 2 - 5 < len(inside) <= kept // 2 + 5
    assert np.median([m.stamp_bound_ns for m in inside if m.stamp_bound_ns is not None]) < 500_000
    assert len(load_recording(path).measurements) == sum(journalled(frames).values())


def test_instrument_time_sigma_is_not_added_twice(frames: MissionResult, tmp_path: Path) -> None:
    """The time sigma of a merged measurement equals that of a delivered one, or the journal's if larger."""
    path = tmp_path / "r.jsonl"
    added = added_to(frames, path)
    parameters = load_recording(path).parameters
    stated_s = {
        (m.station, m.sequence): m.stamp_sigma_ns / 1e9
        for journal in journals(frames)
        for m in load_journal(journal).measurements
    }
    observations, sources = build_observations(parameters, added, origin_ns=frames.start_ns)
    for sigma_s, source in zip(observations.time_sigma_s, sources, strict=True):
        known_s = max(instrument_time_sigma_s(source.sequence), stated_s[source.station, source.sequence])
        assert known_s - 1e-9 <= sigma_s < 1.2 * known_s


def test_restarts_and_reboots_over_superframe(tmp_path: Path) -> None:
    """Sequence numbers continue over restarts of the client; each boot has its own clock."""

    async def reboot(mission: Mission) -> None:
        await mission.reboot(3, 30.0, 10.0)

    run = run_mission(
        tmp_path / "m",
        protocol=SUPERFRAME,
        duration_s=80.0,
        drift_ppm=40.0,
        outages=(Outage((2,), 20.0, 20.0),),
        restarts=(Restart(2, 30.0), Restart(None, 60.0)),
        script=reboot,
    )
    path = tmp_path / "r.jsonl"
    added_to(run, path, without=3)
    # Two sessions of the master may both have what the first one could not acknowledge any more.
    assert {(m.station, m.sequence) for m in load_recording(path).measurements} == {
        (m.station, m.sequence) for journal in journals(run) for m in load_journal(journal).measurements
    }


def test_reused_sequence_numbers(tmp_path: Path) -> None:
    """After the journals were deleted, the same numbers denote other measurements."""
    kept = tmp_path / "kept.jsonl"

    async def emptied(mission: Mission) -> None:
        await mission.sleep_until(20.0)
        await mission.stop("station1")
        mission.station_logs[1].journals[0].rename(kept)
        mission.start_station(1)

    run = run_mission(tmp_path / "m", protocol=SUPERFRAME, duration_s=40.0, script=emptied)
    path = recording(run, tmp_path / "r.jsonl", without=2)
    of_both = [load_journal(journal).measurements for journal in (kept, *run.station_logs[1].journals)]
    assert of_both[0][5].sequence == of_both[1][5].sequence
    before = len(load_recording(path).measurements)
    merged = merge(path, [kept, *journals(run)])
    assert_true(run, merged_in(path))
    assert before + merged.added == sum(journal.measurements for journal in merged.journals)


def test_journal_of_another_master_is_skipped(frames: MissionResult, tmp_path: Path) -> None:
    """It has no beacon of this recording."""
    path = recording(frames, tmp_path / "r.jsonl")
    other = tmp_path / "other.jsonl"
    content = journals(frames)[0].read_bytes().replace(b'"session":', b'"session":7')
    other.write_bytes(content.replace(b'"boot":"station1-1"', b'"boot":"x"'))
    merged = merge(path, [*journals(frames), other])
    assert "has no beacon of this recording" in merged.journals[3].skipped
    other.write_bytes(
        b"".join(line for line in content.splitlines(keepends=True) if b"reception" not in line)
    )
    with pytest.raises(RecordingError, match="has no beacon times"):
        merge(path, [other])


# --- What does not belong together ------------------------------------------------------------------------------------


def test_journals_of_another_mission_are_skipped(short: MissionResult, tmp_path: Path) -> None:
    """With a reason; if no other journals are given, the merge fails and writes nothing."""
    other = run_mission(tmp_path / "other", duration_s=5.0, seed=9)
    path = recording(short, tmp_path / "r.jsonl")
    content = path.read_bytes()
    with pytest.raises(RecordingError, match=r"none of the journals can be merged; .* of another mission"):
        merge(path, journals(other))
    assert path.read_bytes() == content
    unrelated = tmp_path / "unrelated.jsonl"
    unrelated.write_bytes(journals(other)[1].read_bytes().replace(b'"boot":"station2-1"', b'"boot":"else"'))
    merged = merge(path, [*journals(short), unrelated])
    assert [bool(journal.skipped) for journal in merged.journals] == [False, False, False, True]
    assert "another mission" in merged.journals[3].skipped
    assert measured(path) == journalled(short)


def test_journals_of_the_other_protocol_are_rejected(
    short: MissionResult, frames: MissionResult, tmp_path: Path
) -> None:
    """Classic journals have no beacons, superframe journals no synchronisations."""
    classic, superframe = recording(short, tmp_path / "c.jsonl"), recording(frames, tmp_path / "s.jsonl")
    with pytest.raises(
        RecordingError, match="is of the protocol superframe, but the recording has no beacons"
    ):
        merge(classic, journals(frames))
    with pytest.raises(RecordingError, match="is of the protocol classic, but the recording has no synchron"):
        merge(superframe, journals(short))


def test_unknown_station_is_named(short: MissionResult, tmp_path: Path) -> None:
    """By its number."""
    path = recording(short, tmp_path / "r.jsonl")
    seventh = tmp_path / "station7.jsonl"
    seventh.write_bytes(journals(short)[0].read_bytes().replace(b'"station":1', b'"station":7'))
    with pytest.raises(RecordingError, match="is of station 7, but the recording has only 1, 2, 3"):
        merge(path, [seventh])


def test_wrong_file_types_are_rejected(short: MissionResult, tmp_path: Path) -> None:
    """A journal as recording, a recording as journal, neither: nothing is changed or created."""
    path, journal = recording(short, tmp_path / "r.jsonl"), journals(short)[0]
    with pytest.raises(RecordingError, match="is a station's journal; give the master's recording first"):
        merge(journal, [journal])
    with pytest.raises(RecordingError, match="is not a station's journal"):
        merge(path, [path])
    missing = tmp_path / "missing.jsonl"
    with pytest.raises(RecordingError, match="cannot be read"):
        merge(missing, [journal])
    assert not missing.exists()
    path.write_bytes(
        b"".join(line for line in path.read_bytes().splitlines(keepends=True) if b'"clock"' not in line)
    )
    with pytest.raises(RecordingError, match="neither synchronisations nor beacons"):
        merge(path, [journal])


def test_locked_recording_is_rejected(short: MissionResult, tmp_path: Path) -> None:
    """While the master writes it, merging to another output is possible."""
    path = recording(short, tmp_path / "r.jsonl")
    with RecordingWriter(path):
        with pytest.raises(RecordingError, match="another program is writing it"):
            merge(path, journals(short))
        assert merge(path, journals(short), output=tmp_path / "o.jsonl").added > 0


def test_damaged_lines(short: MissionResult, tmp_path: Path) -> None:
    """An error, or skipped and reported with keep_going; the other lines are merged."""
    path, journal = recording(short, tmp_path / "r.jsonl"), tmp_path / "j.jsonl"
    lines = journals(short)[0].read_bytes().splitlines(keepends=True)
    journal.write_bytes(
        b"".join([*lines[:5], b"rubbish\n", b'{"type":"measurement"}\n', *lines[5:], b'{"ty'])
    )
    with pytest.raises(CorruptLineError, match="line 6"):
        merge(path, [journal])
    problems: list[RecordingError] = []
    merged = merge(path, [journal], keep_going=True, on_problem=problems.append)
    assert [problem.line for problem in problems] == [6, 7, len(lines) + 3]
    assert merged.added > 0
    assert dataclasses.replace(merged.journals[0], path=path) == dataclasses.replace(
        merge(recording(short, path), journals(short)[:1]).journals[0], path=path
    )
