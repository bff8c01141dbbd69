"""Encoding and decoding of the lines of a recording."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar

from pydantic import TypeAdapter, ValidationError
from pydantic_core import SchemaValidator

from tsgt.errors import CorruptLineError, RecordingVersionError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

FORMAT_VERSION = 1

MAX_LINE_BYTES = 1 << 20
"""Longest line that a reader accepts; a file without line ends must not fill the memory."""

HEADER_START = b'{"type":"recording",'  # start of every header, by which a torn one is recognised

NO_HEADER = "does not begin with the header of a recording; give a file that tsgt recorded or imported"
"""Error message for a file whose first line is not a header."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingHeader:
    """The first line of a recording; of several runs that were joined to one file, the first line of each."""

    type: Literal["recording"] = "recording"
    version: int = FORMAT_VERSION
    """Version of the format. Readers reject others; new types of lines and new keys do not change it."""
    software: str
    """Name and version of the program that wrote it."""
    created_ns: int
    """Start of the run, on the Unix clock of the computer that wrote it, in ns."""
    source: str
    """Origin of the lines: a program, or the imported files."""


class Line(NamedTuple):
    """One complete line of a recording: a JSON object with a type."""

    number: int
    """Number of the line in the file, from 1."""
    type: str
    """Its ``type``, which may be unknown."""
    data: bytes
    """The JSON object without the line end."""


@dataclass(frozen=True, slots=True)
class Typed:
    """What every line of a recording has."""

    type: str


@dataclass(frozen=True, slots=True)
class _Versioned:
    type: Literal["recording"]
    version: int


_adapter: Callable[[object], TypeAdapter[Any]] = functools.cache(TypeAdapter)


def _validator_of(cls: Any) -> SchemaValidator:
    return SchemaValidator(_bounded(TypeAdapter(cls).core_schema))


def _bounded(schema: Any) -> Any:
    """Reject integers beyond 64 bits, which tsgt never writes."""
    if isinstance(schema, dict):
        bounds = {"ge": -(2**63), "lt": 2**64} if schema.get("type") == "int" else {}
        return bounds | {key: _bounded(value) for key, value in schema.items()}
    if isinstance(schema, list | tuple):
        return type(schema)(map(_bounded, schema))
    return schema


_validator: Callable[[object], SchemaValidator] = functools.cache(_validator_of)


def encode_line(record: object) -> bytes:
    """Turn a record into one JSON object, without a line end.

    A class may name fields in ``omitted_if_none``: without a value their keys are absent.
    """
    # Not dump_json: passing its dozen options takes as long as encoding a line.
    serializer = _adapter(type(record)).serializer
    if absent := {name for name in getattr(record, "omitted_if_none", ()) if getattr(record, name) is None}:
        return serializer.to_json(record, exclude=absent)
    return serializer.to_json(record)


def decode(cls: type[T], data: bytes) -> T:
    """Build a record, ignoring unknown keys; ValueError names the first missing or wrong field in one line."""
    try:
        record: T = _validator(cls).validate_json(data, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        field = ".".join(str(part) for part in first["loc"])
        raise ValueError(f"field {field}: {first['msg']}" if field else first["msg"]) from None
    return record


def decode_line(cls: type[T], line: Line, path: Path) -> T:
    """Build a record from a line; CorruptLineError names line and first missing or wrong field."""
    try:
        return decode(cls, line.data)
    except ValueError as error:
        raise CorruptLineError(
            f"cannot be used as {line.type}: {error}", path=path, line=line.number
        ) from error


def check_header(data: bytes, path: Path, line: int) -> None:
    """Check that a line is the header of a recording in the supported format.

    Raises ValueError if it is not a header, or a field is missing or wrong. Raises RecordingVersionError if it is the
    header of another version of the format.
    """
    version = decode(_Versioned, data).version
    if version != FORMAT_VERSION:
        raise RecordingVersionError(
            f"the recording is of version {version}, this program reads version {FORMAT_VERSION}; "
            "use the program that wrote it or a newer one",
            path=path,
            line=line,
        )
    decode(RecordingHeader, data)
