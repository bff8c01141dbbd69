"""The codes by which master and stations know each other's packets of the superframe.

Each packet ends with four bytes that only those who have the key can compute: keyed BLAKE2s over the content and over
all that makes this packet the only one of its kind: who sends it, in which session, in which frame, and for a reply
which beacon it answers. What was recorded on the air therefore fits at no other time.

A code proves who wrote a packet, not when it left: whoever holds a packet back and sends it a little later is found by
its time, which is not a matter of this module.
"""

from __future__ import annotations

import hashlib
import struct

CODE_BYTES = 4
"""Of 2^32 forged packets one gets through: at 1000 a second, which is more than the channel bears, one in 50 days."""

KEY_BYTES = 32

_PERSON = b"tsgt sf1"
"""Keeps these codes apart from what else may be computed with the same key."""

_BEACON, _REPLY = 1, 2

_HEADER = struct.Struct(">BQBIQ4sQH")


class Authenticator:
    """Computes the codes of one mission. Compare them by :func:`hmac.compare_digest`.

    Parameters
    ----------
    key
        :data:`KEY_BYTES` bytes that all radios of the mission share. None: codes without a key, which anybody can
        compute; they still tell packets of one session, frame and station from those of another.

    Attributes
    ----------
    authentic : bool
        Whether there is a key.

    Raises
    ------
    ValueError
        A key of another length.
    """

    __slots__ = ("_key", "authentic")

    def __init__(self, key: bytes | None) -> None:
        if key is not None and len(key) != KEY_BYTES:
            raise ValueError(f"a key has {KEY_BYTES} bytes, not {len(key)}")
        self._key = key or b""
        self.authentic = key is not None

    def beacon_code(self, *, session: int, counter: int, content: bytes) -> bytes:
        """Return the code of a beacon.

        Parameters
        ----------
        session
            The master's nonce, 48 bits.
        counter
            Number of the frame in the session, in full.
        content
            The packet without its code.
        """
        return self._code(_BEACON, session, 0, 0, counter, bytes(CODE_BYTES), 0, content)

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
        """Return the code of a reply.

        Parameters
        ----------
        session
            The master's nonce, 48 bits.
        station
            Number of the station; the reply itself does not name it.
        station_nonce
            That of the station's introduction to this session, 32 bits.
        counter
            Number of the frame in the session, in full.
        beacon_code
            The code of the beacon that is answered.
        sequence
            Number of the first sighting of the first run, in full, of which the reply may carry the low bits only;
            0 without runs.
        content
            The packet without its code.
        """
        return self._code(_REPLY, session, station, station_nonce, counter, beacon_code, sequence, content)

    def _code(
        self,
        kind: int,
        session: int,
        station: int,
        station_nonce: int,
        counter: int,
        beacon_code: bytes,
        sequence: int,
        content: bytes,
    ) -> bytes:
        header = _HEADER.pack(
            kind, session, station, station_nonce, counter, beacon_code, sequence, len(content)
        )
        return hashlib.blake2s(
            header + content, digest_size=CODE_BYTES, key=self._key, person=_PERSON
        ).digest()
