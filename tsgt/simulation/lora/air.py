"""The shared radio channel: frames on the air, and which receivers receive them.

Problem: whether a packet is received depends on when the receiver started to listen, on noise, and on everything
transmitted at the same time, including later transmissions. Idea: a receiver decides about a frame at three instants
only. At the fifth preamble symbol that it receives, it may lock. At the end of the header, it knows whether preamble
and header were above noise and interference; if not, it searches for the next preamble. At the end of the frame, it
knows the same about the payload. While locked, it ignores other frames, except that a stronger preamble takes over
from a preamble.

Random draws depend on seed, sender, frame and receiver only, so that an additional radio changes nothing for others.
The model and its limits: docs/explanation/simulated-radio.md.
"""

from __future__ import annotations

import math
from collections import Counter
from functools import partial
from hashlib import shake_128
from typing import TYPE_CHECKING, NamedTuple

from tsgt.simulation.lora import link
from tsgt.simulation.lora.frames import Header, Reception
from tsgt.simulation.lora.interference import CO_CHANNEL_BANDWIDTHS, is_above_interference, required_sir_db
from tsgt.simulation.lora.link import uniform_draws

if TYPE_CHECKING:
    import numpy as np

    from tsgt.simulation.kernel import Timeline
    from tsgt.simulation.lora.frames import Frame, FrameListener, Modulation, ReceiverSettings
    from tsgt.simulation.lora.link import LinkModel

DETECTION_SYMBOLS = 5
"""Preamble symbols that a receiver needs to lock; the last of them must be free of interference."""

PREAMBLE_MARGIN_SYMBOLS = 4
"""How much longer than the receiver's setting a preamble may be; drivers with 8 and 10 symbols are compatible."""

# Noise bandwidth of a radio that does not listen.
_IDLE_BANDWIDTH_HZ = 125_000.0


class _PreambleSearch:
    """One search for preambles; scheduled events compare its identity to detect that they are outdated."""

    def __init__(self, listening: ReceiverSettings, since_ns: int) -> None:
        self.listening = listening
        self.since_ns = since_ns


class _FrameLock:
    """A frame that a receiver is locked to, and its decoded header."""

    def __init__(self, on_air: FrameOnAir, arrival: Arrival, listening: ReceiverSettings) -> None:
        frame = on_air.frame
        self.on_air = on_air
        self.arrival = arrival
        self.listening = listening
        if frame.modulation.explicit_header:
            self.header = frame.header
            self.read_times_ns = frame.header_end_ns
        else:
            self.header = Header(listening.payload_bytes, listening.coding_rate, listening.crc)
            self.read_times_ns = frame.preamble_end_ns
        # The receiver stays locked until the end that it expects, even if the frame is cut.
        self.end_ns = frame.end_by_header_ns(self.header, low_data_rate=listening.modulation.low_data_rate)

    @property
    def readable(self) -> bool:
        """Whether the receiver's settings match the coding of the payload."""
        frame, header = self.on_air.frame, self.header
        return (
            self.listening.modulation.low_data_rate == frame.modulation.low_data_rate
            and header.coding_rate == frame.coding_rate
            and header.payload_bytes <= len(frame.payload)
        )


