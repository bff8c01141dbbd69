"""Types shared by the GeoCOM command tables: responses, jobs that take time, and table entries."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from tsgt.station.geocom import ReturnCode

if TYPE_CHECKING:
    from tsgt.simulation.instrument.model import ReportedDistance, TotalStationModel

Value = float | int | str | bytes
"""A double, an integer or boolean, a string, or bytes."""


@dataclass(frozen=True, slots=True)
class Response:
    """Response to a command."""

    code: int = 0  # GeoCOM return code of the command
    values: tuple[Value, ...] = ()
    com_code: int = 0  # return code of the transport; not 0: the request was not understood
    distance: ReportedDistance | None = None  # the distance measurement that ``values`` report, if any


OK = Response()
INVALID_PARAMETER = Response(ReturnCode.IVPARAM)

Job = Generator[int, None, Response]
"""A command that takes time: yields the true time in ns at which to resume, returns its response."""


class Command(NamedTuple):
    """Entry of a command table."""

    signature: str  # one letter per parameter: d double, i integer, s string, b byte
    execute: Callable[..., Response | Job]  # called with the instrument and the decoded parameters


Commands = Mapping[int, Command]
"""Commands by RPC number."""


def values(*given: Value) -> Response:
    """Return a successful response with these values."""
    return Response(values=given)


def getter(attribute: str) -> Command:
    """Return a command that reports one attribute of the settings; a tuple gives one value per item."""

    def execute(station: TotalStationModel) -> Response:
        value = getattr(station.settings, attribute)
        return values(*value) if isinstance(value, tuple) else values(value)

    return Command("", execute)


def setter(
    signature: str,
    attribute: str,
    valid: Callable[..., bool] = lambda *_: True,
    *,
    idle_only: bool = False,
    advance: bool = False,
) -> Command:
    """Return a command that sets one attribute of the settings to its parameters.

    Several parameters are stored as a tuple; one that replaces a boolean is stored as a boolean.

    Parameters
    ----------
    valid
        Range check of the parameters; IVPARAM if it fails.
    idle_only
        TMC_BUSY while a distance is stored or being measured, because the setting affects it.
    advance
        Bring the instrument up to date first, because the setting affects what it observes.
    """

    def execute(station: TotalStationModel, *parameters: Value) -> Response:
        if not valid(*parameters):
            return INVALID_PARAMETER
        if idle_only and station.has_distance():
            return Response(ReturnCode.TMC_BUSY)
        if advance:
            station.advance()
        value = parameters if len(parameters) > 1 else parameters[0]
        before = getattr(station.settings, attribute)
        setattr(station.settings, attribute, bool(value) if isinstance(before, bool) else value)
        return OK

    return Command(signature, execute)
