"""Run in the guest: what is at the far ends of its wires. Simulated radios on one channel, and total stations.

Commands are lines written to the pipe ``/run/far_ends``:

    wiring pin|ce0      where the chip select of both radios is connected
    spi N ERRNO         transfers of radio N fail with this error (0: no longer)
    hang N, wake N      radio N ignores the bus
    silent N            radio N answers nothing at all: the kernel's transfers time out
    state               writes the counters to /run/far_ends.json

Each packet on the air is reported to the host, which so knows what was acknowledged when the power is cut.
"""

from __future__ import annotations

import asyncio
import json
import os
import struct
import sys
from contextlib import AsyncExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tsgt.config import ScenarioConfig
from tsgt.config.scenario import MotionConfig
from tsgt.simulation.instrument import PtyLine, SimulatedTotalStation
from tsgt.simulation.instrument.serial_line import Wire
from tsgt.simulation.kernel import LoopTimeline
from tsgt.simulation.lora import Air, LinkModel, LogDistanceLoss, SX1276Chip
from tsgt.simulation.world import scenario_world

if TYPE_CHECKING:
    from tsgt.config import SimulatedStation
    from tsgt.simulation.lora.air import Transceiver
    from tsgt.simulation.lora.frames import Frame, FrameListener

COMMANDS = Path("/run/far_ends")
STATE = Path("/run/far_ends.json")
REPORT = "/dev/virtio-ports/report"
ADAPTER = "/dev/virtio-ports/adapter"
TERMINAL = Path("/run/instrument.tty")
"""Of a second instrument of station 1; those of the others have its number before the suffix."""

SCENARIO = ScenarioConfig(motion=MotionConfig(speeds_mps=(0.0,), speed_weights=(1.0,)))

PLACES = {
    "client": SCENARIO.stations[0].position_m,
    "master": SCENARIO.motion.area_centre_m,
    **{f"client {each.station}": each.position_m for each in SCENARIO.stations[1:]},
}
"""Of the radios, by their number, in m."""

RESET, DIO0, NSS = 17, 4, 25  # as on the Dragino HAT
BAUD = 115_200
WORLD_S = 1200.0

# struct sx_msg of sxmock.c
MESSAGE = struct.Struct("<IIiIQ")
SPI, OUT, IN, ERROR = 1, 2, 3, 4
NO_CS = 0x40
MODE = 0x03


class Radio:
    """A chip behind one instance of the kernel module."""

    def __init__(self, number: int, chip: SX1276Chip) -> None:
        self._fd = os.open(f"/dev/sxmock{number}", os.O_RDWR | os.O_NONBLOCK)
        self.chip = chip
        self.by_pin = True
        self.error = 0
        self.silent = False
        self._nss_low = False
        self.counts = {"transfers": 0, "unselected": 0, "edges": 0}
        chip.on_dio(0, self._on_dio0)
        asyncio.get_running_loop().add_reader(self._fd, self._serve)

    def _on_dio0(self, _at_ns: int, level: bool) -> None:  # noqa: FBT001 (a level)
        self.counts["edges"] += level
        os.write(self._fd, MESSAGE.pack(IN, DIO0, level, 0, 0))

    def _serve(self) -> None:
        try:
            data = os.read(self._fd, 1 << 17)
        except BlockingIOError:
            return
        kind, argument, value, _, _ = MESSAGE.unpack_from(data)
        if kind == OUT:
            if argument == RESET:
                self.chip.set_reset(value == 0)
            elif argument == NSS:
                self._nss_low = value == 0
            os.write(self._fd, MESSAGE.pack(OUT, argument, value, 0, 0))
        elif kind == SPI and not self.silent:
            response = self._transfer(argument & 0xFF, argument >> 8, value, data[MESSAGE.size :])
            os.write(self._fd, response)

    def _transfer(self, chip_select: int, mode: int, speed_hz: int, data: bytes) -> bytes:
        self.counts["transfers"] += 1
        if self.error:
            return MESSAGE.pack(ERROR, 0, -self.error, 0, 0)
        selected = self._nss_low if self.by_pin else chip_select == 0 and not mode & NO_CS
        if selected and not mode & MODE:
            self.chip.set_sck(speed_hz)
            received = self.chip.transfer(data)
        else:
            self.counts["unselected"] += 1
            received = b"\xff" * len(data)
        return MESSAGE.pack(SPI, 0, 0, len(received), 0) + received


