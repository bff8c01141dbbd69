"""Missions of a robot with an IMU: its samples reach the recording, and everything else stays as it was."""

from __future__ import annotations

import copy
import itertools
import threading
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.inertial.imu_faults import Drive, confirm_once
from harness.missions.missions import SUPERFRAME, run_mission

from tsgt.config import ScenarioConfig, SimulatedImu
from tsgt.estimation import centroid_at_point
from tsgt.estimation.inertial import setup_monitor as imu_setup_monitor
from tsgt.geometry import log_so3, rotation_from_quaternion, transform_from, transform_points
from tsgt.geometry.inertial_calibration import SetupCheck
from tsgt.recording import load_recording, read_imu_samples, write_imu_shocks
from tsgt.simulation.checks import check_invariants
from tsgt.simulation.checks.devices import imu_failures
from tsgt.simulation.checks.invariants import replay_mismatches
from tsgt.simulation.imu import (
    DeviceClockJump,
    Dropout,
    Knock,
    LateBurst,
    Saturation,
    Silence,
    StuckValues,
)
from tsgt.simulation.mission import MASTER, MasterEdit
from tsgt.simulation.scenario_files import with_stations

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tsgt.simulation.imu import DeviceSamples, ImuCondition
    from tsgt.simulation.mission import Mission, MissionResult

PIPELINE = ScenarioConfig().pipeline.model_copy(update={"estimator": "linear"})
WITHOUT = ScenarioConfig(pipeline=PIPELINE)
WITH = ScenarioConfig(pipeline=PIPELINE, imu=SimulatedImu(model="industrial"))


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> MissionResult:
    """Drive for eight seconds with an IMU."""
    folder = tmp_path_factory.mktemp("mission")
    return run_mission(folder, WITH, duration_s=8.0, protocol=SUPERFRAME, seed=0)


@pytest.mark.slow
def test_recording_holds_the_samples_at_their_times(mission: MissionResult) -> None:
    """All samples are recorded unchanged; their stamps are late by the latency, to a fifth of a millisecond."""
    assert check_invariants(mission) == []
    assert mission.imu is not None
    (log,) = mission.master_logs
    path = log.recording()
    assert path is not None
    records = list(read_imu_samples(path))
    samples = mission.imu.samples
    count = sum(len(record.stamp_ns) for record in records)
    assert count > len(samples) - 20  # the last line is not complete
    rates = np.concatenate([record.angular_rate_radps for record in records])
    np.testing.assert_allclose(rates, samples.angular_rate_radps[:count], atol=1e-9)
    stamps_s = (np.concatenate([record.stamp_ns for record in records]) - log.unix_at_zero_ns) / 1e9
    late_s = stamps_s - samples.end_s[:count]
    np.testing.assert_allclose(late_s, mission.imu.truth.latency_s, atol=2e-4)
    assert load_recording(path).parameters.imu == mission.imu.parameters


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda samples: {"end_s": samples.end_s + 0.02}, "off by -20"),
        (lambda samples: {"angular_rate_radps": samples.angular_rate_radps + 1e-6}, "has not given it"),
        (lambda samples: {"device_ns": samples.device_ns + 1_000}, "has not given it"),
    ],
    ids=["time", "value", "device-clock"],
)
@pytest.mark.slow
def test_wrong_samples_violate_the_invariant(
    mission: MissionResult, change: Callable[[DeviceSamples], dict[str, Any]], found: str
) -> None:
    """A truth that differs from the recording in time or value is noticed."""
    assert mission.imu is not None
    samples = replace(mission.imu.samples, **change(mission.imu.samples))
    wrong = replace(mission, imu=replace(mission.imu, samples=samples))
    (failure,) = imu_failures(wrong)
    assert found in failure


def test_recording_without_a_line_has_no_samples(mission: MissionResult, tmp_path: Path) -> None:
    """A master that is killed at once leaves an empty file."""
    (tmp_path / "master.jsonl").touch()
    empty = copy.copy(mission.master_logs[0])
    empty.folder = tmp_path
    assert list(imu_failures(replace(mission, master_logs=[*mission.master_logs, empty]))) == []


