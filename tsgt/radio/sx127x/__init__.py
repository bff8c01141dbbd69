"""TODO face."""

from tsgt.radio.sx127x.chip import Chip
from tsgt.radio.sx127x.driver import RadioStatistics, SX127x
from tsgt.radio.sx127x.hal import DRAGINO_HAT, Edge, EdgeCallback, Hal, Wiring, open_hal
from tsgt.radio.sx127x.register_io import RegisterAccess
from tsgt.radio.sx127x.registers import Mode, Register

__all__ = [
    "DRAGINO_HAT",
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
