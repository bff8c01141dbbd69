"""Radios without chips: an antenna that writes down what it is told, frames and listeners in one line."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tsgt.simulation.kernel import VirtualTimeline
from tsgt.simulation.lora import Air, LinkModel
from tsgt.simulation.lora.frames import Frame, Header, ReceiverSettings, Modulation, Reception
from tsgt.simulation.lora.link import FixedLoss

if TYPE_CHECKING:
    from tsgt.simulation.lora.frames import AirPort

PAPER = Modulation(
    frequency_hz=905e6,
    spreading_factor=9,
    bandwidth_hz=250_000,
    inverted_iq=False,
    sync_word=0x34,
    explicit_header=True,
    low_data_rate=False,
)
"""The modulation of the paper: a symbol lasts 2.048 ms."""

SYMBOL_NS = 2_048_000


def frame(start_symbols: float = 0.0, **changes: Any) -> Frame:
    """Make a frame of the paper's modulation; ``modulation`` takes a Modulation."""
    settings: dict[str, Any] = {
        "modulation": PAPER,
        "coding_rate": 6,
        "crc": True,
        "preamble_symbols": 8,
        "payload": b"a measurement of thirty-four bytes",
        "power_dbm": 14.0,
        "start_ns": round(start_symbols * SYMBOL_NS),
    }
    return Frame(**(settings | changes))


def listening(since_symbols: float = 0.0, **changes: Any) -> ReceiverSettings:
    """Make a receiver's settings that match :func:`frame`."""
    settings: dict[str, Any] = {
        "modulation": PAPER,
        "since_ns": round(since_symbols * SYMBOL_NS),
        "preamble_symbols": 8,
        "max_payload_bytes": 255,
        "payload_bytes": 34,
        "coding_rate": 6,
        "crc": True,
    }
    return ReceiverSettings(**(settings | changes))


def modulation(**changes: Any) -> Modulation:
    """Make the paper's modulation with changes."""
    return replace(PAPER, **changes)


class RecordingListener:
    """Writes down what the air tells."""

    def __init__(self) -> None:
        self.events: list[tuple[int, str]] = []
        self.headers: list[Header] = []
        self.receptions: list[Reception] = []

    def preamble_detected(self, at_ns: int) -> None:
        """Write it down."""
        self.events.append((at_ns, "preamble"))

    def header_received(self, at_ns: int, header: Header) -> None:
        """Write it down."""
        self.events.append((at_ns, "header"))
        self.headers.append(header)

    def frame_ended(self, at_ns: int, reception: Reception | None) -> None:
        """Write it down."""
        if reception is None:
            self.events.append((at_ns, "lost"))
            return
        self.events.append((at_ns, "received" if reception.crc_ok else "damaged"))
        self.receptions.append(reception)

    @property
    def outcomes(self) -> list[str]:
        """How it ended with each frame that it was locked to: received, damaged, lost."""
        return [what for _, what in self.events if what in {"received", "damaged", "lost"}]


class Scene:
    """One receiver ``rx`` and senders that appear when they are named."""

    def __init__(self, link: LinkModel | None = None, seed: int = 0) -> None:
        self.timeline = VirtualTimeline()
        self.link = link or LinkModel()
        self.air = Air(self.timeline, np.random.default_rng(seed), self.link)
        self.antenna = RecordingListener()
        self.rx = self.air.join(self.antenna, "rx")
        self._senders: dict[str, AirPort] = {}

    def sender(self, name: str, *, crystal_ppm: float = 0.0) -> AirPort:
        """Return the sender of that name."""
        if name not in self._senders:
            self._senders[name] = self.air.join(RecordingListener(), name, crystal_ppm=crystal_ppm)
        return self._senders[name]

    def send(self, sent: Frame, name: str = "tx") -> Frame:
        """Let a sender send, at the frame's start."""
        self.timeline.advance_to(sent.start_ns)
        self.sender(name).transmit(sent)
        return sent

    def at(self, symbols: float) -> None:
        """Let time pass until so many of the paper's symbols after the start."""
        self.timeline.advance_to(round(symbols * SYMBOL_NS))

    def finish(self) -> list[str]:
        """Let everything end; return how it ended with each frame that the receiver was locked to."""
        while (next_ns := self.timeline.next_ns()) is not None:
            self.timeline.advance_to(next_ns)
        return self.antenna.outcomes


def link_with_snr(snr_db: float) -> LinkModel:
    """Make a link at which a frame of 14 dBm in 250 kHz arrives with that SNR."""
    return LinkModel(path_loss=FixedLoss(default_db=14.0 - snr_db - LinkModel().noise_dbm(250_000)))
