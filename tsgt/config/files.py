"""Reading of configuration and set-up files, with one line per problem."""

from __future__ import annotations

import difflib
import json
import os
import stat
import tomllib
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from tsgt.config.base import Model
from tsgt.config.client import ClientConfig
from tsgt.config.master import MasterConfig
from tsgt.config.scenario import ScenarioConfig
from tsgt.config.setup import ImuMountingFile, PrismLayoutFile, SensorMountingFile, StationFramesFile
from tsgt.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path

    from pydantic_core import ErrorDetails

Config = Annotated[
    ClientConfig
    | MasterConfig
    | StationFramesFile
    | PrismLayoutFile
    | ImuMountingFile
    | SensorMountingFile
    | ScenarioConfig,
    Field(discriminator="kind"),
]

_MAX_BYTES = 4_000_000  # Bounds what is read of a large file

# All kinds of files, by the value of their top-level key ``kind``.
KINDS: dict[str, type[Model]] = {
    "client": ClientConfig,
    "master": MasterConfig,
    "station_frames": StationFramesFile,
    "prism_layout": PrismLayoutFile,
    "imu_mounting": ImuMountingFile,
    "sensor_mounting": SensorMountingFile,
    "scenario": ScenarioConfig,
}

M = TypeVar("M", bound=Model)

_SHOWN_CHARACTERS = 60


def load(path: Path, model: type[M]) -> M:
    """Read a TOML file of one kind, for example :class:`MasterConfig`.

    Raises ConfigError, with file, key and value, if it is missing or invalid TOML, of another kind, or a key or value is
    wrong.
    """
    raw = _read(path)
    kind = _kind(path, raw)
    if KINDS[kind] is not model:
        wanted = next(name for name, known in KINDS.items() if known is model)
        raise ConfigError(f'{path}: kind = "{kind}", but kind "{wanted}" is expected', path=path, key="kind")
    return _validated(path, raw, model)


def load_any(path: Path) -> Model:
    """Read a file of any kind; raises as :func:`load`."""
    raw = _read(path)
    return _validated(path, raw, KINDS[_kind(path, raw)])


def find_problems(path: Path) -> tuple[Model | None, list[ConfigError]]:
    """Read a file of any kind; return its content, or None and all its problems."""
    try:
        raw = _read(path)
        model = KINDS[_kind(path, raw)]
    except ConfigError as problem:
        return None, [problem]
    try:
        return _parsed(path, raw, model), []
    except ValidationError as error:
        return None, _problems(path, raw, model, error)


def json_schema(kind: str | None = None) -> dict[str, Any]:
    """Return the JSON Schema of one kind of file, or of all kinds."""
    if kind is not None:
        return KINDS[kind].model_json_schema()
    return TypeAdapter[Any](Config).json_schema()


def _read(path: Path) -> dict[str, Any]:
    try:
        with open(path, "rb", opener=_open_without_waiting) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise ConfigError(f"{path}: is a device or pipe, not a file; name a configuration", path=path)
            content = file.read(_MAX_BYTES + 1)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file", path=path) from None
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}", path=path) from error
    if len(content) > _MAX_BYTES:
        raise ConfigError(
            f"{path}: larger than {_MAX_BYTES // 1_000_000} MB; name a configuration", path=path
        )
    try:
        raw = tomllib.loads(content.decode("utf-8-sig"))
        # Validation and messages need it; fails for huge hexadecimal numbers and long dotted keys.
        json.dumps(raw, default=str)
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 text (byte {error.start})", path=path) from error
    except (tomllib.TOMLDecodeError, ValueError, RecursionError) as error:  # huge numbers, deep nesting
        raise ConfigError(f"{path}: not TOML: {error}", path=path) from error
    return raw


def _open_without_waiting(name: str, flags: int) -> int:
    """Open a file; a pipe does not block until somebody writes it."""
    return os.open(name, flags | os.O_NONBLOCK)


def _kind(path: Path, raw: dict[str, Any]) -> str:
    kind, known = raw.get("kind"), ", ".join(f'"{name}"' for name in KINDS)
    if kind is None:
        raise ConfigError(f"{path}: kind: missing key; one of {known} is expected", path=path, key="kind")
    if not isinstance(kind, str) or kind not in KINDS:
        raise ConfigError(f"{path}: kind = {_shown(kind)}: should be one of {known}", path=path, key="kind")
    return kind


