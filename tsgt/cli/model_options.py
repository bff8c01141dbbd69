"""Options made from the fields of configuration models, so that name, type, range, default and help are defined once."""

from __future__ import annotations

import types
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args, get_origin

import click
from pydantic.fields import FieldInfo

from tsgt.cli.options import FiniteRange, path_type

if TYPE_CHECKING:
    from collections.abc import Callable

    from pydantic import BaseModel

    Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


def model_option(model: type[BaseModel], field: str, *declarations: str, **settings: Any) -> Decorator:
    """Make an option from a field of a model.

    Parameters
    ----------
    model, field
        Source of type, range, default and help.
    declarations
        Name of the option; by default that of the field. The command receives the value under the name of the field.
    settings
        Overrides, as of :func:`click.option`.
    """
    info = model.model_fields[field]
    if not declarations:
        declarations = (f"--{field.replace('_', '-')}",)
    default = None if info.is_required() else info.default
    made: dict[str, Any] = {"help": info.description, "default": default}
    if info.annotation is bool:
        made["is_flag"] = True
    else:
        made["type"] = param_type(info.annotation, info.metadata)
    return click.option(*declarations, field, **{**made, **settings})


def add_options(*options: Decorator) -> Decorator:
    """Return a decorator that adds options in the order in which the help shows them."""

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        for option in reversed(options):
            command = option(command)
        return command

    return add


def param_type(annotation: Any, metadata: list[Any]) -> click.ParamType[Any]:
    """Return click's type for a field's annotation and its bounds."""
    origin = get_origin(annotation)
    if origin in (Union, types.UnionType):
        (inner,) = (each for each in get_args(annotation) if each is not type(None))
        return param_type(inner, metadata)
    if origin is Annotated:
        inner, *extra = get_args(annotation)
        fields = [part for each in extra if isinstance(each, FieldInfo) for part in each.metadata]
        return param_type(inner, [*metadata, *fields])
    if origin is Literal:
        return click.Choice([str(value) for value in get_args(annotation)])
    bounds = {
        name: getattr(each, name)
        for each in metadata
        for name in ("ge", "gt", "le", "lt")
        if hasattr(each, name)
    }
    limits: dict[str, Any] = {
        "min": bounds.get("gt", bounds.get("ge")),
        "max": bounds.get("lt", bounds.get("le")),
        "min_open": "gt" in bounds,
        "max_open": "lt" in bounds,
    }
    if annotation is int:
        return click.IntRange(**limits)
    if annotation is float:
        return FiniteRange(**limits)
    return path_type if annotation is Path else click.STRING
