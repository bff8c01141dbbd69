"""The shared channel: every frame that is being sent, and what of it reaches whom.

Randomness hangs on seed, sender, frame and receiver alone, so that a further radio changes nothing for the others.
The model and what it leaves out: docs/explanation/simulated-radio.md.

One radio on the air: what it sends, and what its receiver makes of what the others send.

Problem: whether a packet is received depends on when the receiver began to listen, on noise, and on all that is
sent at the same time, also later than its start. Idea: a receiver decides about a frame at three instants, and
only there. At the fifth preamble symbol that it hears it may lock. At the end of the header it knows whether
preamble and header have stood above noise and interference; if not, it looks for the next preamble. At the end of
the frame it knows the same of the payload. While it follows a frame it is deaf to others, except that a preamble
that is strong enough takes over from another preamble.

How much stronger than what disturbs it a LoRa signal must be (facts: co-channel rejection, SX1276 data sheet).

Within one spreading factor the stronger signal captures the receiver. Different spreading factors are nearly
orthogonal: Croce et al. 2018, "Impact of LoRa imperfect orthogonality", as used by FLoRa.
"""

from __future__ import annotations

import math
from collections import Counter
from functools import partial
from hashlib import shake_128
from typing import TYPE_CHECKING, NamedTuple

from tsgt.radio.planning import REQUIRED_SNR_DB
from tsgt.simulation.lora import link
from tsgt.simulation.lora.frames import Header, Reception
from tsgt.simulation.lora.link import uniforms

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from tsgt.simulation.kernel import Timeline
    from tsgt.simulation.lora.frames import Antenna, Frame, Listening, Modulation
    from tsgt.simulation.lora.link import LinkModel

CAPTURE_DB = 6.0
"""A signal survives others of its own kind when it is stronger than their sum by this much."""

SAME_CHANNEL_BANDWIDTHS = 0.25
"""Carriers that differ by at most so many bandwidths demodulate each other."""

# Wanted signal's spreading factor by row, interferer's by column, 7 to 12; the diagonal is the capture.
_REJECTION_DB = (
    (CAPTURE_DB, -8, -9, -9, -9, -9),
    (-11, CAPTURE_DB, -11, -12, -13, -13),
    (-15, -13, CAPTURE_DB, -13, -14, -15),
    (-19, -18, -17, CAPTURE_DB, -17, -18),
    (-22, -22, -21, -20, CAPTURE_DB, -20),
    (-25, -25, -25, -24, -23, CAPTURE_DB),
)

# Rounding must not decide about a signal that is stronger by exactly what is needed.
_ROUNDING = 1 + 1e-9


def needed_ratio_db(wanted: Modulation, interferer: Modulation) -> float | None:
    """Ratio of signal to interferer that the wanted signal needs; None: they do not meet in the spectrum.

    Chirps that are no copies of the wanted ones (other bandwidth, inverted, beside the channel) act as noise.
    """
    apart_hz = abs(wanted.frequency_hz - interferer.frequency_hz)
    if apart_hz >= (wanted.bandwidth_hz + interferer.bandwidth_hz) / 2:
        return None
    alike = wanted.bandwidth_hz == interferer.bandwidth_hz and wanted.inverted_iq == interferer.inverted_iq
    if not alike or apart_hz > SAME_CHANNEL_BANDWIDTHS * wanted.bandwidth_hz:
        return REQUIRED_SNR_DB[wanted.spreading_factor]
    if wanted.spreading_factor == interferer.spreading_factor:
        return CAPTURE_DB
    if min(wanted.spreading_factor, interferer.spreading_factor) < 7:
        return REQUIRED_SNR_DB[wanted.spreading_factor]  # the table has no SF6
    return _REJECTION_DB[wanted.spreading_factor - 7][interferer.spreading_factor - 7]


