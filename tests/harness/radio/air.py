"""Radios without chips: a listener that logs events; short constructors of frames and receivers."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tsgt.simulation.kernel import VirtualTimeline
from tsgt.simulation.lora import Air, LinkModel
from tsgt.simulation.lora.frames import Frame, Header, Modulation, ReceiverSettings, Reception
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
    """Return a frame with the paper's modulation and changes."""
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
    """Return receiver settings that match :func:`frame`, with changes."""
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
    """Return the paper's modulation with changes."""
    return replace(PAPER, **changes)


class RecordingListener:
    """Logs the events of a receiver."""

    def __init__(self) -> None:
        self.events: list[tuple[int, str]] = []
        self.headers: list[Header] = []
        self.receptions: list[Reception] = []

    def preamble_detected(self, at_ns: int) -> None:
        """Log it."""
        self.events.append((at_ns, "preamble"))

    def header_received(self, at_ns: int, header: Header) -> None:
        """Log it."""
        self.events.append((at_ns, "header"))
        self.headers.append(header)

    def frame_ended(self, at_ns: int, reception: Reception | None) -> None:
        """Log it."""
        if reception is None:
            self.events.append((at_ns, "lost"))
            return
        self.events.append((at_ns, "received" if reception.crc_ok else "damaged"))
        self.receptions.append(reception)

    @property
    def outcomes(self) -> list[str]:
        """The outcome of each frame that it was locked to: received, damaged, lost."""
        return [what for _, what in self.events if what in {"received", "damaged", "lost"}]


class Scene:
    """One receiver ``rx``, and senders that join when they are named."""

    def __init__(self, link: LinkModel | None = None, seed: int = 0) -> None:
        self.timeline = VirtualTimeline()
        self.link = link or LinkModel()
        self.air = Air(self.timeline, np.random.default_rng(seed), self.link)
        self.listener = RecordingListener()
        self.rx = self.air.join(self.listener, "rx")
        self._senders: dict[str, AirPort] = {}

    def sender(self, name: str, *, crystal_ppm: float = 0.0) -> AirPort:
        """Return the sender of that name."""
        if name not in self._senders:
            self._senders[name] = self.air.join(RecordingListener(), name, crystal_ppm=crystal_ppm)
        return self._senders[name]

    def send(self, sent: Frame, name: str = "tx") -> Frame:
        """Send a frame at its start."""
        self.timeline.advance_to(sent.start_ns)
        self.sender(name).transmit(sent)
        return sent

    def at(self, symbols: float) -> None:
        """Let time pass until a number of the paper's symbols after the start."""
        self.timeline.advance_to(round(symbols * SYMBOL_NS))

    def finish(self) -> list[str]:
        """Run to the end; return the outcome of each frame that the receiver was locked to."""
        while (next_ns := self.timeline.next_ns()) is not None:
            self.timeline.advance_to(next_ns)
        return self.listener.outcomes


def link_with_snr(snr_db: float) -> LinkModel:
    """Return a link at which a frame of 14 dBm in 250 kHz has an SNR."""
    return LinkModel(path_loss=FixedLoss(default_db=14.0 - snr_db - LinkModel().noise_dbm(250_000)))
