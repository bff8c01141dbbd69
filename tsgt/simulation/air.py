"""The shared channel: every frame that is being sent, and what of it reaches whom.

Randomness hangs on seed, sender, frame and receiver alone, so that a further radio changes nothing for the others.
The model and what it leaves out: docs/explanation/simulated-radio.md.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

from tsgt.simulation.link import uniforms
from tsgt.simulation.transceiver import Transceiver

if TYPE_CHECKING:
    import numpy as np

    from tsgt.simulation.frames import Antenna, Frame
    from tsgt.simulation.link import LinkModel
    from tsgt.simulation.timeline import Timeline


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