def survives(signal_mw: float, needed_mw: Sequence[tuple[float, int, int]], from_ns: int) -> bool:
    """Whether a signal stands above the sum of its interferers at every instant of a section.

    Parameters
    ----------
    signal_mw
        Power of the wanted signal.
    needed_mw
        For each interferer that overlaps the section: the power that it alone calls for (its own power times the
        ratio needed), when it starts and when it ends.
    from_ns
        Start of the section; the sum can only grow there and where an interferer starts.
    """
    instants = [from_ns, *(start_ns for _, start_ns, _ in needed_mw if start_ns > from_ns)]
    worst_mw = max(
        sum(mw for mw, start_ns, end_ns in needed_mw if start_ns <= instant_ns < end_ns)
        for instant_ns in instants
    )
    return worst_mw <= signal_mw * _ROUNDING


DETECTION_SYMBOLS = 5
"""Preamble symbols that a receiver needs to lock; with as many left, the section begins that must be clear."""

PREAMBLE_MARGIN_SYMBOLS = 4
"""How much longer than the receiver's setting a preamble may be; drivers that mix 8 and 10 do meet."""

# The bandwidth in which a radio hears noise that is set to hear nothing.
_IDLE_BANDWIDTH_HZ = 125_000.0


class _Search:
    """One stretch of looking for preambles; its identity tells whether an event still belongs to it."""

    def __init__(self, listening: Listening, since_ns: int) -> None:
        self.listening = listening
        self.since_ns = since_ns


class _Lock:
    """A frame that a receiver follows, and what it knows of it."""

    def __init__(self, on_air: OnAir, arrival: Arrival, listening: Listening) -> None:
        frame = on_air.frame
        self.on_air = on_air
        self.arrival = arrival
        self.listening = listening
        if frame.modulation.explicit_header:
            self.header = frame.header
            self.read_ns = frame.header_end_ns
        else:
            self.header = Header(listening.payload_bytes, listening.coding_rate, listening.crc)
            self.read_ns = frame.preamble_end_ns
        # The receiver stays until the end that it expects, whatever the sender does.
        self.end_ns = frame.end_as_read_ns(self.header, low_data_rate=listening.modulation.low_data_rate)

    @property
    def readable(self) -> bool:
        """Whether the receiver splits the payload's symbols as the sender put them together."""
        frame, header = self.on_air.frame, self.header
        return (
            self.listening.modulation.low_data_rate == frame.modulation.low_data_rate
            and header.coding_rate == frame.coding_rate
            and header.payload_bytes <= len(frame.payload)
        )


