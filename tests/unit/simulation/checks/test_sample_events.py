"""Silences of the robot's IMU and wheels are events."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest

from tsgt.simulation.checks.devices.sample_events import missing_events

ARRIVAL_S = np.concatenate([np.arange(0.0, 20.0, 0.05), np.arange(26.0, 60.0, 0.05)])


def master_log(*events: tuple[float, str], from_s: float = 1.0, until_s: float = 60.0) -> Any:
    """Return the log of a master that ran for some time and published events at times."""
    return SimpleNamespace(
        unix_at_zero_ns=0,
        statuses=[SimpleNamespace(stamp_ns=round(1e9 * at_s)) for at_s in (from_s, until_s)],
        events=[SimpleNamespace(stamp_ns=round(1e9 * at_s), event=name) for at_s, name in events],
    )


@pytest.mark.parametrize("device", ["imu", "odometry"])
def test_silence_and_its_end_are_events(device: Literal["imu", "odometry"]) -> None:
    """In time, and of the device that was silent."""
    lost, recovered = (21.2, f"{device}_lost"), (27.0, f"{device}_recovered")
    other = {"imu": "odometry", "odometry": "imu"}[device]
    assert not list(missing_events(master_log(lost, recovered), ARRIVAL_S, device))
    assert len(list(missing_events(master_log(lost), ARRIVAL_S, device))) == 1
    assert len(list(missing_events(master_log((25.0, f"{device}_lost"), recovered), ARRIVAL_S, device))) == 1
    assert len(list(missing_events(master_log((21.2, f"{other}_lost"), recovered), ARRIVAL_S, device))) == 1


def test_master_that_did_not_run_gives_no_event() -> None:
    """It was started during the silence, or ended before the event was due."""
    assert not list(missing_events(master_log(from_s=22.0, until_s=28.0), ARRIVAL_S, "imu"))
    assert not list(missing_events(master_log(until_s=22.0), ARRIVAL_S, "imu"))


def test_short_silence_needs_no_event() -> None:
    """Lines may be late."""
    arrival_s = np.concatenate([np.arange(0.0, 20.0, 0.05), np.arange(22.0, 60.0, 0.05)])
    assert not list(missing_events(master_log(), arrival_s, "imu"))


@pytest.mark.parametrize(
    ("events", "count"),
    [
        ([(21.2, "imu_lost"), (29.3, "imu_recovered")], 0),
        ([(21.2, "imu_lost"), (26.1, "imu_recovered"), (27.3, "imu_lost"), (29.3, "imu_recovered")], 0),
        ([(21.2, "imu_lost"), (26.1, "imu_recovered")], 1),  # and was lost again
        ([(21.2, "imu_lost")], 1),
    ],
)
def test_silence_that_follows_at_once_may_be_the_same(events: list[tuple[float, str]], count: int) -> None:
    """A device that gives a few samples in between may count as lost throughout."""
    arrival_s = np.concatenate([np.arange(0.0, 20.0, 0.05), [26.0, 26.05], np.arange(29.0, 60.0, 0.05)])
    assert len(list(missing_events(master_log(*events), arrival_s, "imu"))) == count


def test_device_that_has_recovered_may_be_lost_again() -> None:
    """Its samples arrive, and are not used for a clock that was set."""
    events = [(21.2, "imu_lost"), (26.3, "imu_recovered"), (30.5, "imu_lost"), (31.5, "imu_recovered")]
    assert not list(missing_events(master_log(*events), ARRIVAL_S, "imu"))
    assert len(list(missing_events(master_log(events[0], *events[2:]), ARRIVAL_S, "imu"))) == 1