class Report:
    """Tells the host what is on the air, a JSON line each."""

    def __init__(self) -> None:
        self._fd = os.open(REPORT, os.O_WRONLY | os.O_NONBLOCK)

    def write(self, sender: str, frame: Frame) -> None:
        """Report the start of a frame."""
        line = json.dumps({"from": sender, "at_ns": frame.start_ns, "payload": frame.payload.hex()})
        os.write(self._fd, line.encode() + b"\n")


class ReportedAir(Air):
    """A channel that reports each frame."""

    report: Report

    def send(self, sender: Transceiver, frame: Frame) -> object:  # type: ignore[override]
        """Put a frame on the air."""
        self.report.write(sender.name, frame)
        return super().send(sender, frame)


class Line:
    """A cable from the total station to the FTDI adapter's far end, which has no bit rate of its own."""

    def __init__(self, instrument: SimulatedTotalStation, timeline: LoopTimeline) -> None:
        self._fd = os.open(ADAPTER, os.O_RDWR | os.O_NONBLOCK)
        self._wire = Wire(instrument, timeline, self._deliver)
        self._wire.host_baud = instrument.baud
        asyncio.get_running_loop().add_reader(self._fd, self._read)

    def _read(self) -> None:
        try:
            data = os.read(self._fd, 4096)
        except BlockingIOError:
            return
        if data:
            self._wire.send(data)

    def _deliver(self, data: bytes) -> None:
        try:
            os.write(self._fd, data)
        except OSError:
            return  # nothing is plugged in


def obey(line: str, radios: list[Radio]) -> None:
    """Carry out a command."""
    match line.split():
        case ["wiring", wiring]:
            for radio in radios:
                radio.by_pin = wiring == "pin"
        case ["spi", number, error]:
            radios[int(number)].error = int(error)
        case ["hang", number]:
            radios[int(number)].chip.hang()
        case ["silent", number, value]:
            radios[int(number)].silent = value == "1"
        case ["state"]:
            state = [radio.counts | {"warnings": radio.chip.warnings} for radio in radios]
            part = STATE.with_suffix(".part")
            part.write_text(json.dumps(state))
            part.replace(STATE)
        case _:
            print(f"unknown: {line}", file=sys.stderr, flush=True)  # noqa: T201


async def main() -> None:
    """Serve for ever."""
    loop = asyncio.get_running_loop()
    timeline = LoopTimeline(loop)
    air = ReportedAir(
        timeline, np.random.default_rng(1), LinkModel(path_loss=LogDistanceLoss(positions_m=PLACES))
    )
    air.report = Report()

    def chip(name: str) -> SX1276Chip:
        def join(listener: FrameListener) -> Transceiver:
            return air.join(listener, name)

        return SX1276Chip(timeline, join, np.random.default_rng(2))

    radios = [Radio(number, chip(name)) for number, name in enumerate(PLACES)]

    world = scenario_world(SCENARIO, WORLD_S, np.random.default_rng(3))

    def instrument(station: SimulatedStation) -> SimulatedTotalStation:
        rng, now_ns = np.random.default_rng(4 + station.station), timeline.now_ns()
        return SimulatedTotalStation(station, SCENARIO, world, timeline, rng, start_ns=now_ns)

    first, *others = SCENARIO.stations
    Line(instrument(first), timeline)
    os.mkfifo(COMMANDS)
    commands = os.open(COMMANDS, os.O_RDWR | os.O_NONBLOCK)  # open for writing as well: it never ends

    def read_commands() -> None:
        for line in os.read(commands, 4096).decode().splitlines():
            obey(line, radios)

    loop.add_reader(commands, read_commands)
    terminals = {TERMINAL: first} | {TERMINAL.with_suffix(f".{each.station}.tty"): each for each in others}
    async with AsyncExitStack() as stack:
        for path, station in terminals.items():
            await stack.enter_async_context(PtyLine(instrument(station), path))
            os.chmod(path, 0o666)  # noqa: PTH101, S103 (no waiting; the service is another user)
        print("ready", flush=True)  # noqa: T201
        await asyncio.Event().wait()


if __name__ == "__main__":
    COMMANDS.unlink(missing_ok=True)
    asyncio.run(main())
