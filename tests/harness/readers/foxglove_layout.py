"""What a layout file of Foxglove names: topics, and paths into their messages."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parents[3] / "configs" / "foxglove"


def paths(name: str) -> set[str]:
    """Return all topics and message paths in a layout."""
    return set(_paths(json.loads((FOLDER / name).read_text())))


def topic_of(path: str) -> str:
    """Return the topic of a message path."""
    return re.split(r"[.\[]", path, maxsplit=1)[0]


def value_at(message: Any, path: str) -> Any:
    """Return what a path leads to in a message; raises LookupError or AttributeError if nothing is there."""
    for name, index in re.findall(r"\.(\w+)|\[(\d+)\]", path):
        if index:
            message = message[int(index)]
        else:
            message = message[name] if isinstance(message, dict) else getattr(message, name)
    return message


def _paths(item: Any) -> list[str]:
    if isinstance(item, str):
        return [item] if item.startswith("/") else []
    parts = [*item, *item.values()] if isinstance(item, dict) else item if isinstance(item, list) else []
    return [path for part in parts for path in _paths(part)]
