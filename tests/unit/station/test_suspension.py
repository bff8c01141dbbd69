"""A client whose computer was suspended: CLOCK_MONOTONIC stood still, and no time from before is used afterwards."""

from __future__ import annotations

import asyncio
import json
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np
import pytest
from harness.hardware.radios import PAPER, running_timeline
from harness.instruments.bridge import COMMANDS, HELLO, FakeStart
from harness.instruments.leica import leica_bench, leica_config
from harness.instruments.network_line import SimulatedNetwork
from harness.instruments.scripted_instrument import READING, RECORD, ScriptedInstrument
from harness.radio.client import client_config
from structlog.testing import capture_logs
from unit.station.test_control_socket import START_NS, WARM, talk

from tsgt.config import BridgeInstrumentConfig, TcpAddress
from tsgt.model import Status
from tsgt.radio import Packet
from tsgt.recording import read_lines
from tsgt.recording.journal import load_journal
from tsgt.simulation.instrument.total_station import BOOT_NS
from tsgt.simulation.kernel import DriftingClock, VirtualClock
from tsgt.station import ClientDependencies, run_client
from tsgt.station.bridge import BridgeInstrument
from tsgt.station.leica import LeicaInstrument

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator
    from pathlib import Path

    from tsgt.radio import Radio
    from tsgt.recording.journal import Journal
    from tsgt.station import Instrument, Reading


class Computer(VirtualClock):
    """A computer's clocks, and its radio, which receives what :meth:`command` sends."""

    def __init__(self) -> None:
        super().__init__(START_NS)
        self.suspended_ns = 0
        self._packets: asyncio.Queue[Packet] = asyncio.Queue()

    def suspend(self, seconds: float) -> None:
        """Let the Unix clock go on while CLOCK_MONOTONIC stands still."""
        self.suspended_ns += round(seconds * 1e9)
        self.step(round(seconds * 1e9))

    @asynccontextmanager
    async def client(self, folder: Path, instrument: Instrument) -> AsyncGenerator[None]:
        """Run a client with an instrument that is connected after two seconds."""
        dependencies = ClientDependencies(
            instrument=instrument,
            open_radio=self._open_radio,
            clock=self,
            boot="boot",
            suspended_ns=lambda: self.suspended_ns,
        )
        running = asyncio.create_task(run_client(client_config(folder), PAPER, dependencies))
        try:
            await asyncio.sleep(2.0)
            yield
        finally:
            running.cancel()
            await asyncio.wait([running])

    @asynccontextmanager
    async def _open_radio(self) -> AsyncGenerator[Radio]:
        yield cast("Radio", self)

    def command(self, payload: bytes) -> None:
        """Receive a packet from the master."""
        self._packets.put_nowait(
            Packet(
                payload=payload,
                rssi_dbm=-60.0,
                snr_db=10.0,
                received_at_ns=self.monotonic_ns(),
                stamp_sigma_ns=1000,
            )
        )

    async def receive(self) -> Packet:
        """Return the next packet."""
        return await self._packets.get()

    async def transmit(self, payload: bytes) -> None:
        """Send nothing."""


def journals(folder: Path) -> list[Journal]:
    """Return the journals of a client, the oldest first."""
    return [load_journal(path) for path in sorted((folder / "journals").iterdir())]


async def test_queued_readings_are_dropped(tmp_path: Path) -> None:
    """Those of a bridge program wait for the client; their times are of the clock before the suspension."""
    computer = Computer()
    start = FakeStart(computer, HELLO | {"commands": COMMANDS})
    instrument = BridgeInstrument(BridgeInstrumentConfig(kind="bridge", command=("b",)), computer, start)
    true_ns: dict[float | None, int] = {}
    with capture_logs() as logs:
        async with computer.client(tmp_path, instrument):
            lines = []
            for number in range(4):
                await asyncio.sleep(0.05)
                lines.append(start.programs[0].measurement(10.0 + number))
                true_ns[10.0 + number] = computer.realtime_ns()
                if number == 0:
                    start.programs[0].print_lines(lines.pop())
            held = start.programs[0].measurement(15.0)
            computer.suspend(60.0)
            start.programs[0].print_lines(*lines)
            await asyncio.sleep(2.0)
            start.programs[1].print_lines(held)  # as a library may do
            start.programs[1].measure(20.0)
            true_ns[20.0] = computer.realtime_ns()
            await asyncio.sleep(0.1)
    before, after = journals(tmp_path)
    assert before.head.boot != after.head.boot
    assert [each.slope_distance_m for each in before.measurements] == [10.0]
    assert [each.slope_distance_m for each in after.measurements] == [20.0]
    for each in (*before.measurements, *after.measurements):
        assert each.stamp_ns == true_ns[each.slope_distance_m]
    # The first one has shown that the computer was suspended.
    assert [entry["readings"] for entry in logs if entry["event"] == "readings_dropped"] == [2]


