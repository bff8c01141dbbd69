"""The supervised program, in memory on virtual time."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest
from harness.inertial.imu import HELLO, samples
from harness.instruments.bridge import FakeStart
from structlog.testing import capture_logs

from tsgt.clock import UnixTimeline
from tsgt.config import ImuConfig
from tsgt.errors import InstrumentError
from tsgt.imu import Imu
from tsgt.simulation.kernel import VirtualClock, run_virtual

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from harness.instruments.bridge import FakeProgram

    from tsgt.model import ImuSamples

START_NS = 50 * 10**9


def config(**changes: Any) -> ImuConfig:
    """Return the configuration of an IMU."""
    values: dict[str, Any] = {
        "command": ("imu-program",),
        "position_m": (0.0, 0.0, 0.0),
        "orientation_xyzw": (0.0, 0.0, 0.0, 1.0),
        "gravity_mps2": 9.81,
    }
    return ImuConfig(**values | changes)


class Bench:
    """An IMU with scripted programs."""

    def __init__(self, *first_lines: dict[str, Any] | bytes) -> None:
        self.clock = VirtualClock(START_NS)
        self.start = FakeStart(self.clock, *first_lines)
        self.records: list[ImuSamples] = []
        self.events: list[tuple[str, str]] = []
        self.imu = Imu(
            config(),
            self.clock,
            UnixTimeline(10**18),
            on_samples=self.records.append,
            on_event=lambda *event: self.events.append(event),
            start=self.start,
        )
        self.number = 0

    @property
    def program(self) -> FakeProgram:
        """The running program."""
        return self.start.programs[-1]

    async def sample(self, seconds: float, **changes: Any) -> None:
        """Print samples of the device for some time."""
        for _ in range(round(seconds * 20)):
            await asyncio.sleep(0.05)
            self.program.print_lines(samples(self.number, 10, **changes))
            self.number += 10


def on_bench(use: Callable[[Bench], Awaitable[None]], *first_lines: dict[str, Any] | bytes) -> Bench:
    """Run the IMU while it is used; return the bench."""
    benches = []

    async def main() -> None:
        bench = Bench(*first_lines)
        benches.append(bench)
        task = asyncio.create_task(bench.imu.run())
        await asyncio.sleep(0.01)
        await use(bench)
        task.cancel()
        await asyncio.wait([task])
        assert task.cancelled()

    with capture_logs():
        run_virtual(main)
    return benches[0]


def test_samples_become_records_and_status() -> None:
    """In order, with what hello states."""

    async def use(bench: Bench) -> None:
        await bench.sample(5)
        status = bench.imu.status()
        assert status.device == "Fake IMU"
        assert status.samples == 1000
        assert status.rate_hz == pytest.approx(200, abs=12)
        assert status.problem == ""

    bench = on_bench(use, HELLO)
    assert sum(len(record.stamp_ns) for record in bench.records) == 1000
    assert bench.events == []


def test_device_is_printable() -> None:
    """Whatever the program says of it: the name goes to terminals."""
    devices = []

    async def use(bench: Bench) -> None:
        devices.append(bench.imu.status().device)

    on_bench(use, {**HELLO, "make": "A\x1b[2Jcme"})
    assert devices[0]
    assert devices[0].isprintable()


def test_ended_program_is_restarted_and_its_loss_reported() -> None:
    """With the reason; recovered with the first sample of the next one."""

    async def use(bench: Bench) -> None:
        await bench.sample(2)
        bench.program.exit("exit status 1: no such device")
        await asyncio.sleep(0.5)
        assert len(bench.start.programs) == 2
        await asyncio.sleep(1.0)
        assert "no such device" in bench.imu.status().problem
        await bench.sample(2)

    bench = on_bench(use, HELLO)
    (lost, reason), (recovered, _) = bench.events
    assert (lost, recovered) == ("imu_lost", "imu_recovered")
    assert "no such device" in reason


@pytest.mark.parametrize(
    ("printed", "seconds"),
    [
        ((), 31),
        ((HELLO,), 3),
        ((HELLO, HELLO), 0.3),
        ((HELLO | {"imu": 2},), 0.3),
        ((b"\xff\n" * 6000,), 0.3),
        ((b"x" * 6_000_000,), 0.3),
    ],
    ids=["silent", "without samples", "two hellos", "other version", "too many lines", "too many bytes"],
)
def test_useless_program_is_restarted(printed: tuple[dict[str, Any] | bytes, ...], seconds: float) -> None:
    """Killed, and started again."""

    async def use(_: Bench) -> None:
        await asyncio.sleep(seconds)

    bench = on_bench(use, *printed)
    assert len(bench.start.programs) >= 2
    assert bench.start.programs[0].ended
    assert bench.records == []


def test_searching_program_is_not_restarted() -> None:
    """Status lines show that it lives, and their problem is shown."""

    async def use(bench: Bench) -> None:
        for _ in range(4):
            bench.program.print_lines({"type": "status", "problem": "no device on the bus"})
            await asyncio.sleep(20)
        assert bench.imu.status().problem == "no device on the bus"

    bench = on_bench(use)
    assert len(bench.start.programs) == 1
    assert [event for event, _ in bench.events] == ["imu_lost"]


def test_garbage_among_samples_is_skipped() -> None:
    """Banners, torn lines and lines before hello."""

    async def use(bench: Bench) -> None:
        bench.program.print_lines(samples(0, 10), b"SDK 1.2", b'{"type":"samples","counter":[1,2],')
        bench.program.print_lines(HELLO)
        await bench.sample(1)
        bench.program.print_lines(b"\x00" * 100, {"type": "weather"}, samples(0, 10, host_ns=1))
        await bench.sample(1)

    bench = on_bench(use)
    assert len(bench.start.programs) == 1
    assert sum(len(record.stamp_ns) for record in bench.records) == 400


def test_program_that_cannot_be_started_is_tried_again() -> None:
    """With the reason in status and event."""

    async def use(bench: Bench) -> None:
        async def fail(*_: object) -> FakeProgram:
            raise InstrumentError("imu-program: cannot be started; check imu.command")

        bench.imu._start = fail
        bench.program.exit()
        await asyncio.sleep(3)
        assert "check imu.command" in bench.imu.status().problem

    bench = on_bench(use, HELLO)
    assert "check imu.command" in bench.events[0][1]


def test_implausible_values_are_reported_once() -> None:
    """And that they have passed."""

    async def use(bench: Bench) -> None:
        await bench.sample(2)
        await bench.sample(1, angular_rate_radps=[[0.0, 0.0, 0.1]] * 10)
        assert bench.imu.status().problem == "it repeats the same values"
        await bench.sample(4)
        assert bench.imu.status().problem == ""

    bench = on_bench(use, HELLO)
    assert [event for event, _ in bench.events] == ["imu_implausible", "imu_plausible"]


def test_restarted_device_is_reported() -> None:
    """Its clock begins again under the running program."""

    async def use(bench: Bench) -> None:
        await bench.sample(4)
        bench.number = 0
        await bench.sample(2)

    bench = on_bench(use, HELLO)
    assert [event for event, _ in bench.events] == ["imu_clock_stepped"]
