"""The channels that are offered, with their schemas. Sans-I/O."""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from foxglove.messages import FrameTransforms, Log, PoseInFrame, SceneUpdate

if TYPE_CHECKING:
    from foxglove import Schema

TRANSFORMS = "/tf"
POSE = "/tsgt/pose"
SCENE = "/tsgt/scene"
EVENTS = "/tsgt/events"
MISSION = "/tsgt/mission"
STATUS = "/tsgt/status"

_TEXT, _NUMBER, _YES_NO = {"type": "string"}, {"type": "number"}, {"type": "boolean"}
_SIGMAS = {"type": "object", "properties": {"position_mm": _NUMBER, "rotation_deg": _NUMBER}}

_MISSION_SCHEMA: dict[str, Any] = {
    "title": "tsgt.Mission",
    "type": "object",
    "properties": {
        "verdict": {
            "type": "object",
            "properties": {"words": _TEXT, "cause": _TEXT, "urgent": _YES_NO},
        },
        "pose_valid": _YES_NO,
        "pose_age_s": _NUMBER,
        "figures": {
            "type": "object",
            "properties": {
                "live": _SIGMAS,
                "smoothed": _SIGMAS,
                **dict.fromkeys(("residual_mm", "valid_share", "data_age_s", "oldest_age_s"), _NUMBER),
            },
        },
        "alarms": {"type": "array", "items": {"type": "object", "properties": {"text": _TEXT}}},
        "stations": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {"id": _NUMBER, "state": _TEXT, "words": _TEXT, "rate_hz": _NUMBER},
            },
        },
    },
}


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel."""

    id: int
    topic: str
    advertised: dict[str, Any]
    """As an app is told of it."""


def _channel(number: int, topic: str, schema: Schema | dict[str, Any]) -> Channel:
    if isinstance(schema, dict):
        encoding, schema_encoding = "json", "jsonschema"
        name, text = schema["title"], json.dumps(schema)
    else:
        encoding = schema_encoding = schema.encoding
        name, text = schema.name, base64.b64encode(schema.data).decode()
    advertised = {
        "id": number,
        "topic": topic,
        "encoding": encoding,
        "schemaName": name,
        "schema": text,
        "schemaEncoding": schema_encoding,
    }
    return Channel(number, topic, advertised)


_SCHEMAS: dict[str, Schema | dict[str, Any]] = {
    TRANSFORMS: FrameTransforms.get_schema(),
    POSE: PoseInFrame.get_schema(),
    SCENE: SceneUpdate.get_schema(),
    EVENTS: Log.get_schema(),
    MISSION: _MISSION_SCHEMA,
    STATUS: {"title": "tsgt.Status", "type": "object"},
}

CHANNELS = {
    topic: _channel(number, topic, schema) for number, (topic, schema) in enumerate(_SCHEMAS.items(), start=1)
}
"""By topic."""
