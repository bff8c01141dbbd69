"""The exceptions of tsgt.

::

    TsgtError
    ├── ConfigError            invalid configuration or set-up file
    ├── InputFileError         invalid data file from another program
    ├── OutputFileError        a result cannot be written
    ├── MissingExtraError      a library of an extra of tsgt is not installed
    ├── RecordingError         a recording or journal cannot be read or written
    │   ├── CorruptLineError   one of its lines cannot be read
    │   └── RecordingVersionError  its format has another version
    ├── GeometryError          invalid numbers for a geometric computation
    │   └── DegenerateGeometryError  coincident or collinear points
    ├── StreamError            a socket cannot be opened or reached
    ├── MessageError           invalid message of a radio protocol
    ├── ComputerSuspendedError  the computer was suspended, its clock stood still
    ├── InstrumentError        the total station failed to execute a command, or is not reachable
    │   └── InstrumentRefusedError  it cannot execute this command: no licence or no target
    └── RadioError             the radio failed
        ├── RadioSettingsError     unsupported settings or payload
        ├── RadioNotFoundError     no radio: wiring, pins, SPI
        └── RadioTimeoutError      a transmission did not end

A message states what happened, where, and what to do; attributes hold the same data.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

_QUOTED_CHARACTERS = 60


def quoted(text: str) -> str:
    """Quote text from an input, shortened to fit into one line of an error."""
    shown = repr(text)
    return shown if len(shown) <= _QUOTED_CHARACTERS else f"{shown[: _QUOTED_CHARACTERS - 3]}..."


class TsgtError(Exception):
    """Base of the exceptions of tsgt; the message is one line for the user."""


class ConfigError(TsgtError):
    """Invalid configuration or set-up file: unknown key, bad value, missing file."""

    def __init__(self, message: str, *, path: Path | None = None, key: str | None = None) -> None:
        super().__init__(message)
        self.path = path
        self.key = key


class _FileError(TsgtError):
    """Base of errors with a place in a file."""

    def __init__(self, message: str, *, path: Path, line: int | None = None) -> None:
        where = str(path) if line is None else f"{path}, line {line}"
        super().__init__(f"{where}: {message}")
        self.path = path
        self.line = line


class InputFileError(_FileError):
    """Invalid data file from another program: empty, wrong columns, NaN, time running backwards."""


class OutputFileError(_FileError):
    """A result cannot be written: disk full, no such folder, no permission."""


class MissingExtraError(TsgtError, ImportError):
    """An optional library is not installed: matplotlib, mcap."""

    def __init__(self, purpose: str, *, library: str, extra: str) -> None:
        super().__init__(
            f"{purpose} need {library}, which is not installed: pip install 'tsgt[{extra}]'; the offline bundle does not contain it"
        )
        self.library = library
        self.extra = extra


class RecordingError(_FileError):
    """A recording cannot be read or written: no header, disk full, no such station."""


class CorruptLineError(RecordingError):
    """A line in the middle of a recording cannot have been written by its writer."""


class RecordingVersionError(RecordingError):
    """The version of a recording's format is not supported."""


class GeometryError(TsgtError, ValueError):
    """Invalid numbers for a geometric computation: wrong shape, NaN, negative distance."""


class DegenerateGeometryError(GeometryError):
    """Coincident or collinear points where a plane or a volume is needed."""


class StreamError(TsgtError, OSError):
    """A socket (poses, simulated radio channel) cannot be opened or reached: in use, or no server."""


class MessageError(TsgtError, ValueError):
    """Bytes that do not form a valid message, or a message with values that do not fit its fields."""


class ComputerSuspendedError(TsgtError):
    """The computer was suspended: CLOCK_MONOTONIC stood still for ``for_s``."""

    def __init__(self, for_s: float) -> None:
        super().__init__(
            f"this computer was suspended for {for_s:.1f} s; keep it from sleeping during a mission"
        )
        self.for_s = for_s


class InstrumentError(TsgtError):
    """The total station failed to execute a command: unplugged, switched off, no target, garbage on the line."""


class InstrumentRefusedError(InstrumentError):
    """The total station responds but cannot execute this command: no licence, no target. Retrying is useless."""


class RadioError(TsgtError):
    """The radio failed: a register does not keep its value, a pin is in use, SPI fails."""


class RadioSettingsError(RadioError, ValueError):
    """Unsupported settings or payload: SF 6, 20 dBm without permission, 256 bytes."""


class RadioNotFoundError(RadioError):
    """No radio responds: SPI disabled, wrong wiring or chip-select pin, another chip."""


class RadioTimeoutError(RadioError, TimeoutError):
    """A transmission did not end in time; the radio was reset."""