class Transceiver:
    """A radio's port to the channel, and the state of its receiver."""

    def __init__(self, air: Air, listener: FrameListener, name: str, crystal_ppm: float) -> None:
        self.name = name
        self.carrier_factor = 1 + crystal_ppm * 1e-6
        self._air = air
        self._listener = listener
        self._lock: _FrameLock | None = None
        self._search: _PreambleSearch | None = None
        self._sending: FrameOnAir | None = None

    def is_locked_to(self, on_air: FrameOnAir) -> bool:
        """Whether the receiver is locked to this frame."""
        return self._lock is not None and self._lock.on_air is on_air

    def transmit(self, frame: Frame) -> None:
        """Transmit a frame; a frame still on the air is cut at its start."""
        self.stop_transmitting(frame.start_ns)
        self._sending = self._air.send(self, frame)

    def stop_transmitting(self, at_ns: int) -> None:
        """Cut the frame on the air."""
        if self._sending is not None:
            self._sending.end_ns = min(self._sending.end_ns, max(at_ns, self._sending.frame.start_ns))
            self._sending = None

    def listen(self, listening: ReceiverSettings | None) -> None:
        """Restart the receiver with these settings, or stop it."""
        self._lock = None
        self._search = None
        if listening is not None:
            self._start_search(_PreambleSearch(listening, listening.since_ns))

    def rssi_dbm(self, at_ns: int) -> float:
        """Return the power of noise and of all frames within the receiver's bandwidth."""
        if self._search is None:
            return self._air.link.noise_dbm(_IDLE_BANDWIDTH_HZ)
        tuned = self._search.listening.modulation
        power_mw = 10 ** (self._air.link.noise_dbm(tuned.bandwidth_hz) / 10)
        for on_air in self._other_frames():
            if on_air.frame.start_ns <= at_ns < on_air.end_ns and (
                required_sir_db(tuned, on_air.frame.modulation) is not None
            ):
                power_mw += self._air.arrival(on_air, self).power_mw
        return 10 * math.log10(power_mw)

    def preamble_present(self, modulation: Modulation, at_ns: int) -> bool:
        """Whether the symbol that ends now was part of a detectable preamble."""
        threshold_db = link.detection_threshold_db(modulation.spreading_factor)
        return any(
            on_air.frame.start_ns + on_air.frame.symbol_ns <= at_ns <= on_air.frame.preamble_end_ns
            and at_ns <= on_air.end_ns
            and self._same_chirps(on_air, modulation)
            and self._air.arrival(on_air, self).snr_db >= threshold_db
            for on_air in self._other_frames()
        )

    def schedule_detection(self, on_air: FrameOnAir) -> None:
        """Schedule the detection of a frame by the current preamble search, if it matches."""
        search = self._search
        if search is None or not self._matches(on_air, search.listening):
            return
        frame = on_air.frame
        received_from_ns = max(frame.start_ns, search.since_ns)
        received_ns = frame.programmed_preamble_end_ns - received_from_ns
        max_symbols = search.listening.preamble_symbols + PREAMBLE_MARGIN_SYMBOLS
        if DETECTION_SYMBOLS * frame.symbol_ns <= received_ns <= max_symbols * frame.symbol_ns:
            at_ns = received_from_ns + DETECTION_SYMBOLS * frame.symbol_ns
            self._air.timeline.call_at(at_ns, partial(self._detect, search, on_air, at_ns))

    def _start_search(self, search: _PreambleSearch) -> None:
        self._search = search
        for on_air in self._other_frames():
            self.schedule_detection(on_air)

    def _detect(self, search: _PreambleSearch, on_air: FrameOnAir, at_ns: int) -> None:
        if search is not self._search or on_air.end_ns < at_ns:
            return
        arrival = self._air.arrival(on_air, self)
        if self._lock is not None and (
            on_air.frame.start_ns >= self._lock.on_air.frame.preamble_end_ns
            or arrival.power_mw <= self._lock.arrival.power_mw
        ):
            return
        spreading_factor = on_air.frame.modulation.spreading_factor
        if arrival.loss < self._air.link.loss_probability or (
            arrival.detection > link.detection_probability(arrival.snr_db, spreading_factor)
        ):
            return
        if not self._is_interference_free(on_air, arrival, at_ns, at_ns + 1):
            # The interferer may end before the preamble does.
            next_ns = at_ns + on_air.frame.symbol_ns
            if next_ns <= on_air.frame.programmed_preamble_end_ns:
                self._air.timeline.call_at(next_ns, partial(self._detect, search, on_air, next_ns))
            return
        takes_over = self._lock is not None
        self._lock = lock = _FrameLock(on_air, arrival, search.listening)
        self._air.timeline.call_at(lock.read_times_ns, partial(self._read_header, lock))
        if not takes_over:
            self._listener.preamble_detected(at_ns)

    def _read_header(self, lock: _FrameLock) -> None:
        if lock is not self._lock:
            return
        if not self._header_arrives(lock):
            self._resume_search(lock.read_times_ns)
            self._listener.frame_ended(lock.read_times_ns, None)
            return
        self._air.timeline.call_at(lock.end_ns, partial(self._end, lock))
        if lock.on_air.frame.modulation.explicit_header:
            self._listener.header_received(lock.read_times_ns, lock.header)

    def _header_arrives(self, lock: _FrameLock) -> bool:
        """Whether the frame is complete and free of interference until its header ends, and the header, if any, is intact."""
        on_air, arrival = lock.on_air, lock.arrival
        frame = on_air.frame
        critical_ns = frame.programmed_preamble_end_ns - DETECTION_SYMBOLS * frame.symbol_ns
        if on_air.end_ns < lock.read_times_ns or not self._is_interference_free(
            on_air, arrival, critical_ns, lock.read_times_ns
        ):
            return False
        return not frame.modulation.explicit_header or (
            lock.header.payload_bytes <= lock.listening.max_payload_bytes
            and arrival.header <= link.header_probability(arrival.snr_db, frame.modulation.spreading_factor)
        )

    def _end(self, lock: _FrameLock) -> None:
        if lock is not self._lock:
            return
        reception = self._reception(lock)
        self._resume_search(lock.end_ns)
        self._listener.frame_ended(lock.end_ns, reception)

    def _payload_arrives(self, lock: _FrameLock) -> bool:
        on_air, arrival = lock.on_air, lock.arrival
        frame = on_air.frame
        return (
            lock.readable
            and on_air.end_ns >= frame.end_ns
            and arrival.payload
            <= link.payload_probability(
                arrival.snr_db, frame.modulation.spreading_factor, frame.coding_rate, len(frame.payload)
            )
            and self._is_interference_free(on_air, arrival, lock.read_times_ns, frame.end_ns)
        )

    def _reception(self, lock: _FrameLock) -> Reception:
        frame, arrival, header = lock.on_air.frame, lock.arrival, lock.header
        whole = self._payload_arrives(lock)
        payload = frame.payload[: header.payload_bytes]
        if not whole and header.payload_bytes:
            received = payload.ljust(header.payload_bytes, b"\0")
            payload = _damaged(received, arrival.damage, from_start=not lock.readable)
        # Without a header, the receiver may expect a checksum that is missing or elsewhere.
        expected = header == frame.header
        return Reception(
            payload=payload,
            crc_ok=(whole and expected) or not header.crc,
            header=header,
            snr_db=arrival.snr_db,
            rssi_dbm=arrival.power_dbm,
            frequency_error_hz=self._frequency_error_hz(lock.on_air, lock.listening.modulation),
        )

    def _resume_search(self, at_ns: int) -> None:
        assert self._search is not None  # noqa: S101 (a lock belongs to a search)
        self._lock = None
        self._start_search(_PreambleSearch(self._search.listening, at_ns))

    def _other_frames(self) -> list[FrameOnAir]:
        return [on_air for on_air in self._air.frames if on_air.sender is not self]

    def _is_interference_free(self, wanted: FrameOnAir, arrival: Arrival, from_ns: int, to_ns: int) -> bool:
        """Whether a section of a frame, its end excluded, is above the interference."""
        needed_mw = []
        for other in self._other_frames():
            if other is wanted or other.frame.start_ns >= to_ns or other.end_ns <= from_ns:
                continue
            ratio_db = required_sir_db(wanted.frame.modulation, other.frame.modulation)
            if ratio_db is not None:
                power_mw = self._air.arrival(other, self).power_mw
                needed_mw.append((power_mw * 10 ** (ratio_db / 10), other.frame.start_ns, other.end_ns))
        return not needed_mw or is_above_interference(arrival.power_mw, needed_mw, from_ns)

    def _matches(self, on_air: FrameOnAir, listening: ReceiverSettings) -> bool:
        sent, receiver = on_air.frame.modulation, listening.modulation
        return (
            sent.sync_word == receiver.sync_word
            and sent.explicit_header == receiver.explicit_header
            and self._same_chirps(on_air, receiver)
        )

    def _same_chirps(self, on_air: FrameOnAir, receiver: Modulation) -> bool:
        sent = on_air.frame.modulation
        return (
            sent.spreading_factor == receiver.spreading_factor
            and sent.bandwidth_hz == receiver.bandwidth_hz
            and sent.inverted_iq == receiver.inverted_iq
            and abs(self._frequency_error_hz(on_air, receiver))
            <= CO_CHANNEL_BANDWIDTHS * receiver.bandwidth_hz
        )

    def _frequency_error_hz(self, on_air: FrameOnAir, receiver: Modulation) -> float:
        carrier_hz = on_air.frame.modulation.frequency_hz * on_air.sender.carrier_factor
        return carrier_hz - receiver.frequency_hz * self.carrier_factor


