"""GeoCOM: values survive encoding, and no reply is attributed to another request, whatever the line does."""

from __future__ import annotations

import asyncio
import itertools
import re

import pytest
from harness.files.damage import examples
from harness.instruments.geocom_line import (
    REQUEST,
    Cable,
    FakeInstrument,
    Fault,
    checksum_of,
    cut,
    damaged,
    doubled,
    garbage_before,
    late,
    not_taken,
    silent,
    torn,
)
from hypothesis import example, given
from hypothesis import strategies as st

from tsgt.errors import InstrumentError, MessageError
from tsgt.simulation.kernel import VirtualClock, run_virtual
from tsgt.station.geocom import GeoComConnection, Outcome, Rpc, name_of, outcome_of
from tsgt.station.geocom.codec import (
    MAX_TRANSACTION,
    Byte,
    ReplyLine,
    crc16_arc,
    decode_reply,
    encode_request,
)
from tsgt.station.geocom.framing import ReplyLines, StampedLine
from tsgt.station.serial import Chunk

latin = st.text(st.characters(max_codepoint=0xFF), max_size=20)
reals = st.floats(-1e6, 1e6)
values = st.lists(
    st.one_of(st.integers(-(2**31), 2**31 - 1), reals, latin, st.integers(0, 255).map(Byte)), max_size=8
)
transactions = st.integers(1, MAX_TRANSACTION)


@given(data=st.binary(max_size=60).map(bytes.hex))
@example(data="123456789")
def test_checksum_equals_long_division(data: str) -> None:
    """Two implementations agree, and the second has the published check value."""
    assert checksum_of("123456789") == 0xBB3D
    assert crc16_arc(data.encode()) == checksum_of(data)


@given(rpc=st.sampled_from(Rpc), parameters=values, transaction=transactions, checksum=st.booleans())
def test_request_round_trip(
    rpc: Rpc,
    parameters: list[int | float | str],
    transaction: int,
    checksum: bool,  # noqa: FBT001 (a parameter of hypothesis)
) -> None:
    """Encoded parameters decode to the same values; reals to the last decimal."""
    line = encode_request(rpc, parameters, transaction=transaction, checksum=checksum, decimals=12)
    assert line.endswith(b"\r\n")
    assert line.count(b"\r") == line.count(b"\n") == 1
    found = REQUEST.fullmatch(line[:-2].decode("ascii"))
    assert found is not None
    assert (int(found["rpc"]), int(found["transaction"])) == (rpc, transaction)
    text = f"%R1P,0,{transaction}:0"
    if parameters:
        text += f",{found['parameters']}"
    reply = decode_reply(text.encode())
    assert len(reply.values) == len(parameters)
    for value, parameter in zip(reply.values, parameters, strict=True):
        assert type(value) is type(parameter)
        assert value == (pytest.approx(parameter, abs=0.5e-12) if isinstance(parameter, float) else parameter)
    if checksum:
        assert int(found["checksum"]) == checksum_of(
            line[:-2].decode().replace(f",{found['checksum']}:", ":", 1)
        )


@given(data=st.binary(max_size=120), head=st.sampled_from([b"", b"%R1P,0,1:0,", b"%R1P,0,1:", b"%R1P,"]))
@example(data=b"9" * 5000, head=b"%R1P,0,1:0,")
@example(data=b"1e999", head=b"%R1P,0,1:0,")
@example(data=b"'2f'", head=b"%R1P,0,1:")
def test_arbitrary_bytes_decode_or_raise(data: bytes, head: bytes) -> None:
    """Only MessageError is raised."""
    try:
        reply = decode_reply(head + data)
    except MessageError:
        return
    assert isinstance(reply, ReplyLine)


@given(place=st.integers(0, 200), bit=st.integers(0, 7))
def test_checksum_detects_single_bit_errors(place: int, bit: int) -> None:
    """Every such reply is rejected."""
    text = "%R1P,0,17:0,1.2345678901,1.5707963268,0.0000048481,42.1234,123456"
    head, body = text.split(":")
    line = bytearray(f"{head},{checksum_of(text)}:{body}".encode())
    assert decode_reply(bytes(line), checksum=True).values[-1] == 123456
    line[place % len(line)] ^= 1 << bit
    with pytest.raises(MessageError):
        decode_reply(bytes(line), checksum=True)


# --- lines

good_lines = st.builds(
    lambda transaction, numbers: f"%R1P,0,{transaction}:0,{','.join(map(str, numbers))}".encode(),
    transactions,
    st.lists(st.integers(0, 10**9), min_size=1, max_size=8),
)
ends = st.sampled_from([b"\r\n", b"\r", b"\n", b"\r\n\r\n"])
garbage = st.one_of(
    st.just(b""),
    st.sampled_from([b"?\r\n", b"%R1P,0,3:0,1.2", b"%R1", b"%R1Q,0,1:\r\n", b"\r\n", b"x" * 5000]),
    st.binary(max_size=40).filter(lambda data: b"%R1P" not in data),
)


