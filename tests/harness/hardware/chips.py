"""A simulated chip on a bench: register access, and a channel controlled by the test."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from tsgt.simulation.kernel import VirtualTimeline
from tsgt.simulation.lora import SX1276Chip
from tsgt.simulation.lora.frames import Frame, Header, Reception
from tsgt.simulation.lora.modem import ChipTiming

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsgt.simulation.lora.frames import AirPort, FrameListener, Modulation, ReceiverSettings

PREAMBLE_SYMBOLS_TO_LOCK = 5
NO_JITTER = ChipTiming(jitter_sigma_ns=0)

SLEEP, STDBY, FSTX, TX, FSRX, RXCONTINUOUS, RXSINGLE, CAD = range(0x80, 0x88)
"""RegOpMode in LoRa mode."""


class FakePort:
    """Records what the chip sends, and delivers what the test sends."""

    def __init__(self, timeline: VirtualTimeline) -> None:
        self.listener: FrameListener
        self.frames: list[Frame] = []
        self.stopped_ns: list[int] = []
        self.listening: ReceiverSettings | None = None
        self.channel_dbm = -110.0
        self.preamble = False
        self._timeline = timeline

    def join(self, listener: FrameListener) -> FakePort:
        """Act as the air that the chip joins."""
        self.listener = listener
        return self

    def transmit(self, frame: Frame) -> None:
        """Record the frame."""
        self.frames.append(frame)

    def stop_transmitting(self, at_ns: int) -> None:
        """Record the time."""
        self.stopped_ns.append(at_ns)

    def listen(self, listening: ReceiverSettings | None) -> None:
        """Record the receiver settings."""
        self.listening = listening

    def rssi_dbm(self, at_ns: int) -> float:
        """Return the test's value."""
        del at_ns
        return self.channel_dbm

    def preamble_present(self, modulation: Modulation, at_ns: int) -> bool:
        """Return the test's value."""
        del modulation, at_ns
        return self.preamble

    def send(
        self,
        payload: bytes,
        *,
        crc: bool = True,
        crc_ok: bool = True,
        header_ok: bool = True,
        coding_rate: int = 5,
        snr_db: float = 8.0,
        rssi_dbm: float = -60.0,
        frequency_error_hz: float = 0.0,
    ) -> Frame:
        """Send a frame now; the chip receives it if it listens until its end."""
        assert self.listening is not None
        listening = self.listening
        frame = Frame(
            modulation=listening.modulation,
            coding_rate=coding_rate,
            crc=crc,
            preamble_symbols=8,
            payload=payload,
            power_dbm=10.0,
            start_ns=self._timeline.now_ns(),
        )
        header = Header(len(payload), coding_rate, crc)
        reception = Reception(payload, crc_ok, header, snr_db, rssi_dbm, frequency_error_hz)

        def still(action: partial[None]) -> None:
            if self.listening is listening:
                action()

        listener, explicit = self.listener, listening.modulation.explicit_header
        locked_ns = frame.start_ns + PREAMBLE_SYMBOLS_TO_LOCK * frame.symbol_ns
        events = [(locked_ns, partial(listener.preamble_detected, locked_ns))]
        if not header_ok:
            events.append((frame.header_end_ns, partial(listener.frame_ended, frame.header_end_ns, None)))
        else:
            if explicit:
                ended = partial(listener.header_received, frame.header_end_ns, header)
                events.append((frame.header_end_ns, ended))
            events.append((frame.end_ns, partial(listener.frame_ended, frame.end_ns, reception)))
        for at_ns, action in events:
            self._timeline.call_at(at_ns, partial(still, action))
        return frame


class Bench:
    """A chip after power-on, by default without timing jitter."""

    def __init__(
        self,
        timing: ChipTiming = NO_JITTER,
        *,
        timeline: VirtualTimeline | None = None,
        join: Callable[[FrameListener], AirPort] | None = None,
    ) -> None:
        self.timeline = timeline or VirtualTimeline()
        self.port = FakePort(self.timeline)
        self.chip = SX1276Chip(self.timeline, join or self.port.join, np.random.default_rng(1), timing=timing)

    def read(self, address: int) -> int:
        """Read a register."""
        return self.chip.transfer(bytes([address, 0]))[1]

    def write(self, address: int, *values: int) -> None:
        """Write consecutive registers."""
        self.chip.transfer(bytes([0x80 | address, *values]))

    def read_fifo(self, start: int, length: int) -> bytes:
        """Set the pointer and read a burst."""
        self.write(0x0D, start)
        return self.chip.transfer(bytes(length + 1))[1:]

    def write_fifo(self, start: int, data: bytes) -> None:
        """Set the pointer and write a burst."""
        self.write(0x0D, start)
        self.write(0x00, *data)

    def enter_lora(self, *, spreading_factor: int = 7, crc: bool = True) -> None:
        """Enter STDBY in LoRa mode, 125 kHz, 4/5, explicit header."""
        self.write(0x01, 0x00)
        self.write(0x01, SLEEP)
        self.write(0x01, STDBY)
        self.write(0x1E, spreading_factor << 4 | crc << 2)
        self.timeline.advance(1_000_000)

    def listen(self) -> None:
        """Enter continuous reception, and wait for it."""
        self.write(0x01, RXCONTINUOUS)
        self.timeline.advance(1_000_000)

    def receive(self, payload: bytes, *, crc: bool = True, crc_ok: bool = True, snr_db: float = 8.0) -> Frame:
        """Deliver a frame and wait for RxDone."""
        frame = self.port.send(payload, crc=crc, crc_ok=crc_ok, snr_db=snr_db)
        self.timeline.advance_to(frame.end_ns + frame.symbol_ns)
        return frame

    def transmit(self, payload: bytes, base: int = 0x80) -> Frame:
        """Send, and wait for TxDone."""
        self.write_fifo(base, payload)
        self.write(0x0E, base)
        self.write(0x22, len(payload))
        self.write(0x01, TX)
        self.timeline.advance(1_000_000)
        frame = self.port.frames[-1]
        self.timeline.advance_to(frame.end_ns + 100_000)
        return frame
