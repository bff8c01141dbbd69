"""Simulated LoRa radios: SX1276 chips at register level on a shared channel.

In: SPI transfers and pin levels from the real driver. Out: register contents, interrupts, receptions with RSSI and SNR.
`Air` is the channel (within one process; `AirServer` and `AirClient` across processes), `LinkModel` its path loss, fading
and packet loss, `radio_opener` the real driver on a simulated chip. The model: docs/explanation/simulated-radio.md.
"""

from tsgt.simulation.lora.air import Air
from tsgt.simulation.lora.air_client import AirClient
from tsgt.simulation.lora.air_server import AirServer
from tsgt.simulation.lora.chip import SX1276Chip
from tsgt.simulation.lora.hal import SimulatedHal
from tsgt.simulation.lora.link import LinkModel, LogDistanceLoss, scenario_link
from tsgt.simulation.lora.radios import (
    HostDelay,
    RadioHardware,
    TimestampJitter,
    radio_opener,
    simulated_radio,
)

__all__ = [
    "Air",
    "AirClient",
    "AirServer",
    "HostDelay",
    "LinkModel",
    "LogDistanceLoss",
    "RadioHardware",
    "SX1276Chip",
    "SimulatedHal",
    "TimestampJitter",
    "radio_opener",
    "scenario_link",
    "simulated_radio",
]
