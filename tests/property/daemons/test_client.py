"""What the client makes of anything that may arrive, and of clocks and delays that nobody knows."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import replace
from typing import Any

from harness.files.records import HELLO, POSE, SETUP, STATUS
from hypothesis import given, settings
from hypothesis import strategies as st

from tsgt.client import Gap, Pose, relay_wire
from tsgt.client.decoder import Decoder
from tsgt.client.links import Arrival, RelayLink, SocketLink
from tsgt.client.relay_wire import Frame, Position
from tsgt.errors import StreamError
from tsgt.recording import encode_line

KEY = bytes(range(32))
STREAM = "ab" * 16
NONCE = b"\x11" * 32
MS = 1_000_000
YEAR_NS = 365 * 86_400 * 1_000_000_000

OTHER_VALUES: list[Any] = [
    None, True, 0, -1, 10**30, 1.5, float("nan"), float("inf"), "", "x", [], [1], [None], ["x"] * 36, [[1, 2]], {}, {"id": 1},
    [{}], [{"id": 1}], [[[[]]]],
]  # fmt: skip


@settings(max_examples=25)
@given(st.sampled_from([HELLO, SETUP, POSE, STATUS]), st.data())
def test_changed_records_raise_no_other_error(record: object, data: st.DataObject) -> None:
    """A field of another type, missing, or of a later version: a record, or StreamError."""
    decoder = Decoder(SocketLink())
    list(decoder.decode(Arrival(encode_line(HELLO), 0)))
    changed: dict[str, Any] = json.loads(encode_line(record))
    key = data.draw(st.sampled_from(sorted(changed)))
    changed[key] = data.draw(st.sampled_from(OTHER_VALUES))
    with suppress(StreamError):
        list(decoder.decode(Arrival(json.dumps(changed).encode(), 0)))


@settings(max_examples=25)
@given(st.lists(st.binary(max_size=200), max_size=5))
def test_arbitrary_bytes_raise_no_other_error(chunks: list[bytes]) -> None:
    """From a socket, and from what says to be a relay."""
    relay = RelayLink(KEY, lambda: NONCE)
    socket = SocketLink()
    decoder = Decoder(socket)
    for link in (relay, socket):
        link.connected("-")
        with suppress(StreamError):
            for chunk in chunks:
                for item in link.receive(chunk, 0):
                    if isinstance(item, Arrival):
                        list(decoder.decode(item))
    assert relay.position is None


def connected_relay(relay_ns: int, now_ns: int) -> RelayLink:
    """Return a link after its handshake."""
    link = RelayLink(KEY, lambda: NONCE)
    link.connected("-")
    challenge = relay_wire.challenge(NONCE)
    (request,) = link.receive(challenge.encode() + b"\n", now_ns)
    assert isinstance(request, bytes)
    text = request.decode().strip()
    welcome = relay_wire.welcome(KEY, "-", challenge, text, Position(STREAM, 0), relay_ns)
    assert list(link.receive(welcome.encode() + b"\n", now_ns)) == []
    return link


delays = st.lists(
    st.tuples(st.integers(0, 500 * MS), st.integers(0, 3000 * MS), st.integers(0, 3000 * MS)),
    min_size=1,
    max_size=20,
)


@settings(max_examples=25)
@given(delays, st.integers(0, YEAR_NS), st.integers(0, YEAR_NS))
def test_ages_are_true_but_for_the_least_delay(
    lines: list[tuple[int, int, int]], relay_clock_ns: int, reader_clock_ns: int
) -> None:
    """Of every pose, whatever the clocks are set to, and wherever it was held up: at the relay, or on the network.

    Lines keep their order, so a delayed one delays those behind it.
    """
    true_ns = 0
    handshake_delay_ns = 5 * MS
    link = connected_relay(relay_clock_ns, reader_clock_ns + handshake_delay_ns)
    decoder = Decoder(link)
    line_key = relay_wire.line_key(KEY, STREAM)
    at_relay_ns = here_ns = handshake_delay_ns
    least_relay_ns, least_network_ns = YEAR_NS, handshake_delay_ns

    def arrive(number: int, line: bytes) -> list[object]:
        frame = Frame("line", number, relay_clock_ns + at_relay_ns, line)
        found: list[object] = []
        for item in link.receive(relay_wire.encode_frame(line_key, frame), reader_clock_ns + here_ns):
            assert not isinstance(item, Gap | bytes)
            found += decoder.decode(item)
        return found

    arrive(0, encode_line(HELLO))
    for number, (pause_ns, to_relay_ns, to_reader_ns) in enumerate(lines, start=1):
        true_ns += 50 * MS + pause_ns
        at_relay_ns = max(at_relay_ns + 1, true_ns + to_relay_ns)
        here_ns = max(here_ns, at_relay_ns + to_reader_ns)
        least_relay_ns = min(least_relay_ns, at_relay_ns - true_ns)
        least_network_ns = min(least_network_ns, here_ns - at_relay_ns)
        (pose,) = arrive(
            number, encode_line(replace(POSE, kind="predicted", stamp_ns=POSE.stamp_ns + true_ns))
        )
        assert isinstance(pose, Pose)
        true_age_s = (here_ns - true_ns) / 1e9
        age_s = pose.age_s(reader_clock_ns + here_ns)
        skew_s = 2 * 200e-6 * here_ns / 1e9
        least_s = (least_relay_ns + least_network_ns) / 1e9
        assert true_age_s - least_s - skew_s - 1e-6 <= age_s <= true_age_s + 1e-6
