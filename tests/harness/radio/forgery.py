"""An attacker without the key, who sends packets to a master and its stations at any time and rate.

The attacker knows all packets of this session and of an earlier one. A second exchange with the same random numbers is not
attacked: as long as both send the same packets and end in the same state, no forged packet has had an effect.
"""

from __future__ import annotations

from collections import Counter, deque
from copy import deepcopy
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple

from harness.radio.superframe_loop import START_NS, SuperframeLoop

from tsgt.radio.superframe.wire import CODE_BYTES, Authenticator, decode_reply

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np

    from tsgt.radio.superframe import FrameTiming

KINDS = (
    "noise",
    "altered",
    "cut short",
    "extended",
    "spliced",
    "repeated at once",
    "earlier in the session",
    "earlier session",
    "other direction",
    "another key",
    "no key",
)

MAX_PACKET_BYTES = 255
_STAMP_SIGMA_NS = 3_000
_LOSS = 0.05
_JOINING_FRAMES = 8
_EARLIER_FRAMES = 200
_TRAFFIC_CAPACITY = 2000
_SESSION_AGE_NS = 1_000_000_000_000

_COUNTERS = frozenset({"rejected_packets", "authentication_failures"})
"""Attributes that count such packets."""


@dataclass
class Forgeries:
    """Result of an attack.

    Attributes
    ----------
    sent, accepted
        Forged packets, and those that had an effect, by kind and by recipient.
    diverged
        Frames whose packets differed from the exchange without an attack.
    same_state
        All cores ended in the same state as without an attack.
    """

    sent: Counter[tuple[str, str]] = field(default_factory=Counter)
    accepted: Counter[tuple[str, str]] = field(default_factory=Counter)
    diverged: int = 0
    same_state: bool = False


class _Traffic(NamedTuple):
    """Recorded traffic."""

    beacons: deque[bytes]
    replies: deque[bytes]


def _traffic() -> _Traffic:
    return _Traffic(deque(maxlen=_TRAFFIC_CAPACITY), deque(maxlen=_TRAFFIC_CAPACITY))


class _Attack:
    def __init__(
        self,
        timing: FrameTiming,
        key: bytes,
        rng: np.random.Generator,
        old_rng: np.random.Generator,
        per_step: int,
    ) -> None:
        self._rng = rng
        self._per_step = per_step
        self._others = {"another key": Authenticator(bytes(range(100, 132))), "no key": Authenticator(None)}
        self.result = Forgeries()
        self.now, self._old = _traffic(), _traffic()
        old = SuperframeLoop(timing, Authenticator(key), _bits(old_rng), start_ns=START_NS - _SESSION_AGE_NS)
        for _ in range(_EARLIER_FRAMES):
            old.run_frame()
            self._old.beacons.append(old.beacon)
            self._old.replies.extend(old.replies.values())

    def on_station(self, loop: SuperframeLoop, number: int) -> None:
        """Send to a station before or after it receives the beacon."""
        core, own = loop.members[number].core, self.now.beacons
        for kind in self._rng.choice(KINDS, self._per_step).tolist():
            if kind in self._others:
                payload = self._beacon(self._others[kind], loop)
            else:
                payload = self._payload(kind, loop.beacon, own, self._old.beacons, self.now.replies)
            if kind == "spliced" and payload == loop.beacon:
                continue
            received = core.received(loop.beacon_packet(number, payload, delay_ns=-1000))
            self._note(kind, "station", effect=received is not None)

    def on_master(self, loop: SuperframeLoop, reply: bytes, received_ns: int) -> None:
        """Send to the master before or after it receives a reply."""
        for kind in self._rng.choice(KINDS, self._per_step).tolist():
            if kind in self._others:
                payload = self._reply(self._others[kind], reply[:-CODE_BYTES], loop)
            else:
                payload = self._payload(kind, reply, self.now.replies, self._old.replies, self.now.beacons)
            if kind == "spliced" and payload == reply:
                continue
            received = loop.master.received(payload, received_ns, _STAMP_SIGMA_NS)
            self._note(kind, "master", effect=received is not None)

    def _note(self, kind: str, target: str, *, effect: bool) -> None:
        self.result.sent[kind, target] += 1
        self.result.accepted[kind, target] += effect

    def _payload(
        self, kind: str, coming: bytes, own: deque[bytes], old: deque[bytes], other: deque[bytes]
    ) -> bytes:
        rng = self._rng
        match kind:
            case "noise":
                return rng.bytes(int(rng.integers(MAX_PACKET_BYTES + 1)))
            case "altered":
                return self._altered(coming)
            case "cut short":
                return coming[: int(rng.integers(len(coming)))]
            case "extended":
                return coming + rng.bytes(int(rng.integers(1, 9)))
            case "spliced":
                pool = (own, other, old)[int(rng.integers(3))]
                return coming[:-CODE_BYTES] + self._one_of(pool)[-CODE_BYTES:]
            case "repeated at once":
                return own[-1] if own else b""
            case "earlier in the session":
                return self._one_of(own)
            case "earlier session":
                return self._one_of(old)
            case _:
                return self._one_of(other)

    def _one_of(self, packets: deque[bytes]) -> bytes:
        return packets[int(self._rng.integers(len(packets)))] if packets else b""

    def _altered(self, packet: bytes) -> bytes:
        """Flip one to three bits."""
        number = int.from_bytes(packet, "big")
        for bit in self._rng.choice(8 * len(packet), int(self._rng.integers(1, 4)), replace=False).tolist():
            number ^= 1 << bit
        return number.to_bytes(len(packet), "big")

    def _beacon(self, authenticator: Authenticator, loop: SuperframeLoop) -> bytes:
        """Return the beacon with a code of another key."""
        content, master = loop.beacon[:-CODE_BYTES], loop.master
        return content + authenticator.beacon_code(
            session=master.session, counter=master.counter, content=content
        )

    def _reply(self, authenticator: Authenticator, content: bytes, loop: SuperframeLoop) -> bytes:
        """Return a reply with a code of another key."""
        number = int(self._rng.integers(1, len(loop.members) + 1))
        station_state = loop.master.station(number)
        return content + authenticator.reply_code(
            session=loop.master.session,
            station=number,
            station_nonce=station_state.nonce or 0,
            counter=loop.master.counter,
            beacon_code=loop.beacon[-CODE_BYTES:],
            sequence=station_state.first_sequence(decode_reply(content)),
            content=content,
        )


