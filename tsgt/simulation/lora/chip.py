"""A simulated SX1276 (RFM95, Dragino HAT) at register level: SPI bus, pins, modes.

It exchanges bytes within an NSS window as the real chip does, so that drivers for real chips run unchanged
(docs/explanation/simulated-radio.md). Not simulated: FSK transmission and reception, frequency hopping, the analogue side (LNA
gain, ramp, over-current trim and intermediate frequency have no effect), edges of DIO4 PllLock and DIO5 ModeReady
(their levels are right), ClkOut.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import structlog

from tsgt.radio.sx127x import Mode, Register
from tsgt.radio.sx127x import registers as reg
from tsgt.simulation.lora import modem
from tsgt.simulation.lora.chip_memory import (
    FIFO_BYTES,
    FIRST_AFTER_PAGED,
    FIRST_PAGED,
    READ_ONLY,
    REG_IMAGE_CAL,
    REGISTERS,
    ChipMemory,
)
from tsgt.simulation.lora.modem import ChipTiming, Modem

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from tsgt.simulation.kernel import Timeline
    from tsgt.simulation.lora.frames import AirPort, FrameListener

log = structlog.get_logger()

MAX_SCK_HZ = 10_000_000
MIN_RESET_NS = 100_000
BOOT_NS = 5_000_000
"""From the end of a reset until the chip may be used (data sheet 7.2.2)."""

# Flag on each DIO, by the two bits of its mapping (data sheet table 18). DIO0 with 11 is not documented;
# programs in the field depend on it.
_FHSS = int(reg.Irq.FHSS_CHANGE_CHANNEL)
_DIO_FLAGS = (
    (modem.RX_DONE, modem.TX_DONE, modem.CAD_DONE, modem.RX_DONE | modem.TX_DONE),
    (modem.RX_TIMEOUT, _FHSS, modem.CAD_DETECTED, 0),
    (_FHSS, _FHSS, _FHSS, 0),
    (modem.CAD_DONE, modem.VALID_HEADER, modem.PAYLOAD_CRC_ERROR, 0),
    (modem.CAD_DETECTED, 0, 0, 0),
    (0, 0, 0, 0),
)

IMAGE_CAL_BUSY = 0x60
"""RegImageCal: start of a calibration, calibration running."""

FAST_HOP_ON = 0x80
"""RegPllHop: a new carrier frequency takes effect at once."""

# Writable bits of RegOpMode: the modulation type in FSK mode, AccessSharedReg in LoRa mode.
_FSK_MODE_BITS = 0x6F
_LORA_MODE_BITS = 0x4F


class SX1276Chip:
    """One chip, powered on and out of reset; ``join`` connects it to a channel, ``rng`` draws the interrupt jitter."""

    def __init__(
        self,
        timeline: Timeline,
        join: Callable[[FrameListener], AirPort],
        rng: np.random.Generator,
        *,
        timing: ChipTiming | None = None,
    ) -> None:
        self.warnings: list[str] = []  # violations of the data sheet by the driver, each kind once
        self._timeline = timeline
        self._timing = timing or ChipTiming()
        self._memory = ChipMemory()
        self._modem = Modem(
            timeline,
            join,
            rng,
            self._memory,
            report=self._on_modem_event,
            warn=self._warn,
            timing=self._timing,
        )
        self._measured: dict[int, Callable[[], int]] = {
            Register.RSSI_VALUE: self._modem.rssi_register,
            Register.RSSI_WIDEBAND: self._modem.random_byte,
        }
        self._address: int | None = None  # of the next data byte; None before the address byte
        self._writing = False
        self._selected = False
        self._dead_bus_level: int | None = None
        self._hung = False
        self._reset_since_ns: int | None = None
        self._booted_ns = timeline.now_ns()
        self._oscillator_ns = timeline.now_ns()
        self._pll_locked_ns = timeline.now_ns()
        self._fsk_page = True
        self._booting = False
        self._pin_callbacks: dict[int, list[Callable[[int, bool], None]]] = {}
        self._levels: dict[int, bool] = {}
        self._writers: list[Callable[[int], None] | None] = [None] * 0x80
        for address in READ_ONLY:
            self._writers[address] = _ignore
        for address in (Register.FRF_MSB, Register.FRF_MID, Register.FRF_LSB):
            self._writers[address] = partial(self._write_frf, address)
        for address in (Register.IRQ_FLAGS_MASK, Register.DIO_MAPPING_1, Register.DIO_MAPPING_2):
            self._writers[address] = partial(self._write_and_update_pins, address)
        self._writers[Register.OP_MODE] = self._write_op_mode
        self._writers[Register.IRQ_FLAGS] = self._clear_flags

    # --- the SPI bus ----------------------------------------------------------------------------------------------

    def select(self) -> None:
        """NSS falls: an access begins."""
        self._selected = True
        self._address = None
        if self._booting:
            self._booting = self._timeline.now_ns() < self._booted_ns
            if self._booting:
                self._warn("SPI access within 5 ms after the end of a reset")

    def deselect(self) -> None:
        """NSS rises: the access ends."""
        self._selected = False

    def exchange(self, byte: int) -> int:
        """Shift in one byte on MOSI and return the byte on MISO: the register's previous content."""
        if not self._selected or self._reset_since_ns is not None:
            return 0x00
        if self._dead_bus_level is not None:
            return self._dead_bus_level
        address = self._address
        if address is None:
            self._writing = byte >= reg.WRITE
            self._address = byte & ~reg.WRITE
            return 0x00
        if address == Register.FIFO:
            return self._exchange_fifo(byte)
        self._address = (address + 1) & 0x7F
        value = self._read(address)
        if self._writing and not self._hung:
            self._write(address, byte)
        return value

    def transfer(self, data: bytes) -> bytes:
        """Exchange bytes in one NSS window."""
        if not self._booting and self._is_plain_access(data):
            return self._transfer_plain(data)
        self.select()
        response = bytes(map(self.exchange, data))
        self.deselect()
        return response

    def set_sck(self, frequency_hz: int) -> None:
        """Set the bus clock; warns above 10 MHz."""
        if frequency_hz > MAX_SCK_HZ:
            self._warn("SCK faster than 10 MHz")

    # --- the pins -------------------------------------------------------------------------------------------------

    def set_reset(self, low: bool) -> None:  # noqa: FBT001 (a level)
        """Pull NRESET low, which holds the chip in reset, or release it."""
        now_ns = self._timeline.now_ns()
        if low and self._reset_since_ns is None:
            self._reset_since_ns = now_ns
            self.power_on_reset()
        elif not low and self._reset_since_ns is not None:
            if now_ns - self._reset_since_ns < MIN_RESET_NS:
                self._warn("NRESET low for less than 100 us")
            self._reset_since_ns = None
            self._booted_ns = now_ns + BOOT_NS
            self._booting = True

    def dio(self, n: int) -> bool:
        """Return the level of DIO0 to DIO5."""
        lora = self._memory.lora
        if not lora[Register.OP_MODE] & reg.LONG_RANGE_MODE or self._reset_since_ns is not None:
            return False
        mapping = lora[Register.DIO_MAPPING_1 + n // 4] >> (6 - 2 * (n % 4)) & 3
        if n == 4 and mapping in (1, 2):
            in_use = lora[Register.OP_MODE] & reg.MODE_MASK > Mode.STDBY
            return in_use and self._timeline.now_ns() >= self._pll_locked_ns
        if n == 5 and mapping == 0:
            return self._timeline.now_ns() >= self._pll_locked_ns
        return bool(_DIO_FLAGS[n][mapping] & lora[Register.IRQ_FLAGS] & ~lora[Register.IRQ_FLAGS_MASK])

    def on_dio(self, n: int, callback: Callable[[int, bool], None]) -> None:
        """Call back with time and new level whenever DIO ``n`` changes."""
        self._pin_callbacks.setdefault(n, []).append(callback)
        self._levels[n] = self.dio(n)

    # --- faults ---------------------------------------------------------------------------------------------------

    def disconnect_bus(self, level: bool) -> None:  # noqa: FBT001 (a level)
        """Ignore the bus as if NSS or power were disconnected: MISO is constantly 0x00 or 0xFF."""
        self._dead_bus_level = 0xFF if level else 0x00

    def reconnect_bus(self) -> None:
        """End :meth:`disconnect_bus`."""
        self._dead_bus_level = None

    def hang(self) -> None:
        """Freeze: no transmission, reception or register write until a reset by pin."""
        self._modem.stop()
        self._hung = True

    def drop_tx_done(self, count: int = 1) -> None:
        """Suppress TxDone of the next ``count`` transmissions; the chip stays in TX."""
        self._modem.tx_done_to_drop = count

    def power_on_reset(self) -> None:
        """Reset to power-on values, as after a supply dip."""
        self._modem.stop()
        self._memory.reset()
        self._hung = False
        self._fsk_page = True
        self._update_pins(self._timeline.now_ns())

    # --- registers ------------------------------------------------------------------------------------------------

    def _read(self, address: int) -> int:
        if self._fsk_page and FIRST_PAGED <= address < FIRST_AFTER_PAGED:
            return self._memory.fsk[address]
        measured = self._measured.get(address)
        return self._memory.lora[address] if measured is None else measured()

    def _write(self, address: int, value: int) -> None:
        if self._fsk_page and FIRST_PAGED <= address < FIRST_AFTER_PAGED:
            if address == REG_IMAGE_CAL:
                value &= ~IMAGE_CAL_BUSY  # completes immediately
            self._memory.fsk[address] = value
            return
        writer = self._writers[address]
        if writer is None:
            self._memory.lora[address] = value
        else:
            writer(value)

    def _is_plain_access(self, data: bytes) -> bool:
        """Whether :meth:`_transfer_plain` may serve an access: to the LoRa page of a working chip, not beyond its end."""
        return bool(data) and not (
            self._fsk_page
            or self._hung
            or self._reset_since_ns is not None
            or self._dead_bus_level is not None
            or (data[0] & ~reg.WRITE) + len(data) > REGISTERS
        )

    def _transfer_plain(self, data: bytes) -> bytes:
        """Do in one step what :meth:`exchange` does byte by byte."""
        address, count = data[0] & ~reg.WRITE, len(data) - 1
        if address == Register.FIFO:
            return b"\0" + self._access_fifo(count, data[1:] if data[0] >= reg.WRITE else None)
        if data[0] >= reg.WRITE:
            before = bytearray(1)
            for register, byte in enumerate(data[1:], address):
                before.append(self._read(register))
                self._write(register, byte)
            return bytes(before)
        end = address + count
        if address > Register.RSSI_WIDEBAND or end <= Register.RSSI_VALUE:
            return b"\0" + self._memory.lora[address:end]
        response = bytearray(1) + self._memory.lora[address:end]
        for register, measured in self._measured.items():
            if address <= register < end:
                response[1 + register - address] = measured()
        return bytes(response)

    def _exchange_fifo(self, byte: int) -> int:
        return self._access_fifo(1, bytes([byte]) if self._writing else None)[0]

    def _access_fifo(self, count: int, written: bytes | None) -> bytes:
        """Read or write at RegFifoAddrPtr and advance it; return the previous content."""
        lora = self._memory.lora
        op_mode = lora[Register.OP_MODE]
        if not op_mode & reg.LONG_RANGE_MODE or not op_mode & reg.MODE_MASK:
            self._warn("FIFO access in SLEEP or FSK mode")
            return bytes(count)
        pointer = lora[Register.FIFO_ADDR_PTR]
        before = self._memory.read_fifo(pointer, count)
        if not self._hung:
            if written is not None:
                self._memory.write_fifo(pointer, written)
            lora[Register.FIFO_ADDR_PTR] = (pointer + count) % FIFO_BYTES
        return before

    def _write_op_mode(self, value: int) -> None:
        """Change mode; LongRangeMode changes in SLEEP only (data sheet table 41, RegOpMode)."""
        old = self._memory.lora[Register.OP_MODE]
        lora_mode = (old if old & reg.MODE_MASK else value) & reg.LONG_RANGE_MODE
        new = lora_mode | value & (_LORA_MODE_BITS if lora_mode else _FSK_MODE_BITS)
        self._memory.lora[Register.OP_MODE] = new
        self._fsk_page = not lora_mode or bool(new & reg.ACCESS_SHARED_REG)
        if (old ^ new) & (reg.LONG_RANGE_MODE | reg.MODE_MASK):
            self._enter(Mode(new & reg.MODE_MASK), Mode(old & reg.MODE_MASK), in_lora=bool(lora_mode))
            self._update_pins(self._timeline.now_ns())

    def _enter(self, mode: Mode, before: Mode, *, in_lora: bool) -> None:
        self._modem.stop()
        now_ns = self._timeline.now_ns()
        if before == Mode.SLEEP:
            self._oscillator_ns = now_ns + self._timing.oscillator_ns
        self._pll_locked_ns = max(now_ns, self._oscillator_ns)
        if mode == Mode.SLEEP:
            self._memory.sleep()
        elif mode != Mode.STDBY:
            if before not in (Mode.FSTX, Mode.FSRX):
                self._pll_locked_ns += self._timing.pll_ns
            if in_lora:
                self._modem.start(mode, self._pll_locked_ns)
            else:
                self._warn("sending and receiving in FSK mode is not simulated")

    def _write_frf(self, address: int, value: int) -> None:
        """Write the carrier frequency, which takes effect with the last of its three bytes."""
        lora = self._memory.lora
        lora[address] = value
        mode = lora[Register.OP_MODE] & reg.MODE_MASK
        fast_hop = lora[Register.PLL_HOP] & FAST_HOP_ON
        if mode > Mode.STDBY and not fast_hop:
            self._warn("RegFrf written outside SLEEP and STDBY")
        if address == Register.FRF_LSB:
            self._memory.latch_frf()
            if fast_hop:
                self._modem.retune()

    def _clear_flags(self, value: int) -> None:
        self._write_and_update_pins(Register.IRQ_FLAGS, self._memory.lora[Register.IRQ_FLAGS] & ~value)

    def _write_and_update_pins(self, address: int, value: int) -> None:
        self._memory.lora[address] = value
        self._update_pins(self._timeline.now_ns())

    def _on_modem_event(self, flags: int, at_ns: int, *, standby: bool) -> None:
        """Set the flags that are not masked; ``standby``: the modem has entered STDBY."""
        lora = self._memory.lora
        lora[Register.IRQ_FLAGS] |= flags & ~lora[Register.IRQ_FLAGS_MASK]
        if standby:
            lora[Register.OP_MODE] = lora[Register.OP_MODE] & ~reg.MODE_MASK | Mode.STDBY
        self._update_pins(at_ns)

    def _update_pins(self, at_ns: int) -> None:
        for n, callbacks in self._pin_callbacks.items():
            level = self.dio(n)
            if level != self._levels[n]:
                self._levels[n] = level
                for callback in callbacks:
                    callback(at_ns, level)

    def _warn(self, misuse: str) -> None:
        if misuse not in self.warnings:
            self.warnings.append(misuse)
            log.warning("simulated_chip_misused", misuse=misuse)


def _ignore(_: int) -> None:
    """Ignore a write to a read-only register."""
