"""Lines of the stream become records."""

from __future__ import annotations

import json
import math
from dataclasses import MISSING, Field, fields
from functools import cache
from typing import Any, NoReturn, TypeVar

from tsgt.client.records import Event, Hello, Measurement, Pose, Setup, Status
from tsgt.errors import StreamError

T = TypeVar("T")

INTEGER_BITS = 63  # without the sign; the ages of larger times would be beyond a double

_SHOWN_CHARACTERS = 80

TYPES: dict[str, type[Hello | Setup | Pose | Measurement | Status | Event]] = {
    "hello": Hello,
    "setup": Setup,
    "pose": Pose,
    "measurement": Measurement,
    "status": Status,
    "event": Event,
}
"""Types of lines that become records; all others are ignored."""


def load(line: bytes) -> dict[str, Any]:
    """Return the JSON object of a line; raises StreamError if it is none, or has no type."""
    try:
        loaded = json.loads(line, parse_constant=_reject)
    except (ValueError, RecursionError) as error:
        raise StreamError(f"not a line of a tsgt stream ({error}): {_shown(line)}") from error
    if not isinstance(loaded, dict) or not isinstance(loaded.get("type"), str):
        raise StreamError(f"not a line of a tsgt stream: {_shown(line)}")
    return loaded


def build(cls: type[T], data: dict[str, Any], **more: Any) -> T:
    """Build a record from a JSON object, ignoring unknown keys; raises StreamError for a missing or wrong field."""
    values: dict[str, Any] = more
    nested: dict[str, type] = getattr(cls, "nested", {})
    sizes: dict[str, int] = getattr(cls, "sizes", {})
    for field in fields(cls):  # type: ignore[arg-type]  # T is one of the classes above
        name = field.name
        if name in more:
            continue
        if name not in data:
            if field.default is MISSING:
                raise StreamError(f"a line of the stream has no field {name}, which {cls.__name__} needs")
            continue
        value = data[name]
        try:
            if name in nested and value is not None:
                inner = nested[name]
                value = (
                    tuple(build(inner, item) for item in value)
                    if isinstance(value, list)
                    else build(inner, value)
                )
            elif name in sizes and value is not None:
                value = _numbers(value, sizes[name])
            elif isinstance(value, list):
                value = _tuples(value)
            elif not isinstance(value, _json_types(field)):
                raise TypeError(f"{_shown(repr(value).encode())} is not {field.type}")
            elif isinstance(value, int) and value.bit_length() > INTEGER_BITS:
                raise ValueError("beyond 64 bits")
        except (TypeError, ValueError, OverflowError, RecursionError) as error:
            raise StreamError(
                f"the field {name} of a line of type {data.get('type')} is wrong: {error}"
            ) from error
        values[name] = value
    return cls(**values)


@cache
def _json_types_of(annotation: str) -> tuple[type, ...]:
    names = {name.strip() for name in annotation.split("|")}
    kinds: dict[str, tuple[type, ...]] = {
        "int": (int,),
        "float": (float, int),
        "bool": (bool,),
        "None": (type(None),),
    }
    return tuple(kind for name in names for kind in kinds.get(name, (str,)))


def _json_types(field: Field[Any]) -> tuple[type, ...]:
    return _json_types_of(str(field.type))


def _numbers(value: Any, size: int) -> tuple[float, ...]:
    if not isinstance(value, list) or len(value) != size:
        raise ValueError(f"expected {size} numbers")
    numbers = tuple(float(number) for number in value)
    if not all(map(math.isfinite, numbers)):
        raise ValueError("not finite")
    return numbers


def _tuples(values: list[Any]) -> tuple[Any, ...]:
    return tuple(_tuples(value) if isinstance(value, list) else value for value in values)


def _reject(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not JSON")


def _shown(line: bytes) -> str:
    return repr(line[:_SHOWN_CHARACTERS].decode(errors="replace"))
