"""The relay's protocol without sockets: handshake, frames, and what a link makes of them."""

from __future__ import annotations

import hashlib
import hmac
from typing import TYPE_CHECKING

import pytest
from harness.files.records import HELLO, STATUS
from hypothesis import given
from hypothesis import strategies as st

from tsgt.client import Gap, relay_wire
from tsgt.client.links import Arrival, RelayLink
from tsgt.client.relay_wire import AuthenticationError, Frame, Position
from tsgt.errors import StreamError
from tsgt.recording import encode_line
from tsgt.relay.buffer import LineBuffer

if TYPE_CHECKING:
    from collections.abc import Iterable

KEY = bytes(range(32))
OTHER_KEY = bytes(32)
STREAM = "ab" * 16
SECOND = 1_000_000_000
HELLO_LINE = encode_line(HELLO)
CHANNEL = "-"


class Relay:
    """A relay's side of a connection, on a clock that the test sets."""

    def __init__(self, stream: str = STREAM, *, key: bytes = KEY, max_bytes: int = 1 << 20) -> None:
        self.key = key
        self.buffer = LineBuffer(stream, key, max_bytes=max_bytes, max_age_ns=60 * SECOND)
        self.now_ns = 5 * SECOND

    def connect(self, link: RelayLink, now_ns: int, channel: str = CHANNEL) -> list[Arrival | Gap]:
        """Run the handshake, and send what the reader has missed."""
        assert link.connected(channel) == b""
        challenge = relay_wire.challenge(b"\x11" * 32)
        (request,) = link.receive(challenge.encode() + b"\n", now_ns)
        assert isinstance(request, bytes)
        text = request.decode().rstrip("\n")
        wanted = relay_wire.check_request(self.key, CHANNEL, challenge, text)
        start, heads = self.buffer.start(wanted)
        welcome = relay_wire.welcome(self.key, CHANNEL, challenge, text, start, self.now_ns)
        self.number = start.number
        return [*take(link, [welcome.encode() + b"\n", *heads], now_ns), *self.send(link, now_ns)]

    def line(self, text: bytes) -> None:
        """Add a line."""
        self.buffer.append(text, self.now_ns)

    def send(self, link: RelayLink, now_ns: int) -> list[Arrival | Gap]:
        """Send what the reader has not got."""
        frames: list[bytes] = []
        if self.number < self.buffer.oldest:
            start, frames = self.buffer.skip()
            self.number = start.number
        frames += [self.buffer.frame(number) for number in range(self.number, self.buffer.next)]
        self.number = self.buffer.next
        return take(link, frames, now_ns)


def new_link(*, resume: bool = True) -> RelayLink:
    """Return a reader's side."""
    return RelayLink(KEY, lambda: b"\x22" * 32, resume=resume)


def take(link: RelayLink, chunks: Iterable[bytes], now_ns: int) -> list[Arrival | Gap]:
    """Return what the link makes of received bytes."""
    found: list[Arrival | Gap] = []
    for chunk in chunks:
        for item in link.receive(chunk, now_ns):
            assert not isinstance(item, bytes)
            found.append(item)
    return found


def texts(items: list[Arrival | Gap]) -> list[bytes | int | None]:
    """Return lines, and the sizes of gaps."""
    return [item.line if isinstance(item, Arrival) else item.lines for item in items]


def test_proofs_are_as_documented() -> None:
    """By an implementation of docs/reference/relay.md that shares nothing with ours."""
    challenge = relay_wire.challenge(b"\x11" * 32)
    assert challenge == "tsgt-relay 1 " + "11" * 32
    request = relay_wire.request(KEY, "-", challenge, b"\x22" * 32, Position(STREAM, 7))
    place = f"{'22' * 32} {STREAM} 7"
    proof = hmac.new(KEY, f"tsgt-relay 1 reader\n-\n{challenge}\n{place}".encode(), hashlib.sha256)
    assert request == f"{place} {proof.hexdigest()}"
    welcome = relay_wire.welcome(KEY, "-", challenge, request, Position(STREAM, 9), 55)
    proof = hmac.new(
        KEY, f"tsgt-relay 1 relay\n-\n{challenge}\n{request}\n{STREAM} 9 55".encode(), hashlib.sha256
    )
    assert welcome == f"{STREAM} 9 55 {proof.hexdigest()}"
    key = hmac.new(KEY, f"tsgt-relay 1 lines\n{STREAM}".encode(), hashlib.sha256).digest()
    tag = hmac.new(key, b"line 9 60 {}", hashlib.sha256).hexdigest()[:32]
    assert relay_wire.encode_frame(relay_wire.line_key(KEY, STREAM), Frame("line", 9, 60, b"{}")) == (
        f"{tag} line 9 60 {{}}\n".encode()
    )


def test_new_reader_gets_greeting_and_new_lines() -> None:
    """Nothing from before, but the greeting that it needs to understand what comes."""
    relay, link = Relay(), new_link()
    relay.line(HELLO_LINE)
    relay.line(b'{"old":1}')
    assert texts(relay.connect(link, 0)) == [HELLO_LINE]
    relay.line(b'{"new":1}')
    assert texts(relay.send(link, 0)) == [b'{"new":1}']


def test_reader_resumes_after_the_last_line() -> None:
    """It gets what it has missed, nothing twice, and no gap is told."""
    relay, link = Relay(), new_link()
    relay.line(HELLO_LINE)
    relay.connect(link, 0)
    missed = [b'{"line":%d}' % number for number in range(5)]
    for line in missed:
        relay.line(line)
    assert texts(relay.connect(link, 0)) == missed