async def test_single_measurement_over_a_suspension_is_dropped(tmp_path: Path) -> None:
    """Its time may be of either clock."""
    computer = Computer()
    instrument = ScriptedInstrument(computer)
    instrument.target = READING
    async with computer.client(tmp_path, instrument):
        computer.command(b"d1")
        await asyncio.sleep(2.0)
        computer.command(b"t1")
        await asyncio.sleep(1.0)
        computer.suspend(60.0)
        await asyncio.sleep(5.0)
    assert [journal.targets for journal in journals(tmp_path)] == [[], []]


async def test_settings_after_a_suspension_are_of_the_next_journal(tmp_path: Path) -> None:
    """In the one before, their time would be too early."""
    computer = Computer()
    instrument = ScriptedInstrument(computer)
    async with computer.client(tmp_path, instrument):
        instrument.record = replace(RECORD, distance_mode="fast")
        computer.suspend(60.0)
        instrument.give()
        await asyncio.sleep(0.1)
    first, _ = sorted((tmp_path / "journals").iterdir())
    assert [
        json.loads(line.data)["distance_mode"] for line in read_lines(first) if line.type == "instrument"
    ] == [""]


async def test_requested_atmosphere_is_kept(tmp_path: Path) -> None:
    """Connecting again writes the configured one back."""
    computer = Computer()
    instrument = ScriptedInstrument(computer)
    async with computer.client(tmp_path, instrument):
        await talk(tmp_path, WARM + b"\n")
        computer.suspend(60.0)
        instrument.give()
        await asyncio.sleep(3.0)
        (status,) = await talk(tmp_path)
    assert len(journals(tmp_path)) == 2
    assert status["settings"]["temperature_c"] == 25.0


@pytest.mark.parametrize("suspended_s", [0.03, 60.0])
async def test_fit_of_the_instrument_clock_is_dropped(suspended_s: float) -> None:
    """Otherwise a short suspension would pass for the delay of a network."""
    async with leica_bench() as bench:
        clock, timeline = DriftingClock(bench.clock), running_timeline()
        network = SimulatedNetwork(bench.station, timeline, clock, np.random.default_rng(2))
        network.faults.jitter_ms = 3.0
        config = leica_config().model_copy(update={"port": TcpAddress("simulated", 1212)})
        instrument = LeicaInstrument(config, network.open, clock)

        async def measure() -> list[Reading]:
            await instrument.connect()
            await instrument.track(1)
            readings = [await instrument.read() for _ in range(30)]
            await instrument.close()
            return readings

        await measure()
        resume = clock.suspend()
        await asyncio.sleep(suspended_s)
        resume()
        instrument.host_clock_restarted()
        readings = await measure()
        truth = {each.instrument_ms: each.true_ns for each in bench.station.reported_distances}
    for reading in readings:
        assert reading.instrument_time_ns is not None
        late_ns = reading.at_ns - clock.local_ns(truth[reading.instrument_time_ns // 1_000_000])
        assert abs(late_ns) < 2 * reading.sigma_ns


async def test_instrument_that_was_switched_off_meanwhile_measures_at_once() -> None:
    """Its clock begins again, below the last distance: that is no repetition."""
    async with leica_bench() as bench:

        async def measure_after_boot(readings: int) -> int:
            bench.station.switch_off()
            bench.station.switch_on()
            await asyncio.sleep(BOOT_NS / 1e9)
            await bench.instrument.connect()
            await bench.instrument.track(1)
            await bench.read_until(Status.OK, within_s=12.0)
            for _ in range(readings):
                await bench.instrument.read()
            await bench.instrument.close()
            return bench.station.reported_distances[-1].instrument_ms

        last_ms = await measure_after_boot(100)
        bench.instrument.host_clock_restarted()
        assert await measure_after_boot(0) < last_ms
