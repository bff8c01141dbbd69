"""Reading and writing registers of an SX127x over its bus."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.errors import RadioError
from tsgt.radio import registers as reg

if TYPE_CHECKING:
    from tsgt.radio.hal import Hal
    from tsgt.radio.register_values import RegisterValue


class RegisterAccess:
    """Registers by address; each call is one chip-select window (section 2.2).

    All methods raise :class:`~tsgt.errors.RadioError` when the bus fails.

    Parameters
    ----------
    hal
        Bus of the chip.
    """

    def __init__(self, hal: Hal) -> None:
        self._hal = hal

    def read(self, address: int) -> int:
        """Return one register."""
        return self.read_burst(address, 1)[0]

    def read_burst(self, address: int, count: int) -> bytes:
        """Return ``count`` consecutive registers, or bytes of the FIFO, whose address stands still."""
        return self._hal.transfer(bytes([address]) + bytes(count))[1:]

    def write(self, address: int, *values: int) -> None:
        """Write consecutive registers."""
        self.write_burst(address, bytes(values))

    def write_burst(self, address: int, data: bytes) -> None:
        """Write consecutive registers, or bytes into the FIFO."""
        self._hal.transfer(bytes([reg.WRITE | address]) + data)

    def write_verified(self, register: RegisterValue) -> None:
        """Write a register and read it back.

        Raises
        ------
        RadioError
            It reads differently.
        """
        self.write(register.address, register.value)
        self.verify(register)

    def verify(self, register: RegisterValue) -> None:
        """Check that a register reads as it was written.

        Raises
        ------
        RadioError
            It does not.
        """
        actual = self.read(register.address)
        if (actual ^ register.value) & register.mask:
            raise RadioError(
                f"{register.address.name} (0x{register.address:02X}) reads 0x{actual:02X} where 0x{register.value:02X} was written: check the wiring, "
                "a lower spi_hz and the supply"
            )
