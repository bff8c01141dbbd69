"""A mission of a robot with IMU and wheel odometry: the samples reach the recording and the poses, and a replay repeats them."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.missions.missions import SUPERFRAME, run_mission

from tsgt.config import ScenarioConfig, SimulatedImu
from tsgt.master.replay import replayed
from tsgt.recording import load_recording, read_lines
from tsgt.simulation.checks import check_invariants
from tsgt.simulation.checks.devices import odometry_failures
from tsgt.simulation.checks.devices.sample_events import LOSS_EVENT_S
from tsgt.simulation.faults import FaultKind

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.slow
def test_wheels_reach_recording_and_poses(tmp_path: Path) -> None:
    """Speeds are the true ones but for scale and slip, at their times; they are not on the stream; the replay is exact."""
    scenario = ScenarioConfig(imu=SimulatedImu(model="industrial"), odometry=True)
    mission = run_mission(tmp_path, scenario, duration_s=16.0, protocol=SUPERFRAME, seed=0)
    assert check_invariants(mission) == []
    (log,) = mission.master_logs
    path = log.recording()
    assert path is not None
    recording = load_recording(path, imu=True)
    assert recording.parameters.odometry is not None
    stamps_ns = np.concatenate([each.stamp_ns for each in recording.odometry])
    speeds = np.concatenate([each.speed_mps for each in recording.odometry])
    assert len(stamps_ns) > 290
    end_s = (stamps_ns - log.unix_at_zero_ns - recording.parameters.odometry.latency_ns) / 1e9
    begun_m, ended_m = (
        mission.world.pose_at(np.maximum(each, 0.0))[:, :2, 3] for each in (end_s - 0.05, end_s)
    )
    driven = np.linalg.norm(ended_m - begun_m, axis=1) / 0.05
    assert np.abs(speeds - driven)[1:].max() < 0.15 * driven.max() + 0.06
    lines = list(read_lines(path, imu=True))
    poses = [line.data for line in lines if line.type == "pose"]
    assert b'"imu":"used"' in b"".join(poses) or b'"imu":"unconfirmed"' in b"".join(poses)
    again = [line for _, some in replayed(path) for line in some]
    assert [line for line in again if line.startswith(b'{"type":"pose"')] == poses
    assert not any(line.startswith(b'{"type":"odometry"') for line in again)


@pytest.mark.slow
def test_silent_wheels_without_an_event_violate_the_invariant(tmp_path: Path) -> None:
    """Silence and return are events; a recording that lacks samples, and one without the events, are noticed."""
    scenario = ScenarioConfig(
        pipeline=ScenarioConfig().pipeline.model_copy(update={"estimator": "linear"}),
        imu=SimulatedImu(model="industrial"),
        odometry=True,
    )
    mission = run_mission(
        tmp_path,
        scenario,
        duration_s=75.0,
        protocol=SUPERFRAME,
        seed=5,
        faults=frozenset({FaultKind.ODOMETRY_SILENCE}),
    )
    assert mission.odometry is not None
    assert np.diff(mission.odometry.arrival_s).max() > LOSS_EVENT_S
    assert check_invariants(mission) == []
    (log,) = mission.master_logs
    names = [event.event for event in log.events if event.event.startswith("odometry_")]
    assert names[:2] == ["odometry_lost", "odometry_recovered"]
    log.events.clear()
    assert any("no event odometry_lost" in each for each in odometry_failures(mission))
    shifted = replace(mission.odometry, speed_mps=mission.odometry.speed_mps + 0.1)
    assert any("has not been given" in each for each in odometry_failures(replace(mission, odometry=shifted)))
