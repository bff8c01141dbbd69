"""Wheel odometry by the way in of the IMU: times, values, restarts."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import pytest
from harness.instruments.bridge import FakeStart

from tsgt.clock import UnixTimeline
from tsgt.config import OdometryConfig
from tsgt.imu import WheelOdometry, decode_odometry_line
from tsgt.imu.odometry import OdometrySampler
from tsgt.imu.odometry_lines import OdometryHelloLine, OdometryLine
from tsgt.simulation.kernel import VirtualClock, run_virtual

HELLO = {"type": "hello", "odometry": 1, "make": "Acme", "rate_hz": 20.0}
START_NS = 50 * 10**9
MS = 1_000_000


def samples(first: int, **changes: Any) -> dict[str, Any]:
    """Return a line of two samples at 20 Hz."""
    numbers = [first, first + 1]
    line: dict[str, Any] = {
        "type": "samples",
        "counter": numbers,
        "instrument_time_ns": [n * 50_000_000 for n in numbers],
        "distance_m": [0.05, 0.06],
        "valid": [True, False],
    }
    return {name: value for name, value in (line | changes).items() if value is not None}


def test_distances_become_speeds_with_times() -> None:
    """The master divides by the duration; lost samples are counted; the loss of the program is an event."""
    records: list[Any] = []
    events: list[str] = []

    async def main() -> None:
        clock = VirtualClock(START_NS)
        start = FakeStart(clock, HELLO)
        odometry = WheelOdometry(
            OdometryConfig(command=("odometry-program",)),
            clock,
            UnixTimeline(10**18),
            on_samples=records.append,
            on_event=lambda event, _: events.append(event),
            start=start,
        )
        task = asyncio.create_task(odometry.run())
        await asyncio.sleep(0.01)
        for number in range(0, 40, 2):
            await asyncio.sleep(0.1)
            if number != 30:
                start.programs[-1].print_lines(samples(number))
        await asyncio.sleep(1.4)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    run_virtual(main)
    speeds = [speed for record in records for speed in record.speed_mps]
    assert speeds == pytest.approx([1.0, 1.2] * (len(speeds) // 2))
    stamps = [stamp for record in records for stamp in record.stamp_ns]
    assert len(stamps) == 38
    durations = [duration for record in records for duration in record.duration_ns]
    assert durations == pytest.approx([50_000_000] * 38, abs=10)
    assert records[-1].sequence + len(records[-1].stamp_ns) == 40
    assert records[0].valid[:2] == (True, False)
    assert records[0].yaw_rate_radps is None
    assert events == ["odometry_lost"]


def test_distance_is_that_of_the_wheels_whatever_the_clock_of_the_device() -> None:
    """A clock that is 3 % fast makes the device's seconds shorter, not the way."""
    sampler = OdometrySampler(0)
    sampler.program_started(OdometryHelloLine(odometry=1, make="x", rate_hz=20.0))
    records = [
        record
        for number in range(1, 400)
        for record in sampler.push(
            OdometryLine(instrument_time_ns=(round(number * 51.5 * MS),), distance_m=(0.05,)),
            START_NS + number * 50 * MS,
        )
    ]
    assert records[-1].duration_ns[0] == pytest.approx(50 * MS, rel=1e-4)
    assert records[-1].speed_mps[0] == pytest.approx(1.0, rel=1e-4)


def test_slow_counter_without_a_clock_is_not_restarted() -> None:
    """Its clock is fitted after two seconds, which are as long as the program may be without a usable sample."""
    records: list[Any] = []
    starts: list[int] = []

    async def main() -> None:
        clock = VirtualClock(START_NS)
        start = FakeStart(clock, HELLO | {"rate_hz": 10.0})
        odometry = WheelOdometry(
            OdometryConfig(command=("odometry-program",)),
            clock,
            UnixTimeline(10**18),
            on_samples=records.append,
            on_event=lambda _event, _message: None,
            start=start,
        )
        task = asyncio.create_task(odometry.run())
        await asyncio.sleep(0.01)
        for number in range(50):
            await asyncio.sleep(0.1)
            start.programs[-1].print_lines({"type": "samples", "counter": [number], "speed_mps": [0.0]})
        starts.append(len(start.programs))
        assert odometry.status().rate_hz == pytest.approx(10.0, abs=0.3)
        assert odometry.status().problem == ""
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    run_virtual(main)
    assert starts == [1]
    assert sum(len(record.stamp_ns) for record in records) == 50


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"counter": None, "instrument_time_ns": None}, "no time"),
        ({"speed_mps": [1.0, 1.0]}, "either speed_mps or distance_m"),
        ({"distance_m": None, "speed_mps": [80.0, 1.0]}, "expected m/s"),
        ({"yaw_rate_radps": [40.0, 1.0]}, "expected rad/s"),
        ({"valid": [True]}, "different lengths"),
    ],
)
def test_lines_that_leave_something_open_are_rejected(changes: dict[str, Any], words: str) -> None:
    """The message says what."""
    with pytest.raises(ValueError, match=words):
        decode_odometry_line(json.dumps(samples(0, **changes)).encode())