class Transceiver:
    """A radio's port to the air, and the state of its receiver.

    Parameters
    ----------
    air
        Which it is on.
    antenna
        Is told what it hears.
    name
        Its name in the link model.
    crystal_ppm
        How far its carrier and its receiver lie above what they are set to.
    """

    def __init__(self, air: Air, antenna: Antenna, name: str, crystal_ppm: float) -> None:
        self.name = name
        self.carrier_factor = 1 + crystal_ppm * 1e-6
        self._air = air
        self._antenna = antenna
        self._lock: _Lock | None = None
        self._search: _Search | None = None
        self._sending: OnAir | None = None

    def follows(self, on_air: OnAir) -> bool:
        """Whether the receiver is locked to that frame."""
        return self._lock is not None and self._lock.on_air is on_air

    def transmit(self, frame: Frame) -> None:
        """Put a frame on the air; one that is still there ends where this one starts."""
        self.stop_transmitting(frame.start_ns)
        self._sending = self._air.send(self, frame)

    def stop_transmitting(self, at_ns: int) -> None:
        """Cut the frame that is on the air."""
        if self._sending is not None:
            self._sending.end_ns = min(self._sending.end_ns, max(at_ns, self._sending.frame.start_ns))
            self._sending = None

    def listen(self, listening: Listening | None) -> None:
        """Begin anew, or become deaf."""
        self._lock = None
        self._search = None
        if listening is not None:
            self._look(_Search(listening, listening.since_ns))

    def rssi_dbm(self, at_ns: int) -> float:
        """Add up noise and all that is sent within the receiver's bandwidth."""
        if self._search is None:
            return self._air.link.noise_dbm(_IDLE_BANDWIDTH_HZ)
        tuned = self._search.listening.modulation
        power_mw = 10 ** (self._air.link.noise_dbm(tuned.bandwidth_hz) / 10)
        for on_air in self._others():
            if on_air.frame.start_ns <= at_ns < on_air.end_ns and (
                needed_ratio_db(tuned, on_air.frame.modulation) is not None
            ):
                power_mw += self._air.arrival(on_air, self).power_mw
        return 10 * math.log10(power_mw)

    def preamble_present(self, modulation: Modulation, at_ns: int) -> bool:
        """Whether the symbol that ends now lay within a preamble that can be heard."""
        threshold_db = link.detection_threshold_db(modulation.spreading_factor)
        return any(
            on_air.frame.start_ns + on_air.frame.symbol_ns <= at_ns <= on_air.frame.preamble_end_ns
            and at_ns <= on_air.end_ns
            and self._same_chirps(on_air, modulation)
            and self._air.arrival(on_air, self).snr_db >= threshold_db
            for on_air in self._others()
        )

    def consider(self, on_air: OnAir) -> None:
        """See to it that the present search comes upon a frame, if it can."""
        search = self._search
        if search is None or not self._matches(on_air, search.listening):
            return
        frame = on_air.frame
        heard_from_ns = max(frame.start_ns, search.since_ns)
        heard_ns = frame.programmed_preamble_end_ns - heard_from_ns
        longest_symbols = search.listening.preamble_symbols + PREAMBLE_MARGIN_SYMBOLS
        if DETECTION_SYMBOLS * frame.symbol_ns <= heard_ns <= longest_symbols * frame.symbol_ns:
            at_ns = heard_from_ns + DETECTION_SYMBOLS * frame.symbol_ns
            self._air.timeline.call_at(at_ns, partial(self._detect, search, on_air, at_ns))

    def _look(self, search: _Search) -> None:
        self._search = search
        for on_air in self._others():
            self.consider(on_air)

    def _detect(self, search: _Search, on_air: OnAir, at_ns: int) -> None:
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
        if not self._clear(on_air, arrival, at_ns, at_ns + 1):
            # What drowns it may end before the preamble does.
            next_ns = at_ns + on_air.frame.symbol_ns
            if next_ns <= on_air.frame.programmed_preamble_end_ns:
                self._air.timeline.call_at(next_ns, partial(self._detect, search, on_air, next_ns))
            return
        takes_over = self._lock is not None
        self._lock = lock = _Lock(on_air, arrival, search.listening)
        self._air.timeline.call_at(lock.read_ns, partial(self._read_header, lock))
        if not takes_over:
            self._antenna.preamble_detected(at_ns)

    def _read_header(self, lock: _Lock) -> None:
        if lock is not self._lock:
            return
        if not self._header_arrives(lock):
            self._let_go(lock.read_ns)
            self._antenna.frame_ended(lock.read_ns, None)
            return
        self._air.timeline.call_at(lock.end_ns, partial(self._end, lock))
        if lock.on_air.frame.modulation.explicit_header:
            self._antenna.header_received(lock.read_ns, lock.header)

    def _header_arrives(self, lock: _Lock) -> bool:
        """Whether the frame is there and clear until its header ends, and the header, if any, is whole."""
        on_air, arrival = lock.on_air, lock.arrival
        frame = on_air.frame
        critical_ns = frame.programmed_preamble_end_ns - DETECTION_SYMBOLS * frame.symbol_ns
        if on_air.end_ns < lock.read_ns or not self._clear(on_air, arrival, critical_ns, lock.read_ns):
            return False
        return not frame.modulation.explicit_header or (
            lock.header.payload_bytes <= lock.listening.max_payload_bytes
            and arrival.header <= link.header_probability(arrival.snr_db, frame.modulation.spreading_factor)
        )

    def _end(self, lock: _Lock) -> None:
        if lock is not self._lock:
            return
        reception = self._reception(lock)
        self._let_go(lock.end_ns)
        self._antenna.frame_ended(lock.end_ns, reception)

    def _payload_arrives(self, lock: _Lock) -> bool:
        on_air, arrival = lock.on_air, lock.arrival
        frame = on_air.frame
        return (
            lock.readable
            and on_air.end_ns >= frame.end_ns
            and arrival.payload
            <= link.payload_probability(
                arrival.snr_db, frame.modulation.spreading_factor, frame.coding_rate, len(frame.payload)
            )
            and self._clear(on_air, arrival, lock.read_ns, frame.end_ns)
        )

    def _reception(self, lock: _Lock) -> Reception:
        frame, arrival, header = lock.on_air.frame, lock.arrival, lock.header
        whole = self._payload_arrives(lock)
        payload = frame.payload[: header.payload_bytes]
        if not whole and header.payload_bytes:
            received = payload.ljust(header.payload_bytes, b"\0")
            payload = _damaged(received, arrival.damage, from_start=not lock.readable)
        # Without a header to tell, the checksum may be missing or stand elsewhere than where it is looked for.
        expected = header == frame.header
        return Reception(
            payload=payload,
            crc_ok=(whole and expected) or not header.crc,
            header=header,
            snr_db=arrival.snr_db,
            rssi_dbm=arrival.power_dbm,
            frequency_error_hz=self._frequency_error_hz(lock.on_air, lock.listening.modulation),
        )

    def _let_go(self, at_ns: int) -> None:
        assert self._search is not None  # noqa: S101 (a lock belongs to a search)
        self._lock = None
        self._look(_Search(self._search.listening, at_ns))

    def _others(self) -> list[OnAir]:
        return [on_air for on_air in self._air.frames if on_air.sender is not self]

    def _clear(self, wanted: OnAir, arrival: Arrival, from_ns: int, to_ns: int) -> bool:
        """Whether a frame stands above all others in a section of it, its end excluded."""
        needed_mw = []
        for other in self._others():
            if other is wanted or other.frame.start_ns >= to_ns or other.end_ns <= from_ns:
                continue
            ratio_db = needed_ratio_db(wanted.frame.modulation, other.frame.modulation)
            if ratio_db is not None:
                power_mw = self._air.arrival(other, self).power_mw
                needed_mw.append((power_mw * 10 ** (ratio_db / 10), other.frame.start_ns, other.end_ns))
        return not needed_mw or survives(arrival.power_mw, needed_mw, from_ns)

    def _matches(self, on_air: OnAir, listening: Listening) -> bool:
        sent, heard = on_air.frame.modulation, listening.modulation
        return (
            sent.sync_word == heard.sync_word
            and sent.explicit_header == heard.explicit_header
            and self._same_chirps(on_air, heard)
        )

    def _same_chirps(self, on_air: OnAir, heard: Modulation) -> bool:
        sent = on_air.frame.modulation
        return (
            sent.spreading_factor == heard.spreading_factor
            and sent.bandwidth_hz == heard.bandwidth_hz
            and sent.inverted_iq == heard.inverted_iq
            and abs(self._frequency_error_hz(on_air, heard)) <= SAME_CHANNEL_BANDWIDTHS * heard.bandwidth_hz
        )

    def _frequency_error_hz(self, on_air: OnAir, heard: Modulation) -> float:
        carrier_hz = on_air.frame.modulation.frequency_hz * on_air.sender.carrier_factor
        return carrier_hz - heard.frequency_hz * self.carrier_factor