def test_lines_that_are_no_longer_held_are_told_as_a_gap() -> None:
    """With their exact number, and with the greeting again."""
    relay, link = Relay(max_bytes=1000), new_link()
    relay.line(HELLO_LINE)
    relay.connect(link, 0)
    for number in range(100):
        relay.line(b'{"line":%d}' % number)
    missing, greeting, *rest = texts(relay.connect(link, 0))
    assert missing == 100 - len(rest)
    assert greeting == HELLO_LINE
    assert rest == [b'{"line":%d}' % number for number in range(100 - len(rest), 100)]


def test_reader_without_resumption_is_told_the_gap() -> None:
    """A controller wants new poses only."""
    relay, link = Relay(), new_link(resume=False)
    relay.connect(link, 0)
    relay.line(b"{}")
    relay.line(b"{}")
    assert texts(relay.connect(link, 0)) == [2]


def test_restarted_relay_is_told_as_a_gap() -> None:
    """Its numbers mean other lines."""
    link = new_link()
    Relay().connect(link, 0)
    other = Relay("cd" * 16)
    other.line(b"{}")
    assert texts(other.connect(link, 0)) == [None]


def test_restarted_master_is_told_as_a_gap() -> None:
    """What it sent while the relay was not connected is unknown."""
    relay, link = Relay(), new_link()
    relay.line(HELLO_LINE)
    relay.connect(link, 0)
    relay.line(HELLO_LINE)
    assert texts(relay.send(link, 0)) == [None, HELLO_LINE]


def test_relay_without_the_key_is_rejected() -> None:
    """It can neither pass for the relay nor learn anything but two nonces."""
    with pytest.raises(AuthenticationError):
        Relay(key=OTHER_KEY).connect(new_link(), 0)


def test_relay_behind_another_certificate_is_rejected() -> None:
    """Somebody in the middle who ends TLS presents his own."""
    with pytest.raises(AuthenticationError):
        Relay().connect(new_link(), 0, channel="00" * 32)


def test_relay_cannot_be_played_back() -> None:
    """What it said to another reader has another nonce in its proof."""
    challenge = relay_wire.challenge(b"\x11" * 32)
    asked = [relay_wire.request(KEY, "-", challenge, bytes([n]) * 32, None) for n in (1, 2)]
    answer = relay_wire.welcome(KEY, "-", challenge, asked[0], Position(STREAM, 0), 0)
    with pytest.raises(AuthenticationError):
        relay_wire.check_welcome(KEY, "-", challenge, asked[1], answer)


@given(st.data())
def test_no_changed_byte_is_accepted(data: st.DataObject) -> None:
    """In a frame; a proof is covered by the same comparison."""
    relay, link = Relay(), new_link()
    relay.connect(link, 0)
    relay.line(HELLO_LINE)
    frame = bytearray(relay.buffer.frame(0))
    at = data.draw(st.integers(0, len(frame) - 2))
    frame[at] ^= data.draw(st.integers(1, 255).filter(lambda change: frame[at] ^ change != ord("\n")))
    with pytest.raises(StreamError):
        take(link, [bytes(frame)], 0)


def test_repeated_frames_are_rejected() -> None:
    """Lines by their number, keep-alive frames by their time."""
    relay, link = Relay(), new_link()
    relay.connect(link, 0)
    relay.line(b"{}")
    relay.send(link, 0)
    with pytest.raises(StreamError, match="repeats line 0"):
        take(link, [relay.buffer.frame(0)], 0)
    beat = relay.buffer.beat(relay.now_ns, connected=True)
    take(link, [beat], 0)
    with pytest.raises(StreamError, match="repeats a sign of life"):
        take(link, [beat], 0)


def test_left_out_line_is_told_as_a_gap() -> None:
    """Somebody in the middle cannot drop one unnoticed: the next sign of life tells."""
    relay, link = Relay(), new_link()
    relay.connect(link, 0)
    relay.line(b"{}")
    assert texts(take(link, [relay.buffer.beat(relay.now_ns, connected=True)], 0)) == [1]


@pytest.mark.parametrize(
    ("answer", "error"),
    [
        (b"HTTP/1.1 400 Bad Request\n", "no relay of tsgt"),
        (b"tsgt-relay 2 " + b"11" * 32 + b"\n", "protocol version 2"),
        (b"\xff" * 2000, "longer than"),
    ],
)
def test_other_servers_are_recognised(answer: bytes, error: str) -> None:
    """The message says what is there."""
    link = new_link()
    link.connected(CHANNEL)
    with pytest.raises(StreamError, match=error):
        take(link, [answer], 0)


@given(st.binary(max_size=300))
def test_arbitrary_requests_are_rejected(data: bytes) -> None:
    """Without another error than the one that the server expects."""
    text = data.decode("latin-1")
    with pytest.raises(AuthenticationError):
        relay_wire.check_request(KEY, "-", relay_wire.challenge(b"\x11" * 32), text)


def test_delay_on_the_way_is_known() -> None:
    """A line that is a second late on the network counts from its arrival at the relay."""
    relay, link = Relay(), new_link()
    relay.connect(link, 1000 * SECOND)
    relay.now_ns += 10 * SECOND
    relay.line(encode_line(STATUS))
    (arrival,) = relay.send(link, 1011 * SECOND)
    assert isinstance(arrival, Arrival)
    assert link.here_ns(arrival.arrived_ns) == pytest.approx(1010 * SECOND, abs=0.003 * SECOND)