@given(
    pieces=st.lists(st.tuples(garbage, good_lines, ends), max_size=6),
    cuts=st.lists(st.integers(0, 500), max_size=12),
)
def test_every_reply_is_framed_and_timestamped(
    pieces: list[tuple[bytes, bytes, bytes]], cuts: list[int]
) -> None:
    """However the data is split, and whatever precedes a reply."""
    stream = b"".join(before + line + end for before, line, end in pieces)
    byte_ns = 1_000_000
    lines = ReplyLines(baud=10_000)
    found: list[StampedLine] = []
    places = [0, *sorted(place % (len(stream) + 1) for place in cuts), len(stream)]
    for start, end in itertools.pairwise(places):
        if end > start:
            found += lines.push(Chunk(stream[start:end], end * byte_ns))
    assert [line.data for line in found] == [line for _, line, _ in pieces]
    for line in found:
        assert stream[line.first_byte_ns // byte_ns :].startswith(line.data)


def test_line_without_end_is_bounded() -> None:
    """It is dropped, and the reply after it found."""
    lines = ReplyLines(baud=115_200)
    for number in range(1000):
        assert not lines.push(Chunk(b"%R1P" * 256, number))
    assert len(lines._buffer) <= 4096
    assert len(lines._arrivals) <= 4
    assert [line.data for line in lines.push(Chunk(b"\r%R1P,0,1:0\r", 1000))][-1] == b"%R1P,0,1:0"


# --- codes


@given(code=st.integers(-10, 70_000), has_values=st.booleans())
def test_every_code_has_an_outcome_and_a_name(code: int, has_values: bool) -> None:  # noqa: FBT001
    """Known or not."""
    assert isinstance(outcome_of(code, has_values=has_values), Outcome)
    assert name_of(code).startswith(str(code))


# --- the connection

faults = st.one_of(
    st.just(silent),
    st.just(damaged),
    st.just(doubled),
    st.floats(0.001, 4.0).map(late),
    st.integers(0, 30).map(cut),
    # Within the timeout: a later piece could complete the next reply if that is truncated, undetectably without a checksum.
    st.builds(torn, st.integers(1, 30), st.floats(0.001, 0.9)),
    garbage.map(garbage_before),
    st.sampled_from([3074, 3080, 3087, 3093, 3100, 3101, 3107, 3108, 3109]).map(not_taken),
)
steps = st.lists(
    st.tuples(
        st.sampled_from(["call", "call", "call", "cancel", "pause", "abort"]),
        st.lists(faults, max_size=3),
        st.floats(0.0, 1.5),
    ),
    max_size=12,
)


def text_of(values: tuple[int | float | str, ...]) -> str:
    """Return values as in a reply."""
    return ",".join(map(str, values))


@examples(200)
@given(script=steps, checksum=st.booleans())
@example(
    script=[
        ("call", [garbage_before(b"x"), silent, garbage_before(b"\r\n")], 0.8),
        ("pause", [], 0.1),
        ("cancel", [late(3.2), damaged, garbage_before(b"x")], 1.1),
        ("abort", [doubled, silent, torn(11, 0.3)], 0.3),
        *[("call", list[Fault](), 0.5)] * 2,
        ("call", [cut(11)], 1.2),
        *[("call", list[Fault](), 0.5)] * 2,
    ],
    checksum=False,
)
@pytest.mark.slow
def test_reply_belongs_to_its_request(
    script: list[tuple[str, list[Fault], float]],
    checksum: bool,  # noqa: FBT001 (a parameter of hypothesis)
) -> None:
    """Whatever happens to the line and the callers; calls succeed again afterwards."""

    async def run() -> None:
        loop = asyncio.get_running_loop()
        instrument = FakeInstrument(checksums=checksum)
        clock = VirtualClock(0)
        connection = GeoComConnection(await Cable(instrument).open(115_200), clock, checksum=checksum)

        async def ask(number: int) -> None:
            began_ns = clock.monotonic_ns()
            reply = await connection.call(Rpc.TMC_GET_FULL_MEAS, number, number + 0.5, timeout_s=1.0)
            if reply.code == 0:
                right = (number, number + 0.5)
                # Without a checksum a truncated reply is valid if other data ends its line.
                assert reply.values == right or (
                    not checksum and text_of(right).startswith(text_of(reply.values))
                )
                assert began_ns <= reply.sent_ns <= reply.first_byte_ns < clock.monotonic_ns()

        for number, (step, to_come, for_s) in enumerate(script):
            instrument.faults.extend(to_come)
            began_s = loop.time()
            try:
                match step:
                    case "call":
                        await ask(number)
                    case "cancel":
                        async with asyncio.timeout(for_s):
                            await ask(number)
                    case "pause":
                        await asyncio.sleep(for_s)
                    case "abort":
                        await connection.abort()
            except (InstrumentError, TimeoutError):
                pass
            assert loop.time() - began_s < 20.0
        instrument.faults.clear()
        await asyncio.sleep(10.0)
        await ask(1000)

    run_virtual(run)


def test_procedure_numbers_are_unique() -> None:
    """An alias would mean that two procedures have one number."""
    assert len(Rpc.__members__) == len(Rpc)
    assert all(re.fullmatch(r"[A-Z]{3}_[A-Z0-9_]+", rpc.name) for rpc in Rpc)
