"""The register accesses of the authors' C++ node, reimplemented from a list of them.

Unlike other drivers, it leaves the low-frequency bit set at 905 MHz, maps DIO0 to 11, polls that pin instead of the flags,
reads the FIFO byte by byte, and never leaves reception between packets.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from harness.hardware.blocking import BlockingProgram

    from tsgt.simulation.lora import SX1276Chip

TRANSFER_S = 50e-6
"""Two bytes at 500 kHz plus the system call."""

POLL_S = 1e-3

SLEEP, STDBY, TX, RXCONTINUOUS = 0x00, 0x01, 0x03, 0x05
ALL_DIO_11 = 0xF0
RX_DONE, CRC_ERROR = 0x40, 0x20


class CppNode:
    """A node's radio; the spreading factor is 8 since February 2021, 9 before."""

    def __init__(self, program: BlockingProgram, chip: SX1276Chip, *, spreading_factor: int) -> None:
        self._program = program
        self._chip = chip
        self._spreading_factor = spreading_factor

    def start(self) -> None:
        """Reset, identify and set up the chip."""
        assert self._version_after(reset_low=True) != 0x22, "an SX1272, whose reset works the other way round"
        assert self._version_after(reset_low=False) == 0x12
        self._mode(SLEEP)
        self._write(0x01, 0x88)
        for address, value in zip((0x06, 0x07, 0x08), (0xE2, 0x40, 0x00), strict=True):
            self._write(address, value)
        slow = self._spreading_factor >= 11
        self._write(0x39, 0x34)
        self._write(0x26, 0x0C if slow else 0x04)
        self._write(0x1D, 0x84)
        self._write(0x1E, self._spreading_factor << 4 | 0x04)
        self._write(0x1F, 0x05 if self._spreading_factor >= 10 else 0x08)
        self._write(0x23, 0xFF)
        self._write(0x22, 0x40)
        self._write(0x24, 0x00)
        self._write(0x0D, self._read(0x0F))
        self._write(0x0C, 0x23)
        self._mode(STDBY)
        self._write(0x0A, 0x08)
        self._write(0x09, 0x8F)
        self._write(0x4D, self._read(0x4D) | 0x07)
        self._write(0x0B, 0x3B)

    def send(self, payload: bytes, timeout_s: float = 1.0) -> bool:
        """Send; return whether DIO0 rose in time. TxDone stays set."""
        self._mode(STDBY)
        self._write(0x40, ALL_DIO_11)
        self._write(0x12, 0xFF)
        self._write(0x0E, 0x00)
        self._write(0x0D, 0x00)
        self._write(0x22, len(payload))
        self._program.sleep(TRANSFER_S * (1 + len(payload)) / 2)
        self._chip.transfer(b"\x80" + payload)
        self._mode(TX)
        return self._wait_for_dio0(timeout_s)

    def listen(self) -> None:
        """Enter reception."""
        self._write(0x12, 0xFF)
        self._write(0x40, ALL_DIO_11)
        self._mode(RXCONTINUOUS)

    def receive(self, timeout_s: float = 1.0) -> bytes | None:
        """Return the next packet; None after the timeout, or if its CRC is wrong."""
        if not self._wait_for_dio0(timeout_s):
            return None
        flags = self._read(0x12)
        self._write(0x12, RX_DONE)
        if flags & CRC_ERROR:
            self._write(0x12, CRC_ERROR)
            return None
        start, length = self._read(0x10), self._read(0x13)
        self._write(0x0D, start)
        return bytes(self._read(0x00) for _ in range(length))

    def _version_after(self, *, reset_low: bool) -> int:
        """Set NRESET to one level, then to the other, and read the version."""
        for low in (not reset_low, reset_low):
            self._chip.set_reset(low)
            self._program.sleep(0.1)
        return self._read(0x42)

    def _mode(self, mode: int) -> None:
        self._write(0x01, self._read(0x01) & ~0x07 | mode)

    def _wait_for_dio0(self, timeout_s: float) -> bool:
        for _ in range(round(timeout_s / POLL_S)):
            if self._chip.dio(0):
                return True
            self._program.sleep(POLL_S)
        return False

    def _read(self, address: int) -> int:
        self._program.sleep(TRANSFER_S)
        return self._chip.transfer(bytes([address, 0x00]))[1]

    def _write(self, address: int, value: int) -> None:
        self._program.sleep(TRANSFER_S)
        self._chip.transfer(bytes([0x80 | address, value]))
