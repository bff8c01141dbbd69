"""Driver of the LoRa chips SX1276/77/78/79 (data sheet Rev 4, errata note).

In: settings, payloads, send times. Out: packets with the timestamps of the chip's interrupts. From outside in: `driver`
(asyncio, recovery), `chip` (sequences of register accesses), `register_io` (settings as register values), `registers`
(data sheet names), `hal` (SPI bus and pins of a Raspberry Pi; the simulation has its own).
"""

from tsgt.radio.sx127x.chip import Chip
from tsgt.radio.sx127x.driver import RadioStatistics, SX127x
from tsgt.radio.sx127x.hal import Edge, EdgeCallback, Hal, Wiring, open_hal
from tsgt.radio.sx127x.register_io import RegisterAccess
from tsgt.radio.sx127x.registers import Mode, Register

__all__ = [
    "Chip",
    "Edge",
    "EdgeCallback",
    "Hal",
    "Mode",
    "RadioStatistics",
    "Register",
    "RegisterAccess",
    "SX127x",
    "Wiring",
    "open_hal",
]
