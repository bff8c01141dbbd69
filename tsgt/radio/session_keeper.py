"""Which session of a master a station is in, and whether a beacon belongs to it."""

from __future__ import annotations

import hmac
from typing import TYPE_CHECKING

from tsgt.radio.authentication import CODE_BYTES
from tsgt.radio.beacon_clock import BeaconClock
from tsgt.radio.messages import Confirmation
from tsgt.radio.station_session import HeardBeacon, StationSession, full_counter

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from tsgt.radio.authentication import Authenticator
    from tsgt.radio.base import LoRaSettings, Packet
    from tsgt.radio.messages import Beacon
    from tsgt.radio.outbox import Outbox
    from tsgt.radio.station_session import Reception

PATIENCE_NS = 3_000_000_000
"""Another session is tried only when the confirmed one has been silent for so long."""

_NONCE_BITS = 32


class SessionKeeper:
    """Keeps the session that is confirmed, and beside it one that is tried.

    Whoever has recorded a session can play it back, so that one that is merely authentic is tried only while the
    confirmed one is silent, and forgotten as soon as that is heard again.

    Parameters
    ----------
    station
        Number of the station.
    settings, outbox, boot
        For new sessions; see :class:`~tsgt.radio.station_session.StationSession`.
    authenticator
        Has the key.
    receptions
        What earlier runs of the program have journalled, in the order in which they were made.
    random_bits
        Returns a number with so many random bits.

    Attributes
    ----------
    confirmed, candidate
        The two; None where there is none.
    refused
        How many packets looked like a beacon with a session and had a wrong code.
    """

    def __init__(
        self,
        station: int,
        settings: LoRaSettings,
        authenticator: Authenticator,
        outbox: Outbox,
        boot: str,
        receptions: Iterable[Reception],
        random_bits: Callable[[int], int],
    ) -> None:
        self._station = station
        self._settings = settings
        self._authenticator = authenticator
        self._outbox = outbox
        self._boot = boot
        self._random_bits = random_bits
        self._clocks: dict[int, dict[str, BeaconClock]] = {}
        for reception in receptions:
            clock = self._clocks.setdefault(reception.session, {}).setdefault(reception.boot, BeaconClock())
            clock.add(reception.received_ns, reception.sent_us, reception.sigma_ns, in_full=True)
        self.confirmed: StationSession | None = None
        self.candidate: StationSession | None = None
        self.refused = 0

    @property
    def current(self) -> StationSession | None:
        """The session that is answered."""
        return self.candidate or self.confirmed

    def find(self, beacon: Beacon, packet: Packet) -> StationSession | None:
        """Return the session of an authentic beacon, which is its newest from now on; None for any other beacon.

        Parameters
        ----------
        beacon
            What the packet says.
        packet
            As it came.
        """
        for session in (self.confirmed, self.candidate):
            if session is None or (counter := session.counter_of(beacon)) is None:
                continue
            if self._is_authentic(session.master_nonce, counter, packet):
                if session is self.confirmed:
                    self.candidate = None
                session.listen(_heard(beacon, counter, packet))
                return session
        return self._begin(beacon, packet)

    def _begin(self, beacon: Beacon, packet: Packet) -> StationSession | None:
        part = beacon.session
        if part is None or not self._may_try(part.nonce, packet.received_at_ns):
            return None
        counter = full_counter(part, beacon)
        if not self._is_authentic(part.nonce, counter, packet):
            self.refused += 1
            return None
        self.candidate = StationSession(
            _heard(beacon, counter, packet),
            part,
            self._random_bits(_NONCE_BITS),
            self._settings,
            self._outbox,
            self._boot,
            self._clocks.get(part.nonce, {}),
        )
        return self.candidate

    def _is_authentic(self, master_nonce: int, counter: int, packet: Packet) -> bool:
        content, code = packet.payload[:-CODE_BYTES], packet.payload[-CODE_BYTES:]
        right = self._authenticator.beacon_code(session=master_nonce, counter=counter, content=content)
        return hmac.compare_digest(right, code)

    def _may_try(self, master_nonce: int, now_ns: int) -> bool:
        """Whether a beacon of another session is looked at."""
        known = [session for session in (self.confirmed, self.candidate) if session is not None]
        if any(session.master_nonce == master_nonce for session in known):
            return False  # it has been heard before
        return self.confirmed is None or now_ns - self.confirmed.heard.received_ns >= PATIENCE_NS

    def confirm(self, session: StationSession) -> bool:
        """Look whether the newest beacon of a session confirms it for the first time."""
        confirmation = Confirmation(self._station, session.nonce)
        if session.confirmed or confirmation not in session.heard.beacon.confirmations:
            return False
        session.confirmed = True
        self.confirmed, self.candidate = session, None
        self._clocks.clear()  # no other session will need them
        return True


def _heard(beacon: Beacon, counter: int, packet: Packet) -> HeardBeacon:
    return HeardBeacon(
        beacon, packet.payload[-CODE_BYTES:], counter, packet.received_at_ns, packet.stamp_sigma_ns
    )
