"""LoRa modem of a simulated SX1276: transmission, reception and channel activity detection, with their timing."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Protocol

from tsgt.radio.sx127x import Mode, Register
from tsgt.radio.sx127x import registers as reg
from tsgt.simulation.lora.frames import Frame, Header, ReceiverSettings, Reception
from tsgt.simulation.lora.register_map import (
    frequency_error_registers,
    modem_settings,
    output_power_dbm,
    packet_strength_registers,
    rssi_register,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from tsgt.simulation.kernel import Handle, Timeline
    from tsgt.simulation.lora.chip_memory import ChipMemory
    from tsgt.simulation.lora.frames import AirPort, FrameListener
    from tsgt.simulation.lora.register_map import ModemSettings

# Plain integers, because combining IntFlag members is slow.
RX_TIMEOUT = int(reg.Irq.RX_TIMEOUT)
RX_DONE = int(reg.Irq.RX_DONE)
PAYLOAD_CRC_ERROR = int(reg.Irq.PAYLOAD_CRC_ERROR)
VALID_HEADER = int(reg.Irq.VALID_HEADER)
TX_DONE = int(reg.Irq.TX_DONE)
CAD_DONE = int(reg.Irq.CAD_DONE)
CAD_DETECTED = int(reg.Irq.CAD_DETECTED)

# Low five bits of RegModemStat (data sheet table 41).
_IDLE = reg.MODEM_CLEAR
_SEARCHING = reg.RX_ON_GOING
_LOCKED = _SEARCHING | reg.SIGNAL_DETECTED | reg.SIGNAL_SYNCHRONIZED
_HEADER_KNOWN = _LOCKED | reg.HEADER_INFO_VALID


@dataclass(frozen=True, slots=True, kw_only=True)
class ChipTiming:
    """Processing times of the chip.

    From the data sheet, but for the ends of frames: as measured by Semtech's LoRa Basics MAC, interpolated for other bandwidths.

    Attributes
    ----------
    oscillator_ns, pll_ns
        From SLEEP to a running oscillator; from there to a locked synthesizer.
    tx_start_ns, rx_start_ns
        From there to the start of the frame on the air; to a listening receiver.
    rx_done_symbols
        From the end of the frame to RxDone in symbols, by spreading factor.
    """

    oscillator_ns: int = 250_000
    pll_ns: int = 60_000
    tx_start_ns: int = 120_000
    rx_start_ns: int = 41_000
    tx_done_ns: int = 67_000  # from the end of the frame to TxDone
    rx_done_symbols: dict[int, float] = field(
        default_factory=lambda: {6: 0.74, 7: 0.74, 8: 0.74, 9: 0.76, 10: 0.80, 11: 0.81, 12: 0.90}
    )
    rx_timeout_ns: int = 305_000  # from the programmed number of symbols to RxTimeout
    cad_processing_symbols: float = 0.85  # processing time of channel activity detection after listening
    jitter_sigma_ns: int = 3_000  # one sigma of TxDone and RxDone


class Report(Protocol):
    """Callback of the modem to the chip."""

    def __call__(self, flags: int, at_ns: int, *, standby: bool) -> None:
        """Set flags; ``standby``: the modem has entered STDBY."""
        ...


class Modem:
    """Transmitter and receiver; the channel's frame listener.

    ``report`` is called with flags, ``warn`` with violations of the data sheet; ``rng`` draws the interrupt jitter.
    """

    def __init__(
        self,
        timeline: Timeline,
        join: Callable[[FrameListener], AirPort],
        rng: np.random.Generator,
        memory: ChipMemory,
        *,
        report: Report,
        warn: Callable[[str], None],
        timing: ChipTiming,
    ) -> None:
        self._timeline = timeline
        self._rng = rng
        self._memory = memory
        self._report = report
        self._warn = warn
        self._timing = timing
        self.tx_done_to_drop = 0
        """Number of transmissions without TxDone still to come."""
        self._settings: ModemSettings | None = None
        self._mode = Mode.STDBY
        self._pending: Handle | None = None
        self._sending: Frame | None = None
        self._listening_since_ns: int | None = None
        self._locked = False
        self._write_address = 0
        self._port = join(self)

    def start(self, mode: Mode, ready_ns: int) -> None:
        """Transmit, receive or detect activity with the current settings once the synthesizer has locked."""
        settings, problems = modem_settings(self._memory)
        for problem in problems:
            self._warn(problem)
        self._settings = settings
        self._mode = mode
        if mode in (Mode.RXCONTINUOUS, Mode.RXSINGLE):
            self._write_address = self._memory.lora[Register.FIFO_RX_BASE_ADDR]
            self._set_status(_SEARCHING)
        if settings is None:
            return  # unusable settings: idle until stopped
        if mode == Mode.TX:
            self._schedule(ready_ns + self._timing.tx_start_ns, self._send)
        elif mode == Mode.CAD:
            listening_ns = settings.symbol_ns + int(32e9 / settings.receiving.bandwidth_hz)
            self._schedule(ready_ns + self._timing.rx_start_ns + listening_ns, self._detect_activity)
        elif mode in (Mode.RXCONTINUOUS, Mode.RXSINGLE):
            self._schedule(ready_ns + self._timing.rx_start_ns, self._listen)

    def stop(self) -> None:
        """Abort the current operation without setting flags."""
        if self._pending is not None:
            self._pending.cancel()
            self._pending = None
        if self._sending is not None:
            now_ns = self._timeline.now_ns()
            if now_ns < self._sending.end_ns:
                self._port.stop_transmitting(now_ns)
            self._sending = None
        self._stop_listening()
        self._mode = Mode.STDBY
        self._set_status(_IDLE)

    def retune(self) -> None:
        """Apply a new carrier frequency during reception (FastHopOn)."""
        if self._listening_since_ns is not None:
            self._settings, _ = modem_settings(self._memory)
            self._listen(self._timeline.now_ns())

    def rssi_register(self) -> int:
        """RegRssiValue: the channel's power while receiving, otherwise the last content."""
        if self._listening_since_ns is None or self._settings is None:
            return self._memory.lora[Register.RSSI_VALUE]
        rssi_dbm = self._port.rssi_dbm(self._timeline.now_ns())
        return rssi_register(rssi_dbm, self._settings.receiving.frequency_hz)

    def random_byte(self) -> int:
        """RegRssiWideband, whose lowest bit is noise."""
        return int(self._rng.integers(256))

    def preamble_detected(self, at_ns: int) -> None:
        """Lock; RXSINGLE no longer times out."""
        if self._listening_since_ns is None or at_ns < self._listening_since_ns:
            return
        self._locked = True
        self._set_status(_LOCKED)
        if self._mode == Mode.RXSINGLE and self._pending is not None:
            self._pending.cancel()
            self._pending = None

    def header_received(self, at_ns: int, header: Header) -> None:
        """Store the header and set ValidHeader."""
        if self._locked:
            self._take_header(header)
            self._report(VALID_HEADER, at_ns, standby=False)

    def frame_ended(self, at_ns: int, reception: Reception | None) -> None:
        """Set RxDone after a delay; without a reception, resume the search, or time out in RXSINGLE."""
        if not self._locked or self._settings is None:
            return
        self._locked = False
        single = self._mode == Mode.RXSINGLE
        if single:
            self._stop_listening()
        if reception is not None:
            symbols = self._timing.rx_done_symbols[self._settings.receiving.spreading_factor]
            rx_done_ns = at_ns + round(symbols * self._settings.symbol_ns)
            self._schedule_with_jitter(rx_done_ns, partial(self._received, reception))
        elif single:
            self._report_standby(RX_TIMEOUT, at_ns)
        else:
            self._set_status(_SEARCHING)

    def _send(self, at_ns: int) -> None:
        if (settings := self._settings) is None:
            return
        lora = self._memory.lora
        frame = Frame(
            modulation=settings.sending,
            coding_rate=settings.coding_rate,
            crc=settings.crc,
            preamble_symbols=settings.preamble_symbols,
            payload=self._memory.read_fifo(lora[Register.FIFO_TX_BASE_ADDR], settings.payload_bytes),
            power_dbm=output_power_dbm(lora[Register.PA_CONFIG], lora[Register.PA_DAC]),
            start_ns=at_ns,
        )
        self._sending = frame
        self._port.transmit(frame)
        if settings.continuous:
            self._schedule(frame.end_ns, self._send)
        elif self.tx_done_to_drop > 0:
            self.tx_done_to_drop -= 1
        else:
            self._schedule_with_jitter(frame.end_ns + self._timing.tx_done_ns, self._sent)

    def _sent(self, at_ns: int) -> None:
        self._sending = None
        self._report_standby(TX_DONE, at_ns)

    def _listen(self, at_ns: int) -> None:
        if (settings := self._settings) is None:
            return
        self._listening_since_ns = at_ns
        self._locked = False
        self._port.listen(
            ReceiverSettings(
                modulation=settings.receiving,
                since_ns=at_ns,
                preamble_symbols=settings.preamble_symbols,
                max_payload_bytes=settings.max_payload_bytes,
                payload_bytes=settings.payload_bytes,
                coding_rate=settings.coding_rate,
                crc=settings.crc,
            )
        )
        if self._mode == Mode.RXSINGLE:
            waiting_ns = settings.timeout_symbols * settings.symbol_ns + self._timing.rx_timeout_ns
            self._schedule(at_ns + waiting_ns, self._on_rx_timeout)

    def _stop_listening(self) -> None:
        if self._listening_since_ns is not None:
            self._listening_since_ns = None
            self._locked = False
            self._port.listen(None)

    def _on_rx_timeout(self, at_ns: int) -> None:
        self._stop_listening()
        self._report_standby(RX_TIMEOUT, at_ns)

    def _received(self, reception: Reception, at_ns: int) -> None:
        """Store packet and registers, then set all flags of the packet at once."""
        if (settings := self._settings) is None:
            return
        memory, lora = self._memory, self._memory.lora
        length = len(reception.payload)
        lora[Register.FIFO_RX_CURRENT_ADDR] = self._write_address
        lora[Register.RX_NB_BYTES] = length
        self._write_address = memory.write_fifo(self._write_address, reception.payload)
        lora[Register.FIFO_RX_BYTE_ADDR] = (self._write_address - 1) & 0xFF
        frequency_hz = settings.receiving.frequency_hz
        lora[Register.PKT_SNR_VALUE], lora[Register.PKT_RSSI_VALUE] = packet_strength_registers(
            reception.rssi_dbm, reception.snr_db, frequency_hz
        )
        lora[Register.FEI_MSB : Register.FEI_LSB + 1] = frequency_error_registers(
            reception.frequency_error_hz, settings.receiving.bandwidth_hz
        )
        flags = RX_DONE
        if not settings.receiving.explicit_header:
            self._take_header(reception.header)
            flags |= VALID_HEADER
        if reception.crc_ok:
            memory.count(Register.RX_PACKET_CNT_VALUE_MSB)
        else:
            flags |= PAYLOAD_CRC_ERROR
        if self._mode == Mode.RXSINGLE:
            self._report_standby(flags, at_ns)
        else:
            self._set_status(_SEARCHING)
            self._report(flags, at_ns, standby=False)

    def _take_header(self, header: Header) -> None:
        lora = self._memory.lora
        self._memory.count(Register.RX_HEADER_CNT_VALUE_MSB)
        lora[Register.MODEM_STAT] = (header.coding_rate - 4) << reg.RX_CODING_RATE_SHIFT | _HEADER_KNOWN
        lora[Register.HOP_CHANNEL] = reg.CRC_ON_PAYLOAD if header.crc else 0

    def _detect_activity(self, at_ns: int) -> None:
        if (settings := self._settings) is None:
            return
        found = self._port.preamble_present(settings.receiving, at_ns)
        flags = CAD_DONE | CAD_DETECTED if found else CAD_DONE
        processing_ns = round(self._timing.cad_processing_symbols * settings.symbol_ns)
        self._schedule(at_ns + processing_ns, partial(self._report_standby, flags))

    def _report_standby(self, flags: int, at_ns: int) -> None:
        self._mode = Mode.STDBY
        self._set_status(_IDLE)
        self._report(flags, at_ns, standby=True)

    def _set_status(self, status: int) -> None:
        """Set the low bits of RegModemStat; the coding rate of the last header stays."""
        lora = self._memory.lora
        lora[Register.MODEM_STAT] = lora[Register.MODEM_STAT] & 0xE0 | status

    def _schedule_with_jitter(self, at_ns: int, action: Callable[[int], None]) -> None:
        self._schedule(at_ns + round(self._timing.jitter_sigma_ns * self._rng.standard_normal()), action)

    def _schedule(self, at_ns: int, action: Callable[[int], None]) -> None:
        """Schedule the modem's next action; it gets its nominal time, however late it is called."""
        if self._pending is not None:
            self._pending.cancel()
        self._pending = self._timeline.call_at(at_ns, partial(action, at_ns))
