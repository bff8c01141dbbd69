"""What samples show about the device."""

from __future__ import annotations

import json
from typing import Any

import pytest
from harness.inertial.imu import HELLO

from tsgt.imu.lines import HelloLine
from tsgt.imu.monitor import ImuMonitor
from tsgt.model import ImuSamples
from tsgt.recording import decode

PERIOD_NS = 5_000_000
START_NS = 10**18


def record(first: int, count: int = 10, **changes: Any) -> ImuSamples:
    """Return samples at rest; sample n ends at n * 5 ms."""
    stamps = tuple(START_NS + n * PERIOD_NS for n in range(first, first + count))
    values: dict[str, Any] = {
        "sequence": first,
        "received_ns": stamps[-1] + 1_000_000,
        "stamp_ns": stamps,
        "duration_ns": (PERIOD_NS,) * count,
        "instrument_time_ns": None,
        "angular_rate_radps": tuple((1e-6 * n, 0.0, 0.1) for n in range(first, first + count)),
        "specific_force_mps2": ((0.0, 0.0, 9.81),) * count,
    }
    return ImuSamples(**values | changes)


def monitored(*records: ImuSamples, **hello: Any) -> ImuMonitor:
    """Return a monitor that has taken records."""
    monitor = ImuMonitor()
    monitor.program_started(decode(HelloLine, json.dumps(HELLO | hello).encode()))
    for each in records:
        monitor.samples(each)
    return monitor


def problem(*records: ImuSamples, **hello: Any) -> str:
    """Return the problem at the last record."""
    return monitored(*records, **hello).problem(records[-1].received_ns)


def test_status_of_a_sound_device() -> None:
    """Rate, age, counts; no problem."""
    records = [record(n) for n in range(0, 4000, 10) if n != 2000]
    status = monitored(*records).status(records[-1].received_ns, "", 12.0)
    assert status.device == "Fake IMU"
    assert status.samples == 3990
    assert status.rate_hz == pytest.approx(199, abs=1.5)
    assert status.age_s == pytest.approx(0.001)
    assert (status.gaps, status.lost, status.saturated) == (1, 10, 0)
    assert status.problem == ""


def test_loss_is_noticed_after_a_second() -> None:
    """Not earlier; and before the first sample."""
    monitor = monitored(record(0))
    assert not monitor.lost(START_NS + 10**9)
    assert monitor.lost(START_NS + 11 * 10**8)
    assert ImuMonitor().lost(START_NS)


def test_saturation_is_counted_and_passes() -> None:
    """With the full scale that hello states; the problem is shown for 2 s."""
    limits = {"angular_rate_limit_radps": 7.85, "specific_force_limit_mps2": 157.0}
    rates = ((0.0, -7.85, 0.0), *record(0, 9).angular_rate_radps)
    forces = (*record(0, 8).specific_force_mps2, (0.0, 0.0, 157.0), (0.0, 0.0, 156.0))
    saturated = record(0, angular_rate_radps=rates, specific_force_mps2=forces)
    monitor = monitored(saturated, **limits)
    assert monitor.problem(saturated.received_ns) == "the angular rate is at the limit of the device"
    assert monitor.status(saturated.received_ns, "", None).saturated == 2
    assert monitor.problem(saturated.received_ns + 3 * 10**9) == ""
    assert problem(saturated) == ""


def test_stuck_values_are_noticed() -> None:
    """After a quarter of a second of equal values, not before."""
    same: dict[str, Any] = {"angular_rate_radps": ((0.0, 0.0, 0.1),) * 10}
    assert problem(*(record(n, **same) for n in range(0, 50, 10))) == ""
    assert problem(*(record(n, **same) for n in range(0, 60, 10))) == "it repeats the same values"


@pytest.mark.parametrize("force_mps2", [0.01, 1.0, 32.2])
def test_force_without_gravity_is_noticed(force_mps2: float) -> None:
    """Gravity removed, g, ft/s^2."""
    forces: dict[str, Any] = {"specific_force_mps2": ((0.0, 0.0, force_mps2),) * 10}
    assert "another unit, or gravity was removed" in problem(
        *(record(n, **forces) for n in range(0, 1200, 10))
    )


def test_other_rate_is_noticed() -> None:
    """A device set to 100 Hz behind a program that states 200."""
    assert "200.0 times a second, and hello promised 100" in problem(
        *(record(n) for n in range(0, 1200, 10)), rate_hz=100.0
    )