def _damaged(payload: bytes, draw: float, *, from_start: bool) -> bytes:
    """Replace the bytes from a random position on; the first of them is certainly wrong."""
    start = 0 if from_start else int(draw * len(payload))
    noise = bytearray(shake_128(str(draw).encode()).digest(len(payload) - start))
    noise[0] |= 1
    return payload[:start] + bytes(a ^ b for a, b in zip(payload[start:], noise, strict=True))


class Arrival(NamedTuple):
    """A frame at a receiver: its power, and uniform draws to compare with probabilities."""

    power_dbm: float
    power_mw: float
    snr_db: float
    loss: float
    detection: float
    header: float
    payload: float
    damage: float


class FrameOnAir:
    """A frame that is or was transmitted."""

    def __init__(self, frame: Frame, sender: Transceiver, number: int) -> None:
        self.frame = frame
        self.sender = sender
        self.number = number  # count of the sender's frames, this one included
        self.end_ns = frame.end_ns  # actual end; earlier than the frame's if it was cut
        self.arrivals: dict[Transceiver, Arrival] = {}


class Air:
    """A channel shared by all radios that join.

    Path loss, fading and packet loss of ``link`` may be changed at any time. ``frames`` are those on the air, and those
    that overlap a frame whose reception is undecided.
    """

    def __init__(self, timeline: Timeline, rng: np.random.Generator, link: LinkModel) -> None:
        self.timeline = timeline
        self.link = link
        self.frames: list[FrameOnAir] = []
        self.airtime_ns = 0  # total airtime of all frames
        self._seed = int(rng.integers(2**63))
        self._sent: Counter[str] = Counter()
        self._radios: dict[str, Transceiver] = {}

    def join(self, listener: FrameListener, name: str, *, crystal_ppm: float = 0.0) -> Transceiver:
        """Add a radio with a unique name in the link model and a frequency offset in 1e-6.

        Raises
        ------
        ValueError
            The name is in use.
        """
        if name in self._radios:
            raise ValueError(f"radio {name!r} has joined already; each radio needs a unique name")
        radio = self._radios[name] = Transceiver(self, listener, name, crystal_ppm)
        return radio

    def leave(self, name: str) -> None:
        """Remove a radio and cut its frame; no effect for an unknown name."""
        radio = self._radios.pop(name, None)
        if radio is not None:
            radio.listen(None)
            radio.stop_transmitting(self.timeline.now_ns())

    def send(self, sender: Transceiver, frame: Frame) -> FrameOnAir:
        """Put a frame on the air for all radios but its sender."""
        self._drop_decided_frames()
        self._sent[sender.name] += 1
        self.airtime_ns += frame.end_ns - frame.start_ns
        on_air = FrameOnAir(frame, sender, self._sent[sender.name])
        self.frames.append(on_air)
        for radio in self._radios.values():
            if radio is not sender:
                self.arrival(on_air, radio)
                radio.schedule_detection(on_air)
        return on_air

    def arrival(self, on_air: FrameOnAir, receiver: Transceiver) -> Arrival:
        """Return power and random draws of a frame at a receiver; fixed at transmission."""
        arrival = on_air.arrivals.get(receiver)
        if arrival is None:
            sender, frame = on_air.sender.name, on_air.frame
            *fading, loss, detection, header, payload, damage = uniform_draws(
                self._seed, sender, on_air.number, receiver.name
            )
            power_dbm = frame.power_dbm - self.link.loss_db(
                sender, receiver.name, frame.modulation.frequency_hz, fading
            )
            snr_db = power_dbm - self.link.noise_dbm(frame.modulation.bandwidth_hz)
            arrival = on_air.arrivals[receiver] = Arrival(
                power_dbm, 10 ** (power_dbm / 10), snr_db, loss, detection, header, payload, damage
            )
        return arrival

    def _drop_decided_frames(self) -> None:
        """Drop the frames that overlap no frame whose reception is undecided."""
        now_ns = self.timeline.now_ns()
        undecided_since_ns = min(
            (
                on_air.frame.start_ns
                for on_air in self.frames
                if on_air.end_ns > now_ns
                or any(radio.is_locked_to(on_air) for radio in self._radios.values())
            ),
            default=now_ns,
        )
        self.frames = [on_air for on_air in self.frames if on_air.end_ns > undecided_since_ns]
