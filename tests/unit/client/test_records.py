"""The client's data classes against the master's definitions."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any

import pytest
from harness.files.records import EVENT, HELLO, IMU_STATUS, NO_POSE, ODOMETRY_STATUS, POSE, SETUP, STATUS

from tsgt.client import PROTOCOL_VERSION, Pose, records
from tsgt.client.build import TYPES, build, load
from tsgt.errors import StreamError
from tsgt.recording import PROTOCOL_VERSION as MASTERS_VERSION
from tsgt.recording import encode_line

ROOT = Path(__file__).parents[3]
SCHEMA: dict[str, Any] = json.loads((ROOT / "configs" / "schema" / "stream.schema.json").read_text())["$defs"]

CLASSES = {
    "HelloRecord": records.Hello,
    "ValidityLimits": records.ValidityLimits,
    "PoseRecord": records.Pose,
    "StationShare": records.StationShare,
    "PolarMeasurement": records.Measurement,
    "StatusRecord": records.Status,
    "StationStatus": records.StationStatus,
    "ImuStatus": records.ImuStatus,
    "OdometryStatus": records.OdometryStatus,
    "EventRecord": records.Event,
    "SetupRecord": records.Setup,
    "SetupStation": records.SetupStation,
    "SetupPrism": records.SetupPrism,
    "SetupGeofence": records.SetupGeofence,
    "ReferencePoint": records.ReferencePoint,
    "RecordingStatus": records.RecordingStatus,
    "DiskStatus": records.DiskStatus,
}
OURS = {"epoch_ns"}


@pytest.mark.parametrize("name", CLASSES)
def test_fields_are_those_of_the_schema(name: str) -> None:
    """Names and JSON types; what may be absent has a default."""
    schema = SCHEMA[name]
    expected = {key: _types(value) for key, value in schema["properties"].items() if key != "type"}
    cls = CLASSES[name]
    ours = {field.name: _annotation(str(field.type)) for field in fields(cls) if field.name not in OURS}
    absent = set(expected) - set(schema["required"])  # None in our records
    assert ours == {key: value | {"null"} if key in absent else value for key, value in expected.items()}
    optional = {field.name for field in fields(cls) if field.default is not MISSING}
    assert set(ours) - set(schema["required"]) <= optional


def _types(schema: dict[str, Any]) -> set[str]:
    if "anyOf" in schema:
        return set().union(*map(_types, schema["anyOf"]))
    if "$ref" in schema:
        target = schema["$ref"].rpartition("/")[2]
        return {"string"} if "enum" in SCHEMA[target] else {"object"}
    return {"string" if "enum" in schema or "const" in schema else schema["type"]}


def _annotation(text: str) -> set[str]:
    names = {
        "int": "integer",
        "float": "number",
        "bool": "boolean",
        "None": "null",
        "str": "string",
        "Kind": "string",
    }
    arrays = ("tuple", "Vector3", "Quaternion")
    return {
        names.get(part, "array" if part.startswith(arrays) else "object")
        for part in (part.strip() for part in text.split("|"))
    }


@pytest.mark.parametrize(
    "record",
    [POSE, NO_POSE, HELLO, SETUP, STATUS, replace(STATUS, imu=IMU_STATUS, odometry=ODOMETRY_STATUS), EVENT],
)
def test_every_value_arrives(record: Any) -> None:
    """What the master encodes is what the client's record has, to the last bit."""
    data = load(encode_line(record))
    built = build(TYPES[data["type"]], data)
    for field in fields(built):
        if field.name not in OURS:
            _same(getattr(built, field.name), getattr(record, field.name))


def _same(built: Any, sent: Any) -> None:
    if isinstance(built, tuple):
        for pair in zip(built, sent, strict=True):
            _same(*pair)
    elif hasattr(built, "__dataclass_fields__"):
        for field in fields(built):
            _same(getattr(built, field.name), getattr(sent, field.name))
    else:
        assert built == sent


def test_unknown_keys_are_ignored() -> None:
    """A later version may add some."""
    data = load(encode_line(EVENT)) | {"colour": "red"}
    assert build(records.Event, data).message == EVENT.message


@pytest.mark.parametrize(
    "change",
    [
        {"position_m": [1.0, 2.0]},
        {"position_m": "here"},
        {"covariance": [0.0] * 35 + [None]},
        {"valid": "yes"},
        {"stamp_ns": 1.5},
        {"stations": [1]},
        {"stations": [{"id": 1}]},
        {"position_m": [10**400, 0, 0]},
        {"residual_m": 10**400},
        {"stamp_ns": -(2**63) - 1},
    ],
)
def test_wrong_fields_are_rejected(change: dict[str, Any]) -> None:
    """They never become a pose."""
    data = load(encode_line(POSE)) | change
    with pytest.raises(StreamError):
        build(Pose, data)


def test_deep_lists_are_rejected() -> None:
    """Also those that the parser of JSON still takes."""
    nested: list[Any] = []
    for _ in range(2000):
        nested = [nested]
    data = load(encode_line(POSE)) | {"degraded_by": nested}
    with pytest.raises(StreamError):
        build(Pose, data)


@pytest.mark.parametrize(
    "line", [b"", b"7", b"{}", b'{"type":1}', b'{"type":"pose","residual_m":NaN}', b"\xff", b"[" * 99999]
)
def test_other_lines_are_rejected(line: bytes) -> None:
    """Whatever is no JSON object with a type."""
    with pytest.raises(StreamError):
        load(line)


def test_protocol_is_the_masters() -> None:
    """A new version needs a look at the client."""
    assert PROTOCOL_VERSION == MASTERS_VERSION


def test_import_is_light() -> None:
    """The plain face loads neither numpy nor pydantic nor asyncio; asyncio comes with AsyncStream."""
    code = (
        "import sys, tsgt.client; "
        "heavy = {'numpy', 'scipy', 'click', 'pydantic', 'structlog', 'rich', 'asyncio', 'ssl'}; "
        "print(sorted(heavy & set(sys.modules))); tsgt.client.AsyncStream; print('asyncio' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", f"import sys; sys.path.append({str(ROOT)!r}); {code}"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split("\n")[:2] == ["[]", "True"]
