"""Configuration of a station client."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import (
    Field,
    PlainSerializer,
    PlainValidator,
    ValidationInfo,
    WithJsonSchema,
    model_validator,
)

from tsgt.config.base import Argument, Model, Positive, RelativePath, SocketPath, relative_to_file
from tsgt.config.radio import ProtocolConfig, RadioConfig, check_numbers

Baud = Literal[2400, 4800, 9600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 921_600]

PrismType = Literal["round", "mini", "tape", "360", "mini_360", "mini_zero", "user", "grz121", "mpr122"]

MIN_SEARCH_RANGE_M: Final = 10

TemperatureC = Annotated[float, Field(ge=-60, le=70)]
PressureHpa = Annotated[float, Field(ge=400, le=1200)]


_TCP: Final = re.compile(
    r"tcp://(?:\[([0-9A-Fa-f:.]+(?:%\w+)?)\]|([A-Za-z0-9_.-]+)):([1-9]\d{0,4})/?", re.ASCII
)


@dataclass(frozen=True, slots=True)
class TcpAddress:
    """Address of an instrument, or of the device server that its serial line is connected to."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"tcp://[{self.host}]:{self.port}" if ":" in self.host else f"tcp://{self.host}:{self.port}"


def _instrument_port(value: object, info: ValidationInfo) -> Path | TcpAddress:
    """Return the address of ``tcp://HOST:PORT``, or the path of a device."""
    if isinstance(value, TcpAddress):
        return value
    if not isinstance(value, str | os.PathLike):
        raise ValueError("expected the path of a serial device, or tcp://HOST:PORT")  # noqa: TRY004 (pydantic expects it)
    text = os.fspath(value)
    if "://" not in text:
        return relative_to_file(Path(text), info)
    match = _TCP.fullmatch(text)
    if match is None or int(match[3]) >= 1 << 16:
        raise ValueError(
            f"{text}: expected tcp://HOST:PORT, for example tcp://192.168.1.10:1212, or tcp://[IPv6]:PORT"
        )
    return TcpAddress(match[1] or match[2], int(match[3]))


InstrumentPort = Annotated[
    Path | TcpAddress,
    PlainValidator(_instrument_port),
    PlainSerializer(str),
    WithJsonSchema({"type": "string"}),
]


class AtmosphereConfig(Model):
    """Air between instrument and prism, measured at the instrument."""

    temperature_c: TemperatureC
    """Temperature in the shade."""
    pressure_hpa: PressureHpa
    """Pressure at the instrument, not reduced to sea level."""


class LeicaInstrumentConfig(Model):
    """A Leica total station that speaks GeoCOM over a serial line or TCP: TPS1200+, TS15, TS16, TS30, TS60, MS50, MS60, ..."""

    kind: Literal["leica"]
    """A Leica instrument."""
    port: InstrumentPort
    """Serial device, preferably its name under /dev/serial/by-id/, which never changes; or ``tcp://HOST:PORT``, with less exact times."""
    baud: Baud = 115_200
    """Baud rate set in the instrument; other common rates are tried if it does not respond. Not for TCP."""
    checksum: bool = False
    """Whether to add a checksum to every line, for long cables and radio modems; older instruments do not support it."""
    prism_type: PrismType
    """Reflector on the robot; the instrument is set to it."""
    prism_constant_mm: Annotated[float, Field(ge=-1000, le=1000)] | None = None
    """Prism constant in Leica's convention (0 for a round prism); default: that of the type."""
    distance_mode: Literal["auto", "continuous_fast", "continuous_dynamic", "synchro"] = "auto"
    """Distance mode while tracking; "auto" selects the fastest that the instrument accepts."""
    latency_ms: Annotated[float, Field(ge=0, le=1000)] | None = None
    """Latency from a measurement to the fastest response, without a network, subtracted from each timestamp; default: that of the model, or 0."""
    angle_delay_ms: Annotated[float, Field(ge=-100, le=100)] | None = None
    """Delay of the angles after the distance; recorded, not corrected. Default: that of the model, or 0."""
    atmosphere: AtmosphereConfig | None = None
    """Atmospheric correction; default: the setting of the instrument."""
    search_window_deg: Annotated[float, Field(ge=1, le=360)] = 40.0
    """Width of the largest search window for a lost prism; a tenth of it, at least 1.5, is searched first."""
    search_height_deg: Annotated[float, Field(ge=1, le=90)] = 15.0
    """Height of the search window."""
    search_distance_m: tuple[Annotated[int, Field(ge=0, le=390)], Annotated[int, Field(ge=10, le=400)]] = (
        1,
        400,
    )
    """Range of distances in which the prism is searched; reflections outside are ignored."""
    reduced_field_of_view: bool = False
    """Whether to reduce the field of view to its centre, so that a neighbouring prism is not tracked instead."""
    target: Literal["foil", "prism"] = "foil"
    """Type of targets for single measurements."""
    target_faces: Literal[1, 2] = 1
    """Faces in which a target is measured; two cancel the axis errors and take 10 s longer."""

    @model_validator(mode="after")
    def _keys_fit_each_other(self) -> LeicaInstrumentConfig:
        if self.prism_type == "user" and self.prism_constant_mm is None:
            raise ValueError(
                'prism_type = "user" needs prism_constant_mm: the instrument may still have the constant of another prism'
            )
        min_m, max_m = self.search_distance_m
        if max_m < min_m + MIN_SEARCH_RANGE_M:
            raise ValueError(
                f"search_distance_m: {max_m} must be at least {MIN_SEARCH_RANGE_M} above {min_m}: an instrument accepts no smaller range"
            )
        return self


class BridgeInstrumentConfig(Model):
    """An instrument read by a user's program that prints one line per measurement; see docs/reference/bridge.md."""

    kind: Literal["bridge"]
    """An instrument behind a program."""
    command: Annotated[tuple[Argument, ...], Field(min_length=1)]
    """Program and arguments; it is restarted when it ends."""
    stall_timeout_s: Positive = 5.0
    """A program that prints no valid line for this long while it should measure is restarted."""
    latency_ms: Annotated[float, Field(ge=-1000, le=1000)] = 0.0
    """Latency from a measurement to the time that the program reports, subtracted from each timestamp."""


InstrumentConfig = Annotated[LeicaInstrumentConfig | BridgeInstrumentConfig, Field(discriminator="kind")]


class JournalConfig(Model):
    """Journal of the client; every measurement is written before it is used."""

    directory: RelativePath = Path("/var/lib/tsgt")
    """Folder of the journals, one per start."""
    fsync_interval_s: Positive = 1.0
    """Maximum loss after a power cut."""


class ClientConfig(Model):
    """Client of one total station: instrument in, radio out."""

    kind: Literal["client"]
    """Kind of this file."""
    station: Annotated[int, Field(ge=1, le=16)]
    """Station number: 1 to 9 with the protocol `classic`, 1 to 16 with `superframe`."""
    prism: Annotated[int, Field(ge=1, le=16)]
    """Number of the prism that is tracked after the start; same range."""
    instrument: InstrumentConfig
    """Total station."""
    radio: RadioConfig
    """Radio; modem settings as the master's."""
    protocol: ProtocolConfig
    """Radio protocol; as the master's."""
    journal: JournalConfig = JournalConfig()
    """Journal on disk."""
    status_socket: SocketPath = Path("/run/tsgt/client.sock")
    """UNIX socket for `tsgt status`."""

    @model_validator(mode="after")
    def _numbers_fit_the_protocol(self) -> ClientConfig:
        check_numbers(self.protocol, self.station, self.prism)
        return self
