"""Generate docs/reference/configuration.md from the models: ``python -m tsgt.config.reference FILE``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tsgt.config.files import KINDS, json_schema

if TYPE_CHECKING:
    from collections.abc import Iterator

_INTRODUCTION = """\
# Configuration and set-up files

Generated from the models (`make generated`); do not edit. All files are TOML. The key `kind` selects the kind of file;
unknown keys are errors; a path is relative to the folder of the file that contains it. Commented examples are in
`configs/`, and `tsgt config check FILE...` reports all problems of files.
"""


def markdown() -> str:
    """Return the page: one section per kind of file, one table per TOML table."""
    return "\n".join([_INTRODUCTION, *map(_section, KINDS)])


def _section(kind: str) -> str:
    schema = json_schema(kind)
    tables = "\n".join(_tables(schema, schema.get("$defs", {}), heading=""))
    return f"## `{kind}`\n\n{schema['description'].replace('``', '`')}\n{tables}"


def _tables(
    model: dict[str, Any], definitions: dict[str, Any], heading: str, kind: str = ""
) -> Iterator[str]:
    """Yield the table of a model's keys, then the tables of its inner models."""
    own, within = [], []
    required = model.get("required", [])
    for key, field in model["properties"].items():
        inner, name = _inner_models(key, field, definitions, heading)
        if inner:
            within += [(each, name, each_kind) for each_kind, each in inner.items()]
            continue
        default = "required" if key in required else _default(field.get("default"))
        own.append(f"| `{key}` | {default} | {_cell(field['description'])} |")
    if own:
        title = ""
        if heading:
            one_of = f' with `kind = "{kind}"`' if kind else ""
            title = f"`{heading}`{one_of}: {_cell(model['description'])}\n\n"
        yield "\n".join([f"\n{title}| key | default | meaning |", "|---|---|---|", *own, ""])
    for each, name, each_kind in within:
        yield from _tables(each, definitions, name, each_kind)


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
