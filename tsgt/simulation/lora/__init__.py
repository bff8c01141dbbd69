"""TODO face."""

from tsgt.simulation.lora.air import Air
from tsgt.simulation.lora.air_client import AirClient
from tsgt.simulation.lora.air_server import AirServer
from tsgt.simulation.lora.chip import SX1276Chip
from tsgt.simulation.lora.hal import SimulatedHal
from tsgt.simulation.lora.link import LinkModel, LogDistanceLoss
from tsgt.simulation.lora.radios import HostDelay, RadioHardware, StampJitter, opener, simulated_radio

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
    "StampJitter",
    "opener",
    "simulated_radio",
]
