"""Message authentication codes of the superframe: four bytes of keyed BLAKE2s (RFC 7693, section 2.9) at a packet's end.

They cover the content, sender, session, frame, and for a reply the beacon it replies to, so a recorded packet is valid at
no other time. They do not prove when a packet was sent; the time checks of the session reject delayed beacons.
"""

from __future__ import annotations

import hashlib
import struct

CODE_BYTES = 4
"""One of 2^32 forged packets is accepted: one in 50 days at 1000 packets per second, more than the channel carries."""

KEY_BYTES = 32

_PERSON = b"tsgt sf1"  # BLAKE2 personalisation: separates these codes from other uses of the same key

_BEACON, _REPLY = 1, 2

_HEADER = struct.Struct(">BQBIQ4sQH")


class Authenticator:
    """Computes the codes of one mission; compare them with :func:`hmac.compare_digest`.

    The key has :data:`KEY_BYTES` bytes and is shared by all radios of the mission. Without a key anybody can compute the
    codes, which then only separate sessions, frames and stations.
    """

    __slots__ = ("_key", "authentic")

    def __init__(self, key: bytes | None) -> None:
        if key is not None and len(key) != KEY_BYTES:
            raise ValueError(f"a key has {KEY_BYTES} bytes, not {len(key)}")
        self._key = key or b""
        self.authentic = key is not None

    def beacon_code(self, *, session: int, counter: int, content: bytes) -> bytes:
        """Return the code of a beacon, from the 48-bit session nonce and the full frame counter."""
        return self._code(content, _BEACON, session, 0, 0, counter, bytes(CODE_BYTES), 0)

    def reply_code(
        self,
        *,
        session: int,
        station: int,
        station_nonce: int,
        counter: int,
        beacon_code: bytes,
        sequence: int,
        content: bytes,
    ) -> bytes:
        """Return the code of a reply to the beacon with ``beacon_code``.

        ``station_nonce``: nonce of the station's join request in this session, 32 bits. ``sequence``: full number of
        the first measurement of the first block, of which the reply may carry only the low bits; 0 without blocks.
        """
        return self._code(content, _REPLY, session, station, station_nonce, counter, beacon_code, sequence)

    def _code(self, content: bytes, *fields: int | bytes) -> bytes:
        header = _HEADER.pack(*fields, len(content))
        return hashlib.blake2s(
            header + content, digest_size=CODE_BYTES, key=self._key, person=_PERSON
        ).digest()
