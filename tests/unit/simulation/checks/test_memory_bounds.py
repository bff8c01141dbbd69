"""Bounds of what the daemons keep in memory."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from tsgt.estimation.inertial.setup_monitor import ImuSetupMonitor
from tsgt.simulation.checks.memory_bounds import oversized_collections


@pytest.mark.parametrize(("per_second", "oversized"), [(25, False), (40, True)])
def test_measurements_of_a_delivered_backlog_are_within_their_bound(
    per_second: int, *, oversized: bool
) -> None:
    """Three stations deliver a minute's backlog with 25 measurements a second; the monitor keeps those of 50 s."""
    parameters: Any = SimpleNamespace(prisms=(1, 2, 3), imu=None)
    monitor = ImuSetupMonitor(parameters)
    for number in range(60 * per_second):
        measurement: Any = SimpleNamespace(received_ns=number * 1_000_000_000 // per_second)
        monitor.measurement(measurement)
    assert any("_measurements" in each for each in oversized_collections()) is oversized
