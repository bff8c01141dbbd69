from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
from harness.files.records import (
    CLOCK,
    EVENT,
    HEADER,
    HELLO,
    IMU_PARAMETERS,
    IMU_STATUS,
    NO_POSE,
    PARAMETERS,
    POINT,
    POSE,
    STATUS,
    imu_samples,
    measurement,
)

from tsgt.model import Parameters, PointMeasurement, PolarMeasurement
from tsgt.recording import StatusRecord, decode, encode_line


@pytest.mark.parametrize(
    "record",
    [HEADER, PARAMETERS, HELLO, measurement(3), POINT, POSE, NO_POSE, STATUS, EVENT, imu_samples(0)],
    ids=lambda r: r.type,
)
def test_records_round_trip(record: object) -> None:
    """Records round trip."""
    assert decode(type(record), encode_line(record)) == record


@pytest.mark.parametrize("record", [PARAMETERS, STATUS], ids=lambda r: r.type)
def test_key_of_an_imu_is_absent_without_one(record: object) -> None:
    """Recordings without an IMU have no trace of it."""
    assert b"imu" not in encode_line(record)


def test_parameters_and_status_with_an_imu_round_trip() -> None:
    """The key is present then."""
    status = replace(STATUS, imu=IMU_STATUS)
    assert decode(StatusRecord, encode_line(status)) == status
    parameters = replace(PARAMETERS, imu=IMU_PARAMETERS)
    assert decode(Parameters, encode_line(parameters)) == parameters


def test_encoded_record_has_no_line_end() -> None:
    """Encoded record has no line end."""
    assert b"\n" not in encode_line(HEADER.__class__(software="a\nb", created_ns=0, source="\u2028\r\n"))


def test_unknown_keys_are_ignored() -> None:
    """Unknown keys are ignored."""
    data = json.loads(encode_line(measurement(1))) | {"colour": "red"}
    assert decode(PolarMeasurement, json.dumps(data).encode()) == measurement(1)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("station", "1"),
        ("stamp_ns", 1.5),
        ("slope_distance_m", math.nan),
        ("status", "fine"),
        ("type", "point"),
    ],
)
def test_wrong_value_is_named(key: str, value: object) -> None:
    """The error of a field with a wrong value names the field and stays on one line."""
    data = json.loads(encode_line(measurement(1))) | {key: value}
    with pytest.raises(ValueError, match=rf"^field {key}: [^\n]+$"):
        decode(PolarMeasurement, json.dumps(data).encode())


def test_missing_field_is_named() -> None:
    """The error of a missing field names it."""
    data = json.loads(encode_line(measurement(1)))
    del data["zenith_angle_rad"]
    with pytest.raises(ValueError, match=r"^field zenith_angle_rad: Field required$"):
        decode(PolarMeasurement, json.dumps(data).encode())


@pytest.mark.parametrize("stamp_ns", [-1, 2**63])
def test_impossible_time_is_rejected(stamp_ns: int) -> None:
    """Before 1970 or beyond 64 bits."""
    line = b'{"type":"point","station":1,"prism":1,"sequence":0,"stamp_ns":%d,"received_ns":1,"position_m":[0,0,0]}'
    with pytest.raises(ValueError, match="outside what a clock can show"):
        decode(PointMeasurement, line % stamp_ns)


@pytest.mark.parametrize("field", ["offset_ns", "bound_ns", "station"])
def test_integer_beyond_64_bits_is_rejected(field: str) -> None:
    """Integer beyond 64 bits is rejected."""
    record = json.loads(encode_line(CLOCK)) | {field: 10**400}
    with pytest.raises(ValueError, match=f"field {field}: "):
        decode(type(CLOCK), json.dumps(record).encode())