def test_samples_missing_after_the_faults_violate_the_invariant(mission: MissionResult) -> None:
    """All that arrive from 10 s after the last fault on must be recorded."""
    assert mission.imu is not None
    ended = replace(mission, faults_end_s=-7.0)
    assert list(imu_failures(ended)) == []
    (log,) = mission.master_logs
    empty = copy.copy(log)
    empty.folder = log.folder / "empty"
    (failure,) = imu_failures(replace(ended, master_logs=[empty]))
    assert "are not recorded" in failure


@pytest.mark.slow
def test_measurements_are_those_without_an_imu_but_shaken(mission: MissionResult, tmp_path: Path) -> None:
    """Noise and times stay the same, so that distances differ by the shaking alone; but for some after an exchange more or less."""
    plain = run_mission(tmp_path, WITHOUT, duration_s=8.0, protocol=SUPERFRAME, seed=0)
    one, other = (
        {(m.station, m.sequence): m for m in run.master_logs[0].measurements} for run in (mission, plain)
    )
    both = sorted(one.keys() & other.keys())
    assert len(both) > 40
    change_m = np.array(
        [(one[key].slope_distance_m or 0.0) - (other[key].slope_distance_m or 0.0) for key in both]
    )
    usual_m = np.median(np.abs(change_m))
    assert 1e-5 < usual_m < 1e-3
    assert mission.imu is not None
    shaken, still = (run.world.prism_at(np.arange(4.0, 8.0, 0.001), 0) for run in (mission, plain))
    assert np.abs(shaken - still).max() > usual_m


