"""The codec of the VN-100."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from harness.inertial.imu_devices import SimulatedVectorNav
from hypothesis import given
from hypothesis import strategies as st

from tsgt.imu.vectornav import VectorNav, checked_text, command, frame


def test_checks_are_those_of_the_manual() -> None:
    """Examples in the manual and in other programs' sources: texts, and the angles of a binary message."""
    assert command("VNWRG,6,0,1") == b"$VNWRG,6,0,1*B1B4\r\n"
    assert command("VNWRG,75,1,7,0") == b"$VNWRG,75,1,7,0*63E9\r\n"
    assert checked_text(b"$VNRRG,8*4B\r\n") == b"VNRRG,8"
    assert checked_text(b"$VNRRG,8*4C\r\n") is None
    assert checked_text(b"$VNRRG,8*XX\r\n") is None


def test_frame_has_the_layout_of_the_manual() -> None:
    """Sync, group 1, its fields little-endian, time, duration, deg, m/s, CRC."""
    data = frame(1, 0.005, (1.0, 0.0, 0.0), (0.0, 0.0, 2.0))
    assert data[:4] == bytes.fromhex("fa010108")
    assert data[4:12] == bytes.fromhex("0100000000000000")
    assert data[16:20] == bytes.fromhex("0000803f")
    assert data[36:40] == bytes.fromhex("00000040")
    assert len(data) == 42


def test_samples_are_decoded() -> None:
    """In rad and m/s, with the time since start-up."""
    (sample,), _ = VectorNav(200).push(frame(123_456_789_000, 0.005, (0.1, -0.2, 0.3), (0.0, 0.01, 0.049)))
    assert sample.instrument_time_ns == 123_456_789_000
    assert sample.counter is None
    assert sample.delta_angle_rad == pytest.approx([math.radians(v) for v in (0.1, -0.2, 0.3)])
    assert sample.delta_velocity_mps == pytest.approx((0.0, 0.01, 0.049))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_sample_that_is_no_number_is_left_out(value: float) -> None:
    """The others of its line are kept; the gap shows in their times."""
    frames = [
        frame(n * 5_000_000, 0.005, (value if n == 2 else 0.1, 0.0, 0.0), (0.0, 0.0, 0.049))
        for n in (1, 2, 3)
    ]
    samples, _ = VectorNav(200).push(b"".join(frames))
    assert [sample.instrument_time_ns for sample in samples] == [5_000_000, 15_000_000]


STREAM = b"".join(
    [
        b"garbage\xfa\x01",
        frame(5_000_000, 0.005, (0.1, 0.0, 0.0), (0.0, 0.0, 0.049)),
        b"$VNYMR,+010.071,+000.278,-002.026*6A\r\n$VNRRG,03,0100012345*XX\r\n",
        command("VNRRG,01,VN-100T-CR"),
        frame(10_000_000, 0.005, (0.1, 0.0, 0.0), (0.0, 0.0, 0.049))[:-1] + b"\x00",
        frame(15_000_000, 0.005, (0.1, 0.0, 0.0), (0.0, 0.0, 0.049)),
    ]
)


@given(st.lists(st.integers(0, len(STREAM)), max_size=8))
def test_decoding_is_independent_of_pieces(cuts: list[int]) -> None:
    """Texts, garbage and a damaged message between samples."""
    device = VectorNav(200)
    times, texts = [], []
    for begin, end in pairwise(sorted({0, len(STREAM), *cuts})):
        samples, messages = device.push(STREAM[begin:end])
        times += [sample.instrument_time_ns for sample in samples]
        texts += messages
    assert times == [5_000_000, 15_000_000]
    assert b"VNRRG,01,VN-100T-CR" in texts


@given(st.binary(max_size=500))
def test_garbage_is_no_sample(data: bytes) -> None:
    """Nothing is raised, and memory stays bounded."""
    device = VectorNav(200)
    samples, _ = device.push(data)
    assert samples == []
    assert len(device._buffer) <= 300


def test_device_is_set_up() -> None:
    """Each request has its response; identity and rate are known then."""
    device, simulated = VectorNav(200), SimulatedVectorNav()
    for step in device.steps:
        _, messages = device.push(simulated.respond(step.request))
        assert [step.matches(message) for message in messages] == [True]
    hello = device.hello()
    assert (hello.model, hello.serial_number, hello.firmware) == ("VN-100T-CR", "0100012345", "2.1.0.0")
    assert simulated.rate_hz == hello.rate_hz == 200.0
    assert "VNWRG,75,3,4,01,0801" in simulated.commands


def test_refusal_is_in_words() -> None:
    """With the error's name in the manual."""
    device = VectorNav(200)
    step = device.steps[0]
    _, (message,) = device.push(b"$VNERR,0C*" + command("VNERR,0C")[-6:])
    assert not step.matches(message)
    assert step.refusal(message) == "insufficient baud rate"


@pytest.mark.parametrize("rate_hz", [0, 300, 801])
def test_impossible_rate_is_rejected(rate_hz: int) -> None:
    """It does not divide 800."""
    with pytest.raises(ValueError, match="fraction of 800"):
        VectorNav(rate_hz)