def _damaged(payload: bytes, draw: float, *, from_start: bool) -> bytes:
    """Replace the bytes from some place on; the first of them is surely wrong."""
    start = 0 if from_start else int(draw * len(payload))
    noise = bytearray(shake_128(str(draw).encode()).digest(len(payload) - start))
    noise[0] |= 1
    return payload[:start] + bytes(a ^ b for a, b in zip(payload[start:], noise, strict=True))


class Arrival(NamedTuple):
    """A frame at a receiver: its power, and uniform numbers to hold against probabilities."""

    power_dbm: float
    power_mw: float
    snr_db: float
    loss: float
    detection: float
    header: float
    payload: float
    damage: float


class OnAir:
    """A frame that is being sent or was.

    Attributes
    ----------
    frame
        As it was meant to be sent.
    sender
        Who sends it.
    number
        How many frames this sender has sent, with this one.
    end_ns
        When it really ends, which is earlier than the frame says if it was cut.
    arrivals
        What of it reaches whom.
    """

    def __init__(self, frame: Frame, sender: Transceiver, number: int) -> None:
        self.frame = frame
        self.sender = sender
        self.number = number
        self.end_ns = frame.end_ns
        self.arrivals: dict[Transceiver, Arrival] = {}


class Air:
    """One channel that all who join share.

    Parameters
    ----------
    timeline
        Where its time passes.
    rng
        Gives the seed, one number.
    link
        Powers, losses and fading; may be changed while the air is in use.

    Attributes
    ----------
    frames
        Those on the air, and those that overlapped one whose reception is not decided yet.
    airtime_ns
        Of all frames together, in ns.
    """

    def __init__(self, timeline: Timeline, rng: np.random.Generator, link: LinkModel) -> None:
        self.timeline = timeline
        self.link = link
        self.frames: list[OnAir] = []
        self.airtime_ns = 0
        self._seed = int(rng.integers(2**63))
        self._sent: Counter[str] = Counter()
        self._radios: dict[str, Transceiver] = {}

    def join(self, antenna: Antenna, name: str, *, crystal_ppm: float = 0.0) -> Transceiver:
        """Add a radio.

        Parameters
        ----------
        antenna
            Is told what the radio hears.
        name
            Its name in the link model; each radio has its own.
        crystal_ppm
            How far its carrier and its receiver lie above what they are set to.

        Raises
        ------
        ValueError
            There is a radio of that name.
        """
        if name in self._radios:
            raise ValueError(f"there is a radio {name!r} on the air already; each needs its own name")
        radio = self._radios[name] = Transceiver(self, antenna, name, crystal_ppm)
        return radio

    def leave(self, name: str) -> None:
        """Take a radio away and cut off what it is sending; nothing happens if there is none of that name."""
        radio = self._radios.pop(name, None)
        if radio is not None:
            radio.listen(None)
            radio.stop_transmitting(self.timeline.now_ns())

    def send(self, sender: Transceiver, frame: Frame) -> OnAir:
        """Put a frame on the air, for all but its sender."""
        self._forget()
        self._sent[sender.name] += 1
        self.airtime_ns += frame.end_ns - frame.start_ns
        on_air = OnAir(frame, sender, self._sent[sender.name])
        self.frames.append(on_air)
        for radio in self._radios.values():
            if radio is not sender:
                self.arrival(on_air, radio)
                radio.consider(on_air)
        return on_air

    def arrival(self, on_air: OnAir, receiver: Transceiver) -> Arrival:
        """Return what of a frame reaches a receiver, and its luck there; fixed when it was sent."""
        arrival = on_air.arrivals.get(receiver)
        if arrival is None:
            sender, frame = on_air.sender.name, on_air.frame
            *fading, loss, detection, header, payload, damage = uniforms(
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

    def _forget(self) -> None:
        """Drop the frames that overlap none whose reception may still have to be decided."""
        now_ns = self.timeline.now_ns()
        undecided_since_ns = min(
            (
                on_air.frame.start_ns
                for on_air in self.frames
                if on_air.end_ns > now_ns or any(radio.follows(on_air) for radio in self._radios.values())
            ),
            default=now_ns,
        )
        self.frames = [on_air for on_air in self.frames if on_air.end_ns > undecided_since_ns]
