"""A station's client between a simulated total station and the radio of a test's master, on virtual time."""

from __future__ import annotations

import asyncio
import random
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from harness.hardware.radios import PAPER, make_side, running_timeline

from tsgt.config import (
    ClassicConfig,
    ClientConfig,
    JournalConfig,
    LeicaInstrumentConfig,
    ScenarioConfig,
    SimulatedRadioConfig,
)
from tsgt.radio.classic import MeasurementMessage
from tsgt.radio.classic.messages import decode_reply
from tsgt.recording.journal import load_journal
from tsgt.simulation.instrument import SimulatedLine, SimulatedTotalStation
from tsgt.simulation.kernel import DriftingClock, VirtualClock
from tsgt.simulation.lora import Air, LinkModel, radio_opener
from tsgt.simulation.mission import instrument_config
from tsgt.simulation.mission.observed import ObservedInstrument
from tsgt.simulation.world import scenario_world
from tsgt.station import ClientDependencies, run_client

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator
    from pathlib import Path

    from harness.hardware.radios import Side

    from tsgt.config import ProtocolConfig
    from tsgt.model import PolarMeasurement
    from tsgt.radio import RadioOpener
    from tsgt.radio.classic.messages import Reply
    from tsgt.station import Reading

START_NS = 1_700_000_000_000_000_000
OFFSET_NS = -3_600_000_000_000
"""The station's clock is an hour behind."""

SCENARIO = ScenarioConfig(targets_m=((20.0, 5.0, 0.5), (0.5, 0.0, 0.0)))


def client_config(
    folder: Path, *, station: int = 1, prism: int = 1, protocol: ProtocolConfig | None = None
) -> ClientConfig:
    """Return a configuration, of the classic protocol by default; its instrument and radio sections are not used."""
    return ClientConfig(
        kind="client",
        station=station,
        prism=prism,
        instrument=instrument_config(SCENARIO.stations[0], folder / "instrument.tty"),
        radio=SimulatedRadioConfig(
            kind="simulated",
            air_socket=folder / "air.sock",
            name=f"station{station}",
            frequency_mhz=905.0,
            spreading_factor=9,
        ),
        protocol=protocol or ClassicConfig(kind="classic"),
        journal=JournalConfig(directory=folder / "journals"),
        status_socket=folder / "client.sock",
    )


@dataclass
class Field:
    """One station and a master's radio.

    Attributes
    ----------
    line
        The cable to the instrument.
    read
        All readings of the clients.
    protocol
        None: classic.
    """

    folder: Path
    instrument: SimulatedTotalStation
    line: SimulatedLine
    clock: DriftingClock
    master: Side
    open_radio: RadioOpener
    read: list[Reading]
    protocol: ProtocolConfig | None = None
    key: bytes | None = None
    boot: str = "boot"
    client: asyncio.Task[None] | None = None
    rng: random.Random = field(default_factory=lambda: random.Random(11))  # noqa: S311 (a test has no secrets)

    def start(self) -> None:
        """Start the client."""
        config = client_config(self.folder, protocol=self.protocol)
        assert isinstance(config.instrument, LeicaInstrumentConfig)
        instrument = ObservedInstrument(config.instrument, self.line.open, self.clock, self.read.append)
        self.client = asyncio.create_task(
            run_client(
                config,
                PAPER,
                ClientDependencies(
                    instrument=instrument,
                    open_radio=self.open_radio,
                    clock=self.clock,
                    key=self.key,
                    boot=self.boot,
                    random_bits=self.rng.getrandbits,
                ),
            )
        )

    async def measuring(self) -> None:
        """Wait for the first reading of a client that has just been started; takes two seconds."""
        before = len(self.read)
        while len(self.read) == before:  # noqa: ASYNC110 (time has to pass meanwhile)
            await asyncio.sleep(0.01)

    async def kill(self) -> None:
        """Cancel the client."""
        if self.client is not None:
            self.client.cancel()
            await asyncio.wait([self.client])
            self.client = None

    async def ask(self, payload: bytes, timeout_s: float = 0.25) -> Reply | None:
        """Send a request and return the reply; None if there is none within the timeout."""
        await self.master.radio.transmit(payload)
        with suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                return decode_reply((await self.master.radio.receive()).payload)
        return None

    async def poll(self) -> MeasurementMessage:
        """Poll a measurement, after the ping that the station requires first."""
        await self.ask(b"e1")
        reply = await self.ask(b"t1")
        assert isinstance(reply, MeasurementMessage), reply
        return reply

    def journals(self) -> list[list[PolarMeasurement]]:
        """Return the measurements of each journal, in the order of the client's starts."""
        paths = sorted((self.folder / "journals").iterdir(), key=lambda path: path.stat().st_mtime_ns)
        return [load_journal(path).measurements for path in paths]


@asynccontextmanager
async def field_day(
    folder: Path,
    scenario: ScenarioConfig = SCENARIO,
    *,
    protocol: ProtocolConfig | None = None,
    key: bytes | None = None,
) -> AsyncGenerator[Field]:
    """Set up a measuring station and a master's radio for the duration of the block."""
    timeline = running_timeline()
    rng = np.random.default_rng(7)
    air = Air(timeline, np.random.default_rng(0), LinkModel())
    clock = DriftingClock(VirtualClock(START_NS), offset_ns=OFFSET_NS, drift_ppm=10.0)
    world = scenario_world(scenario, 600.0, np.random.default_rng(3))
    master = make_side(air, "master")
    await master.radio.start(PAPER)
    instrument = SimulatedTotalStation(scenario.stations[0], scenario, world, timeline, rng)
    day = Field(
        folder=folder,
        instrument=instrument,
        line=SimulatedLine(instrument, timeline, clock),
        clock=clock,
        master=master,
        open_radio=radio_opener(air, "station1", clock, rng, PAPER),
        read=[],
        protocol=protocol,
        key=key,
    )
    try:
        day.start()
        await day.measuring()
        yield day
    finally:
        await day.kill()
        await master.radio.close()
