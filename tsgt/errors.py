"""Every error that tsgt raises on purpose.

::

    TsgtError
    ├── ConfigError            a configuration or set-up file cannot be used
    ├── InputFileError         a data file from outside cannot be used
    ├── OutputFileError        a result cannot be written
    ├── MissingExtraError      a library that an extra of tsgt brings is not installed
    ├── RecordingError         a recording or journal cannot be read or written
    │   ├── CorruptLineError   one of its lines cannot be read
    │   └── RecordingVersionError  it was written in another version of the format
    ├── GeometryError          numbers that no geometry can be computed from
    │   └── DegenerateGeometryError  points that coincide or lie in a line
    ├── StreamError            a socket of ours cannot be opened or reached
    ├── MessageError           bytes or numbers that make no packet of ours
    ├── InstrumentError        the total station does not do what it was told, or is gone
    │   └── InstrumentRefusedError  it answers, and will not do this: a licence or a target is missing
    └── RadioError             the radio does not do what it was told
        ├── RadioSettingsError     it was told something that it cannot do
        ├── RadioNotFoundError     there is none: wiring, pins, SPI
        └── RadioTimeoutError      a transmission did not end

A message says what happened, where, and what to do; the same data is kept in attributes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

_QUOTED_CHARACTERS = 60


def quoted(text: str) -> str:
    """Quote what an input says, as far as there is room for it in one line of an error."""
    shown = repr(text)
    return shown if len(shown) <= _QUOTED_CHARACTERS else f"{shown[: _QUOTED_CHARACTERS - 3]}..."


class TsgtError(Exception):
    """Base of all errors that tsgt raises on purpose; its text is one line for the user."""


class ConfigError(TsgtError):
    """A configuration or set-up file cannot be used: unknown key, bad value, missing file."""

    def __init__(self, message: str, *, path: Path | None = None, key: str | None = None) -> None:
        super().__init__(message)
        self.path = path
        self.key = key


class InputFileError(TsgtError):
    """A data file from outside cannot be used: empty, wrong columns, NaN, time running backwards."""

    def __init__(self, message: str, *, path: Path, line: int | None = None) -> None:
        where = str(path) if line is None else f"{path}, line {line}"
        super().__init__(f"{where}: {message}")
        self.path = path
        self.line = line


class OutputFileError(TsgtError):
    """A result cannot be written: no room on the disk, no such folder, no permission."""

    def __init__(self, message: str, *, path: Path) -> None:
        super().__init__(f"{path}: {message}")
        self.path = path


class MissingExtraError(TsgtError, ImportError):
    """A library that only some commands need is not installed: matplotlib, mcap."""

    def __init__(self, purpose: str, *, library: str, extra: str) -> None:
        super().__init__(f"{purpose} need {library}, which is not installed: pip install 'tsgt[{extra}]'")
        self.library = library
        self.extra = extra


class RecordingError(TsgtError):
    """A recording cannot be read or written: no header, no room on the disk, no such station."""

    def __init__(self, message: str, *, path: Path, line: int | None = None) -> None:
        where = str(path) if line is None else f"{path}, line {line}"
        super().__init__(f"{where}: {message}")
        self.path = path
        self.line = line


class CorruptLineError(RecordingError):
    """A line in the middle of a recording is not what its writer can have written."""


class RecordingVersionError(RecordingError):
    """The recording was written in a version of the format that this program does not read."""


class GeometryError(TsgtError, ValueError):
    """Numbers that no geometry can be computed from: wrong shape, NaN, a distance below zero."""


class DegenerateGeometryError(GeometryError):
    """Points that coincide or lie in a line where a plane or a volume is needed."""


class StreamError(TsgtError, OSError):
    """A socket (poses, simulated air) cannot be opened or reached: it is in use, or nobody serves it."""


class MessageError(TsgtError, ValueError):
    """Bytes that are no message of ours, or a message that does not go into its fields: foreign, cut off, damaged."""


class InstrumentError(TsgtError):
    """The total station does not do what it was told: unplugged, switched off, no target, garbage on the line."""


class InstrumentRefusedError(InstrumentError):
    """The total station answers, but cannot or will not do this: no licence, no target. Trying again changes nothing."""


class RadioError(TsgtError):
    """The radio does not do what it was told: a register does not keep its value, a pin is taken, SPI fails."""


class RadioSettingsError(RadioError, ValueError):
    """Settings or a payload that the radio cannot take: SF 6, 20 dBm not asked for, 256 bytes."""


class RadioNotFoundError(RadioError):
    """No radio answers: SPI is switched off, a wire or the chip-select pin is wrong, the chip is another one."""


class RadioTimeoutError(RadioError, TimeoutError):
    """A transmission did not end when it had to; the radio has been reset."""
