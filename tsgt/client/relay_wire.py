"""The relay's protocol, version 1: handshake with a shared key, and authenticated lines. docs/reference/relay.md defines it.

::

    relay   tsgt-relay 1 NONCE
    reader  NONCE STREAM NEXT PROOF
    relay   STREAM FIRST TIME PROOF
    relay   TAG KIND NUMBER TIME TEXT        for each line, without end

Both proofs cover all lines of the handshake, so neither side reveals anything to a peer without the key, and nothing that
was recorded is of use later. Sans-I/O; nonces are handed in.
"""

from __future__ import annotations

import hashlib
import hmac
import re
from dataclasses import dataclass
from typing import Literal, cast

from tsgt.errors import StreamError

VERSION = 1

DEFAULT_PORT = 27690

KEY_BYTES = 32
NONCE_BYTES = 32
STREAM_BYTES = 16

MAX_HANDSHAKE_BYTES = 512  # longest line of a handshake, with reserve

MAX_FRAME_BYTES = (1 << 20) + 256
"""Longest line with its header; lines of the stream have at most 1 MiB."""

FULL = b"full"
"""Text of the sign of life to a reader for which the relay has no place; the connection ends after the heads.

It comes after the relay's proof, so the reader knows that its key is right.
"""

NO_CHANNEL = "-"
"""Stands for the certificate's hash in the proofs where there is no TLS."""

Kind = Literal["line", "head", "beat"]
"""A line of the stream; the latest line of a type that a new reader needs; a sign of life, with the state of the source."""

_TAG_DIGITS = 32
_CHALLENGE = re.compile(r"tsgt-relay (\d{1,9}) ([0-9a-f]{64})")
_REQUEST = re.compile(r"[0-9a-f]{64} (?:([0-9a-f]{32}) (\d{1,18})|- -) [0-9a-f]{64}")
_WELCOME = re.compile(r"([0-9a-f]{32}) (\d{1,18}) (\d{1,19}) [0-9a-f]{64}")
_FRAME = re.compile(rb"([0-9a-f]{32}) (line|head|beat) (\d{1,18}) (\d{1,19}) (.*)", re.DOTALL)


class AuthenticationError(StreamError):
    """The peer does not have the key, or somebody has changed what it sent."""


@dataclass(frozen=True, slots=True)
class Position:
    """A place in a relay's stream: the number of the next line."""

    stream: str
    number: int


@dataclass(frozen=True, slots=True)
class Frame:
    """One line from the relay."""

    kind: Kind
    number: int
    """Of a line: its number in the stream. Else the number of the next line."""
    time_ns: int
    """When the relay got or made it, on the relay's CLOCK_MONOTONIC."""
    text: bytes


def challenge(nonce: bytes) -> str:
    """Return the relay's first line."""
    return f"tsgt-relay {VERSION} {nonce.hex()}"


def check_challenge(line: str) -> None:
    """Raise StreamError if a line is not the challenge of a relay of this version."""
    match = _CHALLENGE.fullmatch(line)
    if match is None:
        raise StreamError(
            "no relay of tsgt answers there; compare address and port, and whether the relay uses TLS"
        )
    if int(match[1]) != VERSION:
        raise StreamError(
            f"the relay has protocol version {int(match[1])}, this program supports version {VERSION}"
        )


def request(key: bytes, channel: str, challenged: str, nonce: bytes, resume: Position | None) -> str:
    """Return the reader's line: where to go on, with the proof that it has the key."""
    place = "- -" if resume is None else f"{resume.stream} {resume.number}"
    unproven = f"{nonce.hex()} {place}"
    return f"{unproven} {_proof(key, 'reader', channel, challenged, unproven)}"


def check_request(key: bytes, channel: str, challenged: str, line: str) -> Position | None:
    """Return where a reader wants to go on, None: with new lines; raises AuthenticationError if it does not have the key."""
    match = _REQUEST.fullmatch(line)
    if match is None:
        raise AuthenticationError("not a request")
    unproven, _, proof = line.rpartition(" ")
    _check(proof, _proof(key, "reader", channel, challenged, unproven))
    return None if match[1] is None else Position(match[1], int(match[2]))


def welcome(key: bytes, channel: str, challenged: str, requested: str, first: Position, now_ns: int) -> str:
    """Return the relay's answer to a reader that has the key: what follows, with the proof that the relay has it too."""
    unproven = f"{first.stream} {first.number} {now_ns}"
    return f"{unproven} {_proof(key, 'relay', channel, challenged, requested, unproven)}"


def check_welcome(
    key: bytes, channel: str, challenged: str, requested: str, line: str
) -> tuple[Position, int]:
    """Return what follows, and the relay's time in ns; raises AuthenticationError if the relay does not have the key."""
    match = _WELCOME.fullmatch(line)
    if match is None:
        raise AuthenticationError("not an answer of a relay")
    unproven, _, proof = line.rpartition(" ")
    _check(proof, _proof(key, "relay", channel, challenged, requested, unproven))
    return Position(match[1], int(match[2])), int(match[3])


def line_key(key: bytes, stream: str) -> bytes:
    """Return the key of the tags of a stream's lines: one for all readers, so that a line is tagged once."""
    return hmac.digest(key, f"tsgt-relay {VERSION} lines\n{stream}".encode(), "sha256")


def encode_frame(key: bytes, frame: Frame) -> bytes:
    """Return a frame with its tag and line end; ``key``: from :func:`line_key`."""
    tagged = b"%s %d %d %s" % (frame.kind.encode(), frame.number, frame.time_ns, frame.text)
    return b"%s %s\n" % (_tag(key, tagged), tagged)


def decode_frame(key: bytes, line: bytes) -> Frame:
    """Return the frame of a line without its end; raises AuthenticationError unless the relay sent exactly this."""
    match = _FRAME.fullmatch(line)
    if match is None or not hmac.compare_digest(_tag(key, line[_TAG_DIGITS + 1 :]), match[1]):
        raise AuthenticationError("a line was changed on its way from the relay")
    return Frame(cast("Kind", match[2].decode()), int(match[3]), int(match[4]), match[5])


def channel_of(certificate: bytes) -> str:
    """Return what binds a handshake to the TLS connection that it runs in, from the relay's certificate (DER)."""
    return hashlib.sha256(certificate).hexdigest()


def _proof(key: bytes, role: str, channel: str, *lines: str) -> str:
    text = "\n".join((f"tsgt-relay {VERSION} {role}", channel, *lines))
    return hmac.digest(key, text.encode("ascii"), "sha256").hex()


def _tag(key: bytes, tagged: bytes) -> bytes:
    return hmac.digest(key, tagged, "sha256").hex()[:_TAG_DIGITS].encode()


def _check(proof: str, expected: str) -> None:
    if not hmac.compare_digest(proof, expected):
        raise AuthenticationError("the two sides do not have the same key")
