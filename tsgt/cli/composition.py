"""Parts of the daemons, made as their configurations say."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING

from tsgt.config import (
    BridgeInstrumentConfig,
    HardwareRadioConfig,
    LeicaInstrumentConfig,
    SimulatedRadioConfig,
    SuperframeConfig,
    TcpAddress,
)
from tsgt.radio.from_config import wiring
from tsgt.radio.key_file import read_key
from tsgt.radio.sx127x import SX127x, open_hal

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator
    from pathlib import Path

    from tsgt.clock import Clock
    from tsgt.config import ClassicConfig, InstrumentConfig, RadioConfig
    from tsgt.radio import LoRaSettings, Radio, RadioOpener
    from tsgt.station import Instrument
    from tsgt.station.serial import OpenPort, Port


def make_instrument(config: InstrumentConfig, clock: Clock) -> Instrument:
    """Return the instrument of a configuration, not connected yet."""
    # Imported here: a client is small, and one without a serial port needs no package for it.
    match config:
        case LeicaInstrumentConfig():
            from tsgt.station.leica import LeicaInstrument

            return LeicaInstrument(config, instrument_line(config.port, clock), clock)
        case BridgeInstrumentConfig():
            from tsgt.station.bridge import BridgeInstrument

            return BridgeInstrument(config, clock)


def instrument_line(port: Path | TcpAddress, clock: Clock) -> OpenPort:
    """Return a function that opens the line to an instrument."""
    if isinstance(port, TcpAddress):
        from tsgt.station.serial.tcp_port import open_tcp_port

        address = port

        async def connect(_baud: int) -> Port:
            return await open_tcp_port(address, clock)

        return connect
    from tsgt.station.serial.serial_port import open_serial_port

    return partial(open_serial_port, port, clock=clock)


def radio_key(protocol: ClassicConfig | SuperframeConfig, *, owner: int | None = None) -> bytes | None:
    """Return the configured key; None without one. ``owner`` and errors as :func:`~tsgt.radio.key_file.read_key`."""
    if isinstance(protocol, SuperframeConfig) and protocol.key_file is not None:
        return read_key(protocol.key_file, owner=owner)
    return None


def radio_opener(config: RadioConfig, settings: LoRaSettings, clock: Clock) -> RadioOpener:
    """Return a function that opens the configured radio with the settings of a modem."""
    if isinstance(config, HardwareRadioConfig):
        return _hardware(config, settings, clock)
    return _simulated(config, settings, clock)


def _hardware(config: HardwareRadioConfig, settings: LoRaSettings, clock: Clock) -> RadioOpener:
    @asynccontextmanager
    async def open_radio() -> AsyncGenerator[Radio]:
        radio = SX127x(open_hal(wiring(config.wiring)), clock, allow_20_dbm=config.allow_20_dbm)
        try:
            await radio.start(settings)
            yield radio
        finally:
            await radio.close()

    return open_radio


def _simulated(config: SimulatedRadioConfig, settings: LoRaSettings, clock: Clock) -> RadioOpener:
    @asynccontextmanager
    async def open_radio() -> AsyncGenerator[Radio]:
        # Imported here, so that a daemon in the field does not load the simulation.
        import numpy as np

        from tsgt.simulation.kernel import LoopTimeline
        from tsgt.simulation.lora import AirClient, SimulatedHal, SX1276Chip

        timeline = LoopTimeline(asyncio.get_running_loop())
        async with AirClient(config.air_socket, config.name, timeline) as air:
            chip = SX1276Chip(timeline, air.join, np.random.default_rng())
            radio = SX127x(SimulatedHal(chip), clock, allow_20_dbm=config.allow_20_dbm)
            try:
                await radio.start(settings)
                # If the air server ends, the radio would receive nothing for ever without an error.
                async with asyncio.TaskGroup() as group:
                    losing = group.create_task(air.wait_disconnected())
                    yield radio
                    losing.cancel()
            except ExceptionGroup as errors:
                raise _first(errors) from None
            finally:
                await radio.close()

    return open_radio


def _first(error: Exception) -> Exception:
    return _first(error.exceptions[0]) if isinstance(error, ExceptionGroup) else error
