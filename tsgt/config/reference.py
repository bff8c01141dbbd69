"""Generate docs/reference/configuration.md from the models: ``python -m tsgt.config.reference FILE``."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tsgt.config.files import KINDS, json_schema

if TYPE_CHECKING:
    from collections.abc import Iterator

_WIDE = 1000  # Bounds from here on only keep nonsense out

_INTRODUCTION = """\
# Configuration and set-up files

Generated from the models (`make generated`); do not edit. All files are TOML. The key `kind` selects the kind of file;
unknown keys are errors; a path is relative to the folder of the file that contains it. "required" for a key of a table that may
be left out means: required if there is that table. Commented examples are in `configs/`, and `tsgt config check FILE...` reports all
problems of files, also where keys do not go together.
"""


def markdown() -> str:
    """Return the page: one section per kind of file, one table per TOML table."""
    return "\n".join([_INTRODUCTION, *map(_section, KINDS)])


def _section(kind: str) -> str:
    schema = json_schema(kind)
    tables = "\n".join(_tables(schema, schema.get("$defs", {}), heading=""))
    return f"## `{kind}`\n\n{schema['description'].replace('``', '`')}\n{tables}"


def _tables(
    model: dict[str, Any], definitions: dict[str, Any], heading: str, title: str = "", kind: str = ""
) -> Iterator[str]:
    """Yield the table of a model's keys, then the tables of its inner models; ``title``: without that of the model."""
    own, within = [], []
    required = model.get("required", [])
    for key, field in model["properties"].items():
        inner, name = _inner_models(key, field, definitions, heading)
        if inner:
            its_title = f"`{name}`, {'required' if key in required else 'may be left out'}"
            # Of one that may be missing the field says what that means.
            about = f"{field['description']} " if "anyOf" in field else ""
            within += [(each, name, its_title, about, each_kind) for each_kind, each in inner.items()]
            continue
        default = "required" if key in required else _default(field.get("default"))
        own.append(f"| `{key}` | {default} | {_cell(field['description'])}{_values(field)} |")
    if own:
        if heading:
            one_of = f', with `kind = "{kind}"`' if kind else ""
            title = f"{title}{one_of}: {_cell(model['description'])}\n\n"
        yield "\n".join([f"\n{title}| key | default | meaning |", "|---|---|---|", *own, ""])
    for each, name, its_title, about, each_kind in within:
        described = {**each, "description": about + each["description"]}
        yield from _tables(described, definitions, name, its_title, each_kind)


def _inner_models(
    key: str, field: dict[str, Any], definitions: dict[str, Any], heading: str
) -> tuple[dict[str, dict[str, Any]], str]:
    """Return the inner models of a key by kind, and the TOML notation of its table."""
    path = f"{heading.strip('[]')}.{key}".strip(".")
    if "discriminator" in field:
        kinds = field["discriminator"]["mapping"]
        return {kind: definitions[_name(reference)] for kind, reference in kinds.items()}, f"[{path}]"
    (numbered,) = field.get("patternProperties", {"": {}}).values()
    for place, name in (
        (field, f"[{path}]"),
        (field.get("anyOf", [{}])[0], f"[{path}]"),
        (field.get("items", {}), f"[[{path}]]"),
        (numbered, f"[{path}.NUMBER]"),
    ):
        if "$ref" in place:
            return {"": definitions[_name(place["$ref"])]}, name
    return {}, path


def _values(field: dict[str, Any]) -> str:
    """Return the words or the range that a key takes, as sentences; not a range that is wide or that its description states."""
    one = field.get("anyOf", [field])[0]
    found = ""
    for place in (one, one.get("items", {})):
        if "enum" in place:
            found += f" One of {', '.join(f'`{_toml(each)}`' for each in place['enum'])}."
        low, high = place.get("minimum"), place.get("maximum", _WIDE)
        above, below = place.get("exclusiveMinimum"), place.get("exclusiveMaximum")
        stated = re.search(r"\d to \d", field["description"])
        if below is None and high < _WIDE and not stated:
            lowest = f"Above {above:g}" if above is not None else f"{low:g}"
            found += f" {lowest}{', at most' if above is not None else ' to'} {high:g}."
    most = one.get("maxItems")
    if most is not None and most != one.get("minItems"):
        found += f" At most {most}."
    return found


def _name(reference: str) -> str:
    return reference.rsplit("/", 1)[-1]


def _cell(description: str) -> str:
    """Return a docstring as one line."""
    return " ".join(description.replace("``", "`").split())


def _default(value: Any) -> str:
    return "not set" if value is None else f"`{_toml(value)}`"


def _toml(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else str(value)


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(markdown())
