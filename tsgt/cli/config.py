"""The commands ``config check`` and ``config schema``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
import numpy as np

from tsgt.cli.options import json_option
from tsgt.cli.output import print_json
from tsgt.config import (
    KINDS,
    ClassicConfig,
    ClientConfig,
    MasterConfig,
    Model,
    PrismLayoutFile,
    ScenarioConfig,
    StationFramesFile,
    SuperframeConfig,
    json_schema,
    load_any,
    parameters,
    scenario_parameters,
)
from tsgt.errors import ConfigError, GeometryError
from tsgt.geometry import check_layout
from tsgt.model import Parameters, PrismPosition
from tsgt.radio.from_config import lora_settings


@click.group("config")
def config() -> None:
    """Check configuration and set-up files, and describe what may stand in them."""


@config.command()
@click.argument("file", type=click.Path(path_type=Path))
@json_option
def check(file: Path, as_json: bool) -> None:  # noqa: FBT001 (click passes options by name)
    """Check FILE, of whatever kind it is, together with the files that it names."""
    content = load_any(file)
    summary = {
        "kind": next(kind for kind, model in KINDS.items() if type(content) is model),
        **_summary(file, content),
    }
    if as_json:
        print_json({"file": str(file), **summary})
        return
    for key, value in summary.items():
        click.echo(f"{key.replace('_', ' '):16}{_text(value)}")


@config.command()
@click.option("--kind", type=click.Choice(list(KINDS)), help="Only this kind of file; else all of them.")
def schema(kind: str | None) -> None:
    """Print the JSON Schema of configuration and set-up files."""
    click.echo(json.dumps(json_schema(kind), indent=2))


def _summary(file: Path, content: Model) -> dict[str, Any]:
    """Say what the file comes to, after the checks that need more than the file itself."""
    match content:
        case MasterConfig():
            known = parameters(content)
            lora_settings(content.radio, file)
            _check_layout(content.setup.prism_layout, known.prisms)
            return {
                **_numbers(known),
                **_protocol(content.protocol),
                "socket": str(content.stream.socket),
                "recordings": str(content.recording.directory),
            }
        case ClientConfig():
            lora_settings(content.radio, file)
            return {
                "station": content.station,
                "prism": content.prism,
                "instrument": content.instrument.kind,
                **_protocol(content.protocol),
                "journal": str(content.journal.directory),
                "socket": str(content.status_socket),
            }
        case ScenarioConfig():
            known = scenario_parameters(content)
            _check_layout(file, known.prisms)
            return {**_numbers(known), "name": content.name, "duration_s": content.duration_s}
        case PrismLayoutFile():
            prisms = tuple(
                PrismPosition(prism=int(number), position_m=entry.position_m)
                for number, entry in content.prisms.items()
            )
            _check_layout(file, prisms)
            return {"prisms": [prism.prism for prism in prisms]}
        case StationFramesFile():
            return {"stations": [int(number) for number in content.stations]}
    raise TypeError(f"no summary for {type(content).__name__}")


def _protocol(protocol: ClassicConfig | SuperframeConfig) -> dict[str, Any]:
    """Name protocol and key. The key itself is its user's alone, so that who checks may not be able to read it."""
    said: dict[str, Any] = {"protocol": protocol.kind}
    if isinstance(protocol, SuperframeConfig):
        key = protocol.key_file
        said["key"] = "none, anybody can take part" if key is None else str(key)
        if key is not None and not key.exists():
            said["key"] += " (there is no such file; `tsgt radio key` makes one)"
    return said


def _numbers(known: Parameters) -> dict[str, Any]:
    return {
        "stations": [station.station for station in known.stations],
        "prisms": [prism.prism for prism in known.prisms],
        "estimator": known.pipeline.estimator,
        "rate_hz": 1e9 / known.pipeline.period_ns,
    }


def _check_layout(path: Path, prisms: tuple[PrismPosition, ...]) -> None:
    names = [prism.prism for prism in prisms]
    try:
        check_layout(np.array([prism.position_m for prism in prisms]).reshape(-1, 3), names=names)
    except GeometryError as error:
        raise ConfigError(f"{path}: prisms: {error}", path=path, key="prisms") from error


def _text(value: object) -> str:
    return ", ".join(str(item) for item in value) if isinstance(value, list) else str(value)
