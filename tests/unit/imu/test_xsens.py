"""The codec of MTData2."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from harness.inertial.imu_devices import SimulatedXsens
from hypothesis import given
from hypothesis import strategies as st

from tsgt.imu.xsens import GO_TO_CONFIG, MT_DATA2, SET_OUTPUT, Xsens, message

# Recorded by others from an MTi-300 at rest, 400 Hz: packet counter 42581, sample time 5719854, rate of turn
# (-0.00541657, -0.00458360, 0.00792891) rad/s, acceleration (-0.07915300, -0.16655955, 9.82217598) m/s^2, and more.
RECORDED = bytes.fromhex(
    "1020 02 A655 1060 04 0057472E 2010 10 3F7F7DC4 BC10107D 3BA15770 BD7EC656 4020 0C BDA21AF8 BE2A8E96 411D27A2"
    "4010 0C B94FC800 B9DA2400 3CC92880 4030 0C 3C02C89C 3C35F6C8 3CDB0C00 8020 0C BBB17D81 BB963200 3C01E841"
    "8030 10 3F800000 B6E33001 B6C04000 37264800 C020 0C BE999C24 3FB61B56 3F166AEB 3010 04 000186DE E020 04 00400003"
)


def test_recorded_message_is_decoded() -> None:
    """Delta angle and velocity agree with the rate and acceleration in the same message, times its 2.5 ms."""
    (sample,), _ = Xsens(400).push(message(MT_DATA2, RECORDED))
    assert sample.counter == 42_581
    assert sample.instrument_time_ns == 571_985_400_000
    assert [v / 0.0025 for v in sample.delta_angle_rad] == pytest.approx(
        (-0.00541657, -0.00458360, 0.00792891), abs=2e-5
    )
    assert [v / 0.0025 for v in sample.delta_velocity_mps] == pytest.approx(
        (-0.07915300, -0.16655955, 9.82217598), abs=2e-4
    )


def test_checks_are_those_of_recorded_messages() -> None:
    """GoToConfig, and a long output configuration."""
    assert message(GO_TO_CONFIG) == bytes.fromhex("FAFF3000D1")
    configuration = bytes.fromhex(
        "1020FFFF1060FFFF201001904020019040100190403001908020019080300190C02000640810000A30100032E020FFFF"
    )
    assert message(SET_OUTPUT, configuration)[-1] == 0x99


def test_long_message_has_an_extended_length() -> None:
    """Above 254 bytes."""
    data = RECORDED + bytes.fromhex("0810") + bytes([200]) + bytes(200)
    assert message(MT_DATA2, data)[3:6] == bytes([0xFF]) + len(data).to_bytes(2, "big")
    samples, _ = Xsens(400).push(message(MT_DATA2, data))
    assert len(samples) == 1


STREAM = b"".join(
    [
        b"\xfa\xfa\xff",
        message(MT_DATA2, RECORDED),
        b"garbage",
        message(MT_DATA2, RECORDED)[:-1] + b"\x00",
        message(0x31),
        message(MT_DATA2, RECORDED),
    ]
)


@given(st.lists(st.integers(0, len(STREAM)), max_size=8))
def test_decoding_is_independent_of_pieces(cuts: list[int]) -> None:
    """Garbage and a damaged message between samples."""
    device = Xsens(400)
    found, others = 0, []
    for begin, end in pairwise(sorted({0, len(STREAM), *cuts})):
        samples, messages = device.push(STREAM[begin:end])
        found += len(samples)
        others += messages
    assert (found, others) == (2, [b"\x31"])


@given(st.binary(max_size=500), st.binary(max_size=100))
def test_garbage_is_no_sample(data: bytes, content: bytes) -> None:
    """Also within a message whose check is right."""
    device = Xsens(400)
    samples, _ = device.push(data + message(MT_DATA2, content))
    assert samples == []
    assert len(device._buffer) <= 3000


def test_counts_continue_where_they_wrap() -> None:
    """The 16-bit counter and the 32-bit time begin again in the simulated device."""
    simulated, device = SimulatedXsens(), Xsens(100)
    samples = []
    for number in range(200):
        samples += device.push(simulated.sample(number, ((0.1, 0.0, -0.2), (0.0, 0.0, 9.81))))[0]
    assert [sample.counter for sample in samples] == list(range(65_500, 65_700))
    first_ns = samples[0].instrument_time_ns
    assert first_ns is not None
    assert samples[-1].instrument_time_ns == first_ns + 199 * 10_000_000
    assert samples[-1].delta_angle_rad == pytest.approx((0.001, 0.0, -0.002), rel=1e-6)


def test_device_is_set_up() -> None:
    """Each request has its response; identity and rate are known then."""
    device, simulated = Xsens(200), SimulatedXsens()
    for step in device.steps:
        _, messages = device.push(simulated.respond(step.request))
        assert [step.matches(response) for response in messages] == [True]
    hello = device.hello()
    assert (hello.model, hello.serial_number, hello.firmware) == ("MTi-300-2A5G4", "037003F8", "1.8.2")
    assert simulated.running
    assert simulated.rate_hz == 200.0


@pytest.mark.parametrize(
    ("code", "rate_dps", "force_g"),
    [("MTi-300-2A5G4", 450.0, 5.0), ("MTi-630R-8A1G6", 2000.0, 10.0), ("MTi-3-8A7G6T", None, None)],
)
def test_full_scale_follows_from_the_product_code(
    code: str, rate_dps: float | None, force_g: float | None
) -> None:
    """So that saturated samples are counted; of a device that is not known it is not guessed."""
    device = Xsens(200)
    device.push(message(0x1D, code.ljust(20).encode()))
    hello = device.hello()
    assert hello.angular_rate_limit_radps == (
        None if rate_dps is None else pytest.approx(math.radians(rate_dps))
    )
    assert hello.specific_force_limit_mps2 == (None if force_g is None else pytest.approx(9.80665 * force_g))


def test_refusal_is_in_words() -> None:
    """With the error's meaning in the manual."""
    device = Xsens(200)
    _, (response,) = device.push(message(0x42, b"\x1e"))
    assert device.steps[-2].refusal(response) == "timer overflow: baud rate too low for this output"
