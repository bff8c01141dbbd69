"""The commands ``config check`` and ``config schema``."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from tsgt.cli.composition import radio_key
from tsgt.cli.options import json_option, path_type
from tsgt.cli.output import print_json
from tsgt.config import (
    KINDS,
    ClassicConfig,
    ClientConfig,
    ImuMountingFile,
    MasterConfig,
    Model,
    PrismLayoutFile,
    ScenarioConfig,
    SensorMountingFile,
    StationFramesFile,
    SuperframeConfig,
    check_permissions,
    find_problems,
    json_schema,
    missing_setup_files,
    parameters_in_force,
    scenario_parameters,
)
from tsgt.errors import ConfigError, GeometryError
from tsgt.geometry import check_layout
from tsgt.model import MIN_PRISMS, Parameters, PrismPosition
from tsgt.radio.legality import check_legality

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

USAGE_ERROR = 2


@click.group("config")
def config() -> None:
    """Check configuration and set-up files."""


@config.command()
@click.argument("files", type=path_type, nargs=-1, required=True, metavar="FILE...")
@json_option
def check(*, files: tuple[Path, ...], as_json: bool) -> int:
    """Check files as a daemon does when it starts.

    FILE is a configuration, a set-up file or a scenario; the files that it names are checked as well. All problems of
    all files are reported. Run it as the user of the daemon, who alone may read the key.

    Exit code 2: a daemon would not start. --json prints "ok" and, under "files", a list with "file", "ok", "errors"
    and a summary of each file.
    """
    reports = [_report(file) for file in files]
    ok = all(report["ok"] for report in reports)
    if as_json:
        print_json({"ok": ok, "files": reports})
    for report in reports:
        if not as_json and report["ok"]:
            _print(report, heading=len(files) > 1)
        for problem in report["errors"]:
            click.echo(f"error: {problem}", err=True)
    return 0 if ok else USAGE_ERROR


@config.command()
@click.option("--kind", type=click.Choice(list(KINDS)), help="Kind of file.  [default: all]")
def schema(kind: str | None) -> None:
    """Print the JSON Schema of configuration files."""
    click.echo(json.dumps(json_schema(kind), indent=2))


def _report(file: Path) -> dict[str, Any]:
    content, problems = find_problems(file)
    summary: dict[str, Any] = {}
    if content is not None:
        summary["kind"] = next(kind for kind, model in KINDS.items() if type(content) is model)
        problems = problems_at_start(file, content)
        if not problems:
            summary |= _summary(content)
    errors = list(dict.fromkeys(str(problem) for problem in problems))
    return {"file": str(file), "ok": not errors, "errors": errors, **summary}


def problems_at_start(file: Path, content: Model, *, key_owner: int | None = None) -> list[ConfigError]:
    """Return what keeps a daemon from starting although the file itself is valid.

    ``key_owner``: user id of the daemon, who must own the key; None: that of this process.
    """
    problems: list[ConfigError] = []

    def attempt(step: Callable[..., object], *arguments: Any, **options: Any) -> None:
        try:
            step(*arguments, **options)
        except ConfigError as problem:
            problems.append(problem)

    if not isinstance(content, ScenarioConfig):
        attempt(check_permissions, file)
    if isinstance(content, ClientConfig | MasterConfig):
        attempt(check_legality, content, file)
        attempt(radio_key, content.protocol, owner=key_owner)
    match content:
        case MasterConfig():
            before = len(problems)
            missing = missing_setup_files(content)
            for path in content.setup_files:
                if path in missing:
                    continue
                problems += find_problems(path)[1]
                attempt(check_permissions, path)
            if len(problems) == before:
                attempt(_check_master, file, content)
        case ScenarioConfig():
            prisms = scenario_parameters(content).prisms
            attempt(_check_layout, file, prisms, imu=content.imu.model != "none")
        case PrismLayoutFile():
            positions = [
                PrismPosition(prism=int(number), position_m=entry.position_m)
                for number, entry in content.prisms.items()
            ]
            attempt(_check_layout, file, tuple(positions), imu=len(positions) < MIN_PRISMS)
    return problems


def _check_master(file: Path, config: MasterConfig) -> None:
    try:
        known = parameters_in_force(config)
    except ConfigError as error:
        if error.path is None:
            raise ConfigError(f"{file}: {error}", path=file, key=error.key) from error
        raise
    if known.no_poses is None:  # the layout exists
        _check_layout(config.setup.prism_layout, known.prisms, imu=known.imu is not None)


def _check_layout(path: Path, prisms: tuple[PrismPosition, ...], *, imu: bool) -> None:
    names = [prism.prism for prism in prisms]
    try:
        check_layout(np.array([prism.position_m for prism in prisms]).reshape(-1, 3), names=names, imu=imu)
    except GeometryError as error:
        raise ConfigError(f"{path}: prisms: {error}", path=path, key="prisms") from error


def _summary(content: Model) -> dict[str, Any]:
    match content:
        case MasterConfig():
            known = parameters_in_force(content)
            return {
                **_numbers(known),
                **({} if known.no_poses is None else {"no_poses": known.no_poses}),
                **_protocol(content.protocol),
                "socket": str(content.stream.socket),
                "recordings": str(content.recording.directory),
            }
        case ClientConfig():
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
            return {**_numbers(known), "name": content.name, "duration_s": content.duration_s}
        case PrismLayoutFile():
            prisms = [int(number) for number in content.prisms]
            return {"prisms": prisms, **({"needs": "an IMU"} if len(prisms) < MIN_PRISMS else {})}
        case StationFramesFile():
            return {"stations": [int(number) for number in content.stations]}
        case ImuMountingFile():
            return {"position_m": content.position_m, "latency_ms": content.latency_ms}
        case SensorMountingFile():
            return {"position_m": content.position_m, "offset_ms": content.offset_ms}
    raise TypeError(f"no summary for {type(content).__name__}")


def _protocol(protocol: ClassicConfig | SuperframeConfig) -> dict[str, Any]:
    if not isinstance(protocol, SuperframeConfig):
        return {"protocol": protocol.kind}
    key = (
        "none, unauthenticated: anybody can take part"
        if protocol.key_file is None
        else str(protocol.key_file)
    )
    return {"protocol": protocol.kind, "key": key}


def _numbers(known: Parameters) -> dict[str, Any]:
    return {
        "stations": [station.station for station in known.stations],
        "prisms": [prism.prism for prism in known.prisms],
        "estimator": known.pipeline.estimator,
        "rate_hz": 1e9 / known.pipeline.period_ns,
        **({} if known.imu is None else {"imu": known.imu.name}),
    }


def _print(report: dict[str, Any], *, heading: bool) -> None:
    if heading:
        click.echo(f"# {report['file']}")
    for key, value in report.items():
        if key not in ("file", "ok", "errors"):
            text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
            click.echo(f"{key.replace('_', ' '):16}{text}")
