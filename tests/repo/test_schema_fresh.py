"""The JSON Schema of the stream and its field tables are up to date."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal

import pytest
from harness.files.records import (
    CLOCK,
    EVENT,
    HEADER,
    HELLO,
    NO_POSE,
    PARAMETERS,
    POINT,
    POSE,
    SETUP,
    STATUS,
    measurement,
)
from jsonschema import Draft202012Validator

from tsgt.master import schema
from tsgt.recording import encode_line

ROOT = Path(__file__).parents[2]
RECORDS = [HELLO, SETUP, measurement(0), POINT, POSE, NO_POSE, CLOCK, STATUS, EVENT, HEADER, PARAMETERS]


@pytest.fixture(scope="module")
def validator() -> Draft202012Validator:
    """Return a validator of the committed schema."""
    committed = json.loads((ROOT / schema.SCHEMA).read_text())
    Draft202012Validator.check_schema(committed)
    return Draft202012Validator(committed)


def decoded(record: object) -> dict[str, Any]:
    """Parse a record's line."""
    data: dict[str, Any] = json.loads(encode_line(record))
    return data


def test_generated_files_are_fresh() -> None:
    """If not, call `make generated`."""
    stale = [path.name for path, text in schema.generated_files(ROOT).items() if path.read_text() != text]
    assert stale == []


def test_pages_have_a_table_for_every_class() -> None:
    """The tables are between the marks."""
    for page, classes in schema.PAGES.items():
        text = (ROOT / page).read_text()
        generated = text[text.index(schema.BEGIN) : text.index(schema.END)]
        assert generated.count("| field | type | always? | meaning |") == len(classes)


@pytest.mark.parametrize("record", RECORDS, ids=lambda record: type(record).__name__)
def test_real_lines_are_valid(record: object, validator: Draft202012Validator) -> None:
    """Written lines satisfy the schema."""
    validator.validate(decoded(record))


def test_unknown_keys_are_valid(validator: Draft202012Validator) -> None:
    """A newer program may add keys."""
    validator.validate(decoded(POSE) | {"colour": "red"})


@pytest.mark.parametrize("record", RECORDS, ids=lambda record: type(record).__name__)
def test_line_without_a_key_is_invalid(record: object, validator: Draft202012Validator) -> None:
    """The program writes every key of a record."""
    for key in decoded(record):
        assert not validator.is_valid({name: value for name, value in decoded(record).items() if name != key})


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("covariance", [0.0] * 35),
        ("position_m", [1.0, 2.0]),
        ("kind", "guessed"),
        ("valid", None),
        ("stamp_ns", 0.5),
    ],
)
def test_wrong_value_is_invalid(key: str, value: object, validator: Draft202012Validator) -> None:
    """Sizes, enumerations and types are part of the schema."""
    assert not validator.is_valid(decoded(POSE) | {key: value})


@dataclasses.dataclass
class Undescribed:
    """A record with a field without description."""

    type: Literal["undescribed"]
    forgotten: int


def test_field_without_description_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """A new field needs a description in the docstring."""
    monkeypatch.setattr(schema, "LINE_TYPES", [*schema.LINE_TYPES, Undescribed])
    monkeypatch.setattr(schema, "PAGES", schema.PAGES | {Path("page.md"): (Undescribed,)})
    with pytest.raises(ValueError, match=r"Undescribed\.forgotten has no docstring"):
        schema.json_schema()


def test_every_class_in_the_schema_is_on_a_page() -> None:
    """A class that becomes part of a line appears in the tables."""
    objects = {
        name for name, definition in schema.json_schema()["$defs"].items() if "properties" in definition
    }
    assert objects == {cls.__name__ for classes in schema.PAGES.values() for cls in classes}