@pytest.mark.parametrize("count", [1, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_mission_with_few_stations(tmp_path: Path, count: int) -> None:
    """With one or two stations, measurements and samples are recorded without a violation."""
    # The estimator `linear` needs three prisms.
    scenario = with_stations(WITH.model_copy(update={"pipeline": ScenarioConfig().pipeline}), count)
    run = run_mission(tmp_path, scenario, duration_s=4.0, protocol=SUPERFRAME, seed=0)
    assert check_invariants(run) == []
    assert {m.station for m in run.master_logs[0].measurements} == set(range(1, count + 1))
    path = run.master_logs[0].recording()
    assert path is not None
    assert sum(len(record.stamp_ns) for record in read_imu_samples(path)) > 600


@pytest.mark.slow
def test_setup_is_checked_in_the_thread_of_the_mission(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A tuple that another thread fills breaks when all objects of the process are listed, as a mission does each minute."""
    threads = []

    def check(*_: object) -> SetupCheck:
        threads.append(threading.current_thread())
        return SetupCheck()

    monkeypatch.setattr(imu_setup_monitor, "FIRST_NS", 1_000_000_000)
    monkeypatch.setattr(imu_setup_monitor, "check_recorded_setup", check)
    run_mission(tmp_path, WITH, duration_s=3.0, protocol=SUPERFRAME, seed=0)
    assert set(threads) == {threading.current_thread()}


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    """Drive for 19 s with three stations and an IMU; the trajectory with it is used from 6 s on."""
    return Drive.simulated(tmp_path_factory.mktemp("drive"), seed=6, duration_s=19.0)


CONDITIONS: dict[str, ImuCondition] = {
    "silence": Silence(8.0, 2.0),
    "stuck": StuckValues(8.0, 2.0),
    "late-burst": LateBurst(8.0, 1.5),
    "dropout": Dropout(8.0, 4.0, 0.5),
    "clock-jump": DeviceClockJump(8.0, 0.5),
    "saturation": Saturation(8.0, 4.0, 0.2, 11.0),
    "knock": Knock(8.0, (0.010, -0.012, 0.008), (0.010, 0.014, -0.010)),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", CONDITIONS)
def test_poses_survive_a_fault_of_the_imu(drive: Drive, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """No valid pose is wrong, most poses are valid (without an IMU, not all in a fast turn), and the IMU is taken back, but for one that is displaced."""
    monkeypatch.setattr(imu_setup_monitor, "FIRST_NS", 3_000_000_000)
    monkeypatch.setattr(imu_setup_monitor, "RESULT_NS", 0)
    poses = drive.poses(drive.samples([CONDITIONS[kind]]), start_check=confirm_once())
    assert not poses.wrong.any()
    live = poses.select(poses.predicted)
    uses = [str(use) for use, _ in itertools.groupby(live.imu[(live.time_s > 7.9) & (live.time_s < 18.5)])]
    reasons = {"silence": "silent", "late-burst": "silent", "stuck": "silent"}
    if kind in ("dropout", "clock-jump"):
        assert uses[0] == uses[-1] == "used"
    else:
        assert uses[:2] == ["used", reasons.get(kind, "disagrees")]
        # Nothing confirms the set-up anew here, as after a knock, and where the prisms noticed first that values were clipped.
        assert "used" not in uses[1:] if kind == "knock" else uses[-1] in ("used", "unconfirmed")
    assert live.valid[live.time_s > 6.0].mean() > 0.8


@pytest.mark.slow
def test_master_recalls_shocks_of_those_before(tmp_path: Path) -> None:
    """After a crash as after a restart by the operator; its recording says so, for a replay."""

    async def crash_and_edit(mission: Mission) -> None:
        await mission.sleep_until(4.0)
        log = mission.master_logs[-1]
        assert mission.parameters.imu is not None
        write_imu_shocks(log.folder, mission.parameters.imu, 2)
        await mission.crash(MASTER, down_s=0.5)
        await mission.sleep_until(10.0)
        await mission.edit_master(MasterEdit(pipeline={"rate_hz": 5.0}), 14.0)

    scenario = with_stations(WITH.model_copy(update={"pipeline": ScenarioConfig().pipeline}), 1)
    run = run_mission(tmp_path, scenario, script=crash_and_edit, duration_s=20.0, protocol=SUPERFRAME, seed=3)
    recorded = [load_recording(path).parameters.imu for log in run.master_logs if (path := log.recording())]
    assert [each and each.shocks_before for each in recorded] == [0, 2, 2, 2]
    assert check_invariants(run) == []


@pytest.mark.slow
def test_replay_repeats_the_checks_of_the_setup(tmp_path: Path) -> None:
    """Bit for bit, with the events on what a drive tells of the IMU."""
    scenario = WITH.model_copy(update={"pipeline": ScenarioConfig().pipeline})
    run = run_mission(tmp_path, scenario, duration_s=26.0, protocol=SUPERFRAME, seed=3)
    (log,) = run.master_logs
    path = log.recording()
    assert path is not None
    assert b"imu_setup_confirmed" in path.read_bytes()
    assert list(replay_mismatches(log)) == []


@pytest.mark.slow
@pytest.mark.parametrize(("count", "rms_m", "rms_deg"), [(3, 4.5e-3, 0.12), (2, 6e-3, 0.15)])
def test_live_poses_are_accurate(tmp_path: Path, count: int, rms_m: float, rms_deg: float) -> None:
    """At the time of sending, from half a minute after the start on, of the prisms' centroid."""
    scenario = with_stations(WITH.model_copy(update={"pipeline": ScenarioConfig().pipeline}), count)
    run = run_mission(tmp_path, scenario, duration_s=60.0, protocol=SUPERFRAME, seed=0)
    assert check_invariants(run) == []
    (log,) = run.master_logs
    poses = log.valid_poses()
    time_s = (poses.stamp_ns - log.unix_at_zero_ns) / 1e9
    rows = (poses.series == "predicted") & (time_s > 30.0) & (time_s < 60.0)
    assert np.count_nonzero(rows) > 0.99 * 20 * 30.0
    truth = run.true_poses(time_s[rows])
    rotation = rotation_from_quaternion(poses.orientation_xyzw[rows])
    estimated = transform_from(rotation, poses.position_m[rows])
    centroid_m = centroid_at_point(run.parameters)
    error_m = np.linalg.norm(
        transform_points(estimated, centroid_m) - transform_points(truth, centroid_m), axis=1
    )
    error_deg = np.degrees(np.linalg.norm(log_so3(rotation @ np.swapaxes(truth[:, :3, :3], 1, 2)), axis=1))
    figures = [
        (float(np.sqrt(np.mean(each**2))), float(np.quantile(each, 0.95))) for each in (error_m, error_deg)
    ]
    for (found, p95), limit in zip(figures, (rms_m, rms_deg), strict=True):
        assert found < limit
        assert p95 < 2 * limit
