"""Sequences of register accesses that set up an SX127x, send and receive; the driver decides when."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import structlog

from tsgt.errors import RadioError, RadioNotFoundError
from tsgt.radio.sx127x import registers as reg
from tsgt.radio.sx127x.register_io import (
    RegisterAccess,
    RegisterValue,
    frf,
    op_mode,
    packet_strength,
    receive_frf,
    register_values,
)
from tsgt.radio.sx127x.registers import Irq, Mode, Register

if TYPE_CHECKING:
    from tsgt.clock import Clock
    from tsgt.radio.base import LoRaSettings
    from tsgt.radio.sx127x.hal import Hal

log = structlog.get_logger()

RESET_LOW_NS = 1_000_000  # duration of the NRESET pulse; the chip needs 0.1 ms (section 7.2.2)
RESET_WAIT_NS = 10_000_000  # pause after the reset; the chip needs 5 ms
MODE_WAIT_NS = 1_000_000  # pause between a change of mode and its check; the oscillator starts in 0.25 ms
CAD_SYMBOLS = 4  # a channel activity detection takes 1.7 to 2.3 symbols

# Plain integers: members of IntFlag are slow to combine.
_RX_DONE = int(Irq.RX_DONE)
_TX_DONE = int(Irq.TX_DONE)
_CRC_ERROR = int(Irq.PAYLOAD_CRC_ERROR)
_CAD_DONE = int(Irq.CAD_DONE)
_ABSENT = 0xFF  # an open MISO line; no state of the chip has all flags set


@dataclass(frozen=True, slots=True)
class RawPacket:
    """A packet in the chip. ``payload``: with bit errors if ``crc_error``. ``has_crc``: whether the sender added a CRC."""

    payload: bytes
    has_crc: bool
    crc_error: bool
    rssi_dbm: float
    snr_db: float


class Chip:
    """An SX127x in LoRa mode. All methods raise :class:`~tsgt.errors.RadioError` when the bus fails."""

    def __init__(self, hal: Hal, clock: Clock, settings: LoRaSettings) -> None:
        self._hal = hal
        self._clock = clock
        self._settings = settings
        self._registers = RegisterAccess(hal)
        self._probe = 0x55
        # What the supervision of a reception reads many times.
        self._receiving = self._op_mode(Mode.RXCONTINUOUS)
        self._sync_word = RegisterValue(Register.SYNC_WORD, settings.sync_word)

    async def set_up(self) -> None:
        """Reset the chip, identify it, write and verify all settings, and enter reception.

        Raises RadioNotFoundError if there is no chip, or it is not an SX1276/77/78/79. Raises RadioError if a register
        does not read back as written.
        """
        self._hal.set_reset(low=True)
        await self._pause(RESET_LOW_NS)
        self._hal.set_reset(low=False)
        await self._pause(RESET_WAIT_NS)
        self._identify()
        # LongRangeMode can only be changed in SLEEP (section 4.1.6), which is therefore entered first.
        sleep = self._op_mode(Mode.SLEEP)
        self._registers.write(Register.OP_MODE, sleep.value & ~reg.LONG_RANGE_MODE)
        await self._change_mode(Mode.SLEEP)
        await self._change_mode(Mode.STDBY)
        for register in register_values(self._settings):
            self._registers.write_verified(register)
        self.enter_reception()
        await self._pause(MODE_WAIT_NS)
        self.check_reception()

    def sleep(self) -> None:
        """Enter the mode with the lowest current."""
        self._write_mode(Mode.SLEEP)

    def enter_standby(self) -> None:
        """Stop receiving or sending; a received packet stays readable."""
        self._write_mode(Mode.STDBY)

    def enter_reception(self) -> None:
        """Clear all flags and receive continuously."""
        self.enter_standby()
        self._tune(receive_frf(self._settings))
        self._registers.write(Register.IRQ_FLAGS, reg.ALL_IRQ_FLAGS)
        self._registers.write(Register.DIO_MAPPING_1, reg.DIO0_RX_DONE)
        self._write_mode(Mode.RXCONTINUOUS)

    def check_reception(self) -> None:
        """Check that the chip receives with our settings and accepts writes.

        A receiver that fails with all its registers intact is indistinguishable from a quiet channel. Raises RadioError
        if the chip was reset, hangs, or is disconnected.
        """
        self._registers.verify(self._receiving)
        self._registers.verify(self._sync_word)
        # This pointer is unused between packets; a hung chip keeps its registers and only fails a write.
        self._probe ^= 0xFF
        self._registers.write_verified(RegisterValue(Register.FIFO_ADDR_PTR, self._probe))

    async def dio0_connected(self) -> bool:
        """Whether the DIO0 pin follows the chip; leaves it in standby.

        A channel activity detection raises DIO0 at its end (table 18), and transmits nothing. Raises RadioError if it does
        not end.
        """
        self.enter_standby()
        self._registers.write(Register.IRQ_FLAGS, reg.ALL_IRQ_FLAGS)
        self._registers.write_verified(RegisterValue(Register.DIO_MAPPING_1, reg.DIO0_CAD_DONE))
        high_before = self._hal.dio0()
        self._write_mode(Mode.CAD)
        await self._pause(CAD_SYMBOLS * self._settings.symbol_ns + MODE_WAIT_NS)
        if not self._flags() & _CAD_DONE:
            raise RadioError("the radio does not end a channel activity detection: check power and wiring")
        return self._hal.dio0() and not high_before

    def load(self, payload: bytes) -> None:
        """Clear all flags and load a packet for :meth:`send`, from standby.

        Raises RadioError if the chip did not accept it.
        """
        self._tune(frf(self._settings.frequency_hz))
        self._registers.write(Register.IRQ_FLAGS, reg.ALL_IRQ_FLAGS)
        self._registers.write_verified(RegisterValue(Register.DIO_MAPPING_1, reg.DIO0_TX_DONE))
        self._registers.write_verified(RegisterValue(Register.PAYLOAD_LENGTH, len(payload)))
        self._registers.write(Register.FIFO_ADDR_PTR, 0x00)
        self._registers.write_burst(Register.FIFO, payload)
        self._registers.verify(RegisterValue(Register.FIFO_ADDR_PTR, len(payload)))

    def send(self) -> None:
        """Send the loaded packet now; the chip then returns to standby."""
        self._write_mode(Mode.TX)

    def packet_sent(self) -> bool:
        """Whether TxDone is set."""
        return bool(self._flags() & _TX_DONE)

    def packet_received(self) -> bool:
        """Whether RxDone is set."""
        return bool(self._flags() & _RX_DONE)

    def read_packet(self) -> RawPacket | None:
        """Read the received packet, if there is one, and clear its flags."""
        first = Register.FIFO_RX_CURRENT_ADDR
        status = self._registers.read_burst(first, Register.HOP_CHANNEL - first + 1)

        def value(register: Register) -> int:
            return status[register - first]

        flags = value(Register.IRQ_FLAGS)
        if flags == _ABSENT or not flags & _RX_DONE:
            return None
        self._registers.write(Register.IRQ_FLAGS, flags)
        self._registers.write(Register.FIFO_ADDR_PTR, value(Register.FIFO_RX_CURRENT_ADDR))
        rssi_dbm, snr_db = packet_strength(
            value(Register.PKT_RSSI_VALUE),
            value(Register.PKT_SNR_VALUE),
            frequency_hz=self._settings.frequency_hz,
        )
        return RawPacket(
            payload=self._registers.read_burst(Register.FIFO, value(Register.RX_NB_BYTES)),
            has_crc=bool(value(Register.HOP_CHANNEL) & reg.CRC_ON_PAYLOAD),
            crc_error=bool(flags & _CRC_ERROR),
            rssi_dbm=rssi_dbm,
            snr_db=snr_db,
        )

    def _identify(self) -> None:
        version = self._registers.read(Register.VERSION)
        if version in {0x00, 0xFF}:
            raise RadioNotFoundError(
                f"no radio responds (RegVersion reads 0x{version:02X}): check power and wiring, the NSS pin "
                "(Dragino HAT: BCM 25), the reset pin, and that no overlay drives NSS or uses the SPI bus"
            )
        if version == reg.VERSION_SX1272:
            raise RadioNotFoundError(
                "the radio is an SX1272 or SX1273 (RegVersion reads 0x22), whose registers differ: "
                "use a module with an SX1276/77/78/79, such as an RFM95"
            )
        if version not in {reg.VERSION_SX1276, *reg.VERSIONS_LIKE_SX1276}:
            raise RadioNotFoundError(
                f"RegVersion reads 0x{version:02X}, not 0x12 as on an SX1276/77/78/79: "
                "check the module, the wiring, and a lower spi_hz"
            )
        if version != reg.VERSION_SX1276:
            log.info("radio_version_unusual", version=version)

    async def _change_mode(self, mode: Mode) -> None:
        self._write_mode(mode)
        await self._pause(MODE_WAIT_NS)
        self._registers.verify(self._op_mode(mode))

    def _op_mode(self, mode: Mode) -> RegisterValue:
        return RegisterValue(Register.OP_MODE, op_mode(self._settings, mode))

    def _write_mode(self, mode: Mode) -> None:
        self._registers.write(Register.OP_MODE, op_mode(self._settings, mode))

    def _tune(self, frequency: bytes) -> None:
        self._registers.write_burst(Register.FRF_MSB, frequency)

    def _flags(self) -> int:
        flags = self._registers.read(Register.IRQ_FLAGS)
        return 0 if flags == _ABSENT else flags

    async def _pause(self, duration_ns: int) -> None:
        await self._clock.sleep_until(self._clock.monotonic_ns() + duration_ns)