def forge(
    timing: FrameTiming, key: bytes, count: int, rng: np.random.Generator, *, per_step: int
) -> Forgeries:
    """Attack an exchange in which one in twenty packets is lost.

    Parameters
    ----------
    count
        Minimum number of packets.
    rng
        For the forged packets and the losses.
    per_step
        Number of forged packets before and after each packet of the exchange.
    """
    nonces, sent, old = rng.spawn(3)
    attacked, alone = (
        SuperframeLoop(timing, Authenticator(key), _bits(twin)) for twin in (nonces, deepcopy(nonces))
    )
    for _ in range(_JOINING_FRAMES):
        attacked.run_frame()
        alone.run_frame()
    attack = _Attack(timing, key, sent, old, per_step)
    while attack.result.sent.total() < count:
        missing_beacon = [number for number in attacked.members if rng.random() < _LOSS]
        missing_reply = [number for number in attacked.members if rng.random() < _LOSS]
        _frame(alone, missing_beacon, missing_reply, None)
        _frame(attacked, missing_beacon, missing_reply, attack)
        attack.result.diverged += (attacked.beacon, attacked.replies) != (alone.beacon, alone.replies)
    attack.result.same_state = state(attacked) == state(alone)
    return attack.result


def state(thing: object) -> object:
    """Return the state of an object for comparison, without random sources and counters of rejected packets."""
    if isinstance(thing, dict):
        return {state(key): state(value) for key, value in thing.items()}
    if isinstance(thing, list | tuple | deque):
        return tuple(state(each) for each in thing)
    if not type(thing).__module__.startswith(("tsgt.", "harness.")) or isinstance(thing, Enum):
        return None if callable(thing) else thing
    names = {slot for cls in type(thing).__mro__ for slot in getattr(cls, "__slots__", ())}
    names |= set(getattr(thing, "__dict__", ()))
    held = {name: state(getattr(thing, name)) for name in names - _COUNTERS if hasattr(thing, name)}
    return type(thing).__name__, tuple(sorted(held.items()))


def _frame(
    loop: SuperframeLoop, missing_beacon: Sequence[int], missing_reply: Sequence[int], attack: _Attack | None
) -> None:
    """Run a frame in which some stations miss the beacon, and the master misses some replies."""
    loop.send_beacon()
    arrivals = []
    for number in loop.members:
        if attack:
            attack.on_station(loop, number)
        received_ns = None if number in missing_beacon else loop.receive_beacon(number)
        if received_ns is not None:
            arrivals.append((received_ns, number))
    if attack:
        if not missing_beacon:  # a station that missed it would accept a replay
            attack.now.beacons.append(loop.beacon)
        for number in loop.members:
            attack.on_station(loop, number)
    for received_ns, number in sorted(arrivals):
        reply = loop.replies[number]
        if attack:
            attack.on_master(loop, reply, received_ns)
        if number not in missing_reply:
            loop.deliver_reply(number, received_ns)
        if attack and number not in missing_reply:
            attack.now.replies.append(reply)
            attack.on_master(loop, reply, received_ns)
    loop.end_frame()


def _bits(rng: np.random.Generator) -> Callable[[int], int]:
    return lambda bits: int.from_bytes(rng.bytes(8), "big") % (1 << bits)
