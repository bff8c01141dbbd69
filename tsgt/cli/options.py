"""Options and parameter types that several commands share."""

from __future__ import annotations

import math
import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from click.parser import _OptionParser, _ParsingState

    from tsgt.analysis.formats import TargetMeasurement
    from tsgt.model import Parameters, ReferencePoint

DEFAULT_SOCKET = Path("/run/tsgt/poses.sock")
DEFAULT_CLIENT_SOCKET = Path("/run/tsgt/client.sock")

RECORDING_SUFFIXES = (".jsonl", ".json")

_MEMORY_DEVICES = 1  # major number of /dev/null, zero, full, random and urandom


class _FilePath(click.Path):
    """A path; as an input no device that never ends, as an output also /dev/null and /dev/full."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Refuse a device before it is read."""
        path = Path(str(super().convert(value, param, ctx)))
        output = param is not None and "output" in (param.name or "")
        if not output and _is_endless(path):
            self.fail(f"{path} is a device, not a file", param, ctx)
        return path


def _is_endless(path: Path) -> bool:
    try:
        status = path.stat()
    except (OSError, ValueError):  # who opens it says what is wrong
        return False
    endless = os.major(status.st_rdev) == _MEMORY_DEVICES and path.resolve() != Path(os.devnull)
    return stat.S_ISBLK(status.st_mode) or (stat.S_ISCHR(status.st_mode) and endless)


path_type = _FilePath()


class FiniteRange(click.FloatRange):
    """A range of finite numbers; click's own range accepts NaN."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Reject NaN and infinity as well as what is out of range."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{number} is not a finite number", param, ctx)
        return number


class OutputFile(click.Path):
    """A file to write, whose format follows from its suffix; an unknown suffix is a usage error."""

    def __init__(self, *suffixes: str) -> None:
        super().__init__(path_type=Path)
        self.suffixes = suffixes

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Check the suffix before any work is done."""
        path = Path(str(super().convert(value, param, ctx)))
        if path.suffix not in self.suffixes:
            self.fail(unknown_suffix(path, self.suffixes), param, ctx)
        return path


def unknown_suffix(path: Path, known: tuple[str, ...]) -> str:
    """Return the message for an output file whose suffix selects no format."""
    problem = f"unknown suffix {path.suffix}" if path.suffix else "no suffix"
    return f"{path}: {problem}, so the format is unknown; known suffixes: {', '.join(known)}"


class PathsOption(click.Option):
    """An option that takes all following paths, up to the next option; may be repeated."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{**kwargs, "multiple": True, "type": path_type})

    def add_to_parser(self, parser: _OptionParser, ctx: click.Context) -> None:
        """Let the option consume more than one argument; click's ``nargs`` is a fixed number."""
        super().add_to_parser(parser, ctx)
        for name in self.opts:
            option = parser._long_opt[name]  # noqa: SLF001 (click has no public way)
            take_one = option.process

            def take_all(value: Any, state: _ParsingState, take_one: Callable[..., None] = take_one) -> None:
                take_one(value, state)
                while state.rargs and not state.rargs[0].startswith("-"):
                    take_one(state.rargs.pop(0), state)

            option.process = take_all  # type: ignore[method-assign]


constant_type = FiniteRange(-10_000, 10_000)
"""For reflector constants in mm: no reflector adds ten metres."""


def constant_option(name: str, text: str, *, required: bool = False) -> Callable[[Any], Any]:
    """Return an option for a reflector constant in mm. It has no default: a constant changes every result."""
    return click.option(name, type=constant_type, required=required, help=text)


def constant_m(
    option: str, given_mm: float | None, measurements: Iterable[TargetMeasurement], path: Path
) -> float:
    """Return the constant in m of the lines without ``constant_mm``; a usage error if there are some but no option."""
    if given_mm is None:
        for measurement in measurements:
            if measurement.constant_m is None:
                raise click.UsageError(
                    f"{path}, line {measurement.line}: has no constant_mm; give {option}, what is added to the distance (0 for foil "
                    "with most instruments)"
                )
    return (given_mm or 0.0) / 1e3


class PointType(click.ParamType[Any]):
    """A point of the robot: X,Y,Z in m, perhaps with a name and a rotation; or the name alone, as text.

    :func:`resolved_point` replaces a name by the point that it stands for.
    """

    name = "point"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parse the text; an impossible point is a usage error. The points that names stand for depend on the parameters."""
        from tsgt.estimation import parse_reference_point

        if not isinstance(value, str) or value.isidentifier():
            return value
        try:
            return parse_reference_point(value)
        except ValueError as error:
            self.fail(str(error), param, ctx)


def refuse_given(*names: str, because: str) -> None:
    """Raise UsageError if one of these options was given, which have no effect ``because`` of another."""
    context = click.get_current_context()
    for name in names:
        if context.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            raise click.UsageError(f"--{name.replace('_', '-')} has no effect {because}")


def resolved_point(
    point: ReferencePoint | str, parameters: Parameters, *, option: str = "--point"
) -> ReferencePoint:
    """Return a point that was given by its name or its coordinates; an unknown name is a usage error."""
    from tsgt.estimation import named_point

    if not isinstance(point, str):
        return point
    try:
        return named_point(parameters, point)
    except ValueError as error:
        raise click.UsageError(f"{option}: {error}") from error


_POINT_METAVAR = "NAME|[NAME=]X,Y,Z[,QX,QY,QZ,QW]"


def point_option(default: str = "as recorded, else the robot's origin") -> Callable[[Any], Any]:
    """Return the option for the reference point of poses; ``default``: what the point is without it."""
    return click.option(
        "--point",
        type=PointType(),
        metavar=_POINT_METAVAR,
        help="Reference point whose pose is given: robot, centroid, imu (its name), or position in m and quaternion in "
        f"the robot frame.  [default: {default}]",
    )


reference_point_option = click.option(
    "--reference-point",
    type=PointType(),
    metavar=_POINT_METAVAR,
    help="Reference point of the reference trajectory; values as for --point.  "
    "[default: as its file states, else the robot's origin]",
)

json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of text.")

socket_option = click.option(
    "--socket",
    "socket_path",
    type=path_type,
    default=DEFAULT_SOCKET,
    envvar="TSGT_SOCKET",
    show_envvar=True,
    help="UNIX socket of the pose stream.",
)

keep_going_option = click.option(
    "--keep-going", is_flag=True, help="Report and skip unreadable lines instead of stopping at the first."
)

recording_argument = click.argument("recording", type=path_type)

master_config_option = click.option(
    "--config", "config_path", type=path_type, required=True, help="Configuration of the master (TOML)."
)