def _validated(path: Path, raw: dict[str, Any], model: type[M]) -> M:
    try:
        return _parsed(path, raw, model)
    except ValidationError as error:
        raise _problems(path, raw, model, error)[0] from error


def _parsed(path: Path, raw: dict[str, Any], model: type[M]) -> M:
    # Through JSON, where arrays are valid tuples in strict mode.
    return model.model_validate_json(json.dumps(raw, default=str), context={"folder": path.parent})


def _problems(
    path: Path, raw: dict[str, Any], model: type[Model], error: ValidationError
) -> list[ConfigError]:
    """Return the problems, unknown keys first: a misspelt key is reported as unknown and as missing."""
    found = []
    for problem in sorted(error.errors(), key=lambda e: e["type"] != "extra_forbidden"):
        key = _key(_without_tags(problem["loc"], raw))
        found.append(ConfigError(f"{path}: {_explained(problem, key, model)}", path=path, key=key))
    return found


def _explained(problem: ErrorDetails, key: str, model: type[Model]) -> str:
    match problem["type"]:
        case "extra_forbidden":
            known = _known_keys(model, problem["loc"][:-1])
            near = difflib.get_close_matches(str(problem["loc"][-1]), known, n=1)
            hint = f"did you mean {near[0]}?" if near else f"known keys: {', '.join(known)}"
            return f"{key}: unknown key; {hint}"
        case "missing":
            return f"{key}: missing key"
        case "json_invalid":  # tables that are nested too deeply
            return f"cannot be read: {problem['ctx']['error']}"
        case "union_tag_not_found":
            return f"{key}.kind: missing key"
        case "union_tag_invalid":
            known_kinds = problem["ctx"]["expected_tags"].replace("'", '"')
            return f"{key}.kind = {_shown(problem['ctx']['tag'])}: should be one of {known_kinds}"
    message = str(problem["ctx"]["error"]) if problem["type"] == "value_error" else problem["msg"]
    message = message.removeprefix("Input ")
    if isinstance(problem["input"], dict) or problem["type"] == "value_error":
        return f"{key}: {message}" if key else message
    return f"{key} = {_shown(problem['input'])}: {message}"


def _shown(value: object) -> str:
    text = json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= _SHOWN_CHARACTERS else f"{text[: _SHOWN_CHARACTERS - 3]}..."


def _key(location: tuple[int | str, ...]) -> str:
    """Return a location in TOML notation, entries of an array by ordinal: ``stations[#2].prism``."""
    key = ""
    for part in location:
        if part == "[key]":  # pydantic's mark for the name of a table
            continue
        key += f"[#{part + 1}]" if isinstance(part, int) else f".{_name(part)}" if key else _name(part)
    return key


def _name(key: str) -> str:
    """Return a key in printable form; a quoted key may contain anything."""
    name = key if key.isprintable() else json.dumps(key)
    return name if len(name) <= _SHOWN_CHARACTERS else f"{name[: _SHOWN_CHARACTERS - 3]}..."


def _without_tags(location: tuple[int | str, ...], raw: Any) -> tuple[int | str, ...]:
    """Remove the tags of discriminated unions from a location."""
    place: list[int | str] = []
    for part in location:
        if isinstance(raw, dict) and part not in raw and raw.get("kind") == part:
            continue
        place.append(part)
        try:
            raw = raw[part]
        except (LookupError, TypeError):
            raw = None
    return tuple(place)


def _known_keys(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """Return the field names of the model at a location."""
    kinds: list[type[BaseModel]] = []
    for part in location:
        if isinstance(part, str) and part in model.model_fields:
            kinds = _innermost_models(model.model_fields[part].annotation)
            model = kinds[0] if kinds else model
        else:
            model = next((kind for kind in kinds if part in _names(kind)), model)
    return list(model.model_fields)


def _names(model: type[BaseModel]) -> tuple[Any, ...]:
    """Return the values of the key ``kind`` that select this model."""
    return get_args(model.model_fields["kind"].annotation) if "kind" in model.model_fields else ()


def _innermost_models(annotation: Any) -> list[type[BaseModel]]:
    """Return the models in an annotation such as ``tuple[StationConfig, ...]``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for arg in get_args(annotation) for found in _innermost_models(arg)]
