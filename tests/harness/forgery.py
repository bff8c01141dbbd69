"""Somebody who sends what he likes to the cores of a master and its stations, as often as he likes, at the worst moment.

He knows all that was on the air, of this session and of an earlier one, but not the key. Beside the exchange that he
attacks runs another one with the same random numbers, which nobody attacks: as long as both say the same on the air,
and end in the same state, nothing of his has had an effect.
"""

from __future__ import annotations

from collections import Counter, deque
from copy import deepcopy
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple

from harness.superframe_loop import START_NS, Exchange

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

LONGEST_PACKET_BYTES = 255
_STAMP_SIGMA_NS = 3_000
_LOSS = 0.05
_JOINING_FRAMES = 8
_OLD_FRAMES = 200
_REMEMBERED = 2000
_LONG_AGO_NS = 1_000_000_000_000

_COUNTERS = frozenset({"rejected_packets", "authentication_failures"})
"""What is there to count such packets."""


@dataclass
class Forgeries:
    """What became of forged packets.

    Attributes
    ----------
    sent
        How many, by kind and by whom they were sent to.
    accepted
        How many of them had an effect.
    diverged
        In how many frames the exchange was another one than without them.
    same_state
        Whether all cores ended as they did without them.
    """

    sent: Counter[tuple[str, str]] = field(default_factory=Counter)
    accepted: Counter[tuple[str, str]] = field(default_factory=Counter)
    diverged: int = 0
    same_state: bool = False


class _Heard(NamedTuple):
    """What was on the air: beacons, and replies to which of them."""

    beacons: deque[bytes]
    replies: deque[bytes]


def _heard() -> _Heard:
    return _Heard(deque(maxlen=_REMEMBERED), deque(maxlen=_REMEMBERED))


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
        self.now, self._old = _heard(), _heard()
        old = Exchange(timing, Authenticator(key), _bits(old_rng), start_ns=START_NS - _LONG_AGO_NS)
        for _ in range(_OLD_FRAMES):
            old.frame()
            self._old.beacons.append(old.beacon)
            self._old.replies.extend(old.replies.values())

    def on_station(self, exchange: Exchange, number: int) -> None:
        """Send to a station that is about to hear the beacon, or has heard it."""
        core, own = exchange.members[number].core, self.now.beacons
        for kind in self._rng.choice(KINDS, self._per_step).tolist():
            if kind in self._others:
                payload = self._beacon(self._others[kind], exchange)
            else:
                payload = self._payload(kind, exchange.beacon, own, self._old.beacons, self.now.replies)
            if kind == "spliced" and payload == exchange.beacon:
                continue
            heard = core.received(exchange.packet(number, payload, late_ns=-1000))
            self._note(kind, "station", effect=heard is not None)

    def on_master(self, exchange: Exchange, reply: bytes, received_ns: int) -> None:
        """Send to the master that is about to hear a reply, or has heard it."""
        for kind in self._rng.choice(KINDS, self._per_step).tolist():
            if kind in self._others:
                payload = self._reply(self._others[kind], reply[:-CODE_BYTES], exchange)
            else:
                payload = self._payload(kind, reply, self.now.replies, self._old.replies, self.now.beacons)
            if kind == "spliced" and payload == reply:
                continue
            heard = exchange.master.received(payload, received_ns, _STAMP_SIGMA_NS)
            self._note(kind, "master", effect=heard is not None)

    def _note(self, kind: str, target: str, *, effect: bool) -> None:
        self.result.sent[kind, target] += 1
        self.result.accepted[kind, target] += effect

    def _payload(
        self, kind: str, coming: bytes, own: deque[bytes], old: deque[bytes], other: deque[bytes]
    ) -> bytes:
        rng = self._rng
        match kind:
            case "noise":
                return rng.bytes(int(rng.integers(LONGEST_PACKET_BYTES + 1)))
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
        """Turn one to three bits over."""
        number = int.from_bytes(packet, "big")
        for bit in self._rng.choice(8 * len(packet), int(self._rng.integers(1, 4)), replace=False).tolist():
            number ^= 1 << bit
        return number.to_bytes(len(packet), "big")

    def _beacon(self, authenticator: Authenticator, exchange: Exchange) -> bytes:
        """Make a beacon that is right but for the key."""
        content, master = exchange.beacon[:-CODE_BYTES], exchange.master
        return content + authenticator.beacon_code(
            session=master.session, counter=master.counter, content=content
        )

    def _reply(self, authenticator: Authenticator, content: bytes, exchange: Exchange) -> bytes:
        """Make a reply that is right but for the key."""
        number = int(self._rng.integers(1, len(exchange.members) + 1))
        station_state = exchange.master.station(number)
        return content + authenticator.reply_code(
            session=exchange.master.session,
            station=number,
            station_nonce=station_state.nonce or 0,
            counter=exchange.master.counter,
            beacon_code=exchange.beacon[-CODE_BYTES:],
            sequence=station_state.first_sequence(decode_reply(content)),
            content=content,
        )


def forge(
    timing: FrameTiming, key: bytes, count: int, rng: np.random.Generator, *, per_step: int
) -> Forgeries:
    """Attack an exchange that is under way, in which one in twenty packets is lost.

    Parameters
    ----------
    timing
        Of the frames.
    key
        Of the mission.
    count
        How many packets to send, or some more.
    rng
        What is sent, and what is lost.
    per_step
        So many before each packet of the exchange, and after it.
    """
    nonces, sent, old = rng.spawn(3)
    attacked, alone = (
        Exchange(timing, Authenticator(key), _bits(twin)) for twin in (nonces, deepcopy(nonces))
    )
    for _ in range(_JOINING_FRAMES):
        attacked.frame()
        alone.frame()
    attack = _Attack(timing, key, sent, old, per_step)
    while attack.result.sent.total() < count:
        deaf = [number for number in attacked.members if rng.random() < _LOSS]
        unheard = [number for number in attacked.members if rng.random() < _LOSS]
        _frame(alone, deaf, unheard, None)
        _frame(attacked, deaf, unheard, attack)
        attack.result.diverged += (attacked.beacon, attacked.replies) != (alone.beacon, alone.replies)
    attack.result.same_state = state(attacked) == state(alone)
    return attack.result


def state(thing: object) -> object:
    """Return all that an object holds, to be compared; but for counters of what was refused, and random numbers."""
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


def _frame(exchange: Exchange, deaf: Sequence[int], unheard: Sequence[int], attack: _Attack | None) -> None:
    """Run a frame whose beacon some stations do not hear, and in which the master does not hear some."""
    exchange.begin()
    arrivals = []
    for number in exchange.members:
        if attack:
            attack.on_station(exchange, number)
        received_ns = None if number in deaf else exchange.hear(number)
        if received_ns is not None:
            arrivals.append((received_ns, number))
    if attack:
        if not deaf:  # to a station that has missed it a beacon that is played to it later is new
            attack.now.beacons.append(exchange.beacon)
        for number in exchange.members:
            attack.on_station(exchange, number)
    for received_ns, number in sorted(arrivals):
        reply = exchange.replies[number]
        if attack:
            attack.on_master(exchange, reply, received_ns)
        if number not in unheard:
            exchange.deliver(number, received_ns)
        if attack and number not in unheard:
            attack.now.replies.append(reply)
            attack.on_master(exchange, reply, received_ns)
    exchange.end()


def _bits(rng: np.random.Generator) -> Callable[[int], int]:
    return lambda bits: int.from_bytes(rng.bytes(8), "big") % (1 << bits)
