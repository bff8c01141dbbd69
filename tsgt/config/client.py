"""What the configuration of a station client holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from tsgt.config.base import Model, Positive, RelativePath
from tsgt.config.radio import ProtocolConfig, RadioConfig, check_numbers

Baud = Literal[2400, 4800, 9600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 921_600]

PrismType = Literal["round", "mini", "tape", "360", "mini_360", "mini_zero", "user", "grz121", "mpr122"]

TemperatureC = Annotated[float, Field(ge=-60, le=70)]
PressureHpa = Annotated[float, Field(ge=400, le=1200)]


class AtmosphereConfig(Model):
    """The air between instrument and prism, as thermometer and barometer beside the instrument show it."""

    temperature_c: TemperatureC
    """Temperature in the shade."""
    pressure_hpa: PressureHpa
    """Pressure at the instrument, not reduced to sea level."""


class LeicaInstrumentConfig(Model):
    """A Leica total station that speaks GeoCOM over a serial line: TPS1200+, TS15, TS16, TS30, TS60, MS50, MS60, ..."""

    kind: Literal["leica"]
    """A Leica instrument on a serial line."""
    port: RelativePath
    """The line; best a name under /dev/serial/by-id/, which stays the same when the cable is plugged in again."""
    baud: Baud = 115_200
    """Bits per second as set in the instrument; other usual ones are tried when it does not answer."""
    checksum: bool = False
    """Whether every line carries a checksum, for long cables and radio modems; older instruments cannot."""
    prism_type: PrismType
    """Which reflector is on the robot; the instrument is set to it."""
    prism_constant_mm: Annotated[float, Field(ge=-1000, le=1000)] | None = None
    """Constant that the instrument adds, in Leica's convention (a round prism has 0); without it that of the type."""
    distance_mode: Literal["auto", "continuous_fast", "continuous_dynamic", "synchro"] = "auto"
    """How it measures while tracking; "auto" takes the fastest that the instrument accepts."""
    latency_ms: Annotated[float, Field(ge=0, le=1000)] | None = None
    """From a measurement to the fastest answer, taken off each stamp; without it what is known of the model, or 0."""
    angle_delay_ms: Annotated[float, Field(ge=-100, le=100)] | None = None
    """By how much angles are newer than the distance; recorded, not corrected. Without it that of the model, or 0."""
    atmosphere: AtmosphereConfig | None = None
    """The air; without it the instrument keeps what a person has set in it."""
    search_window_deg: Annotated[float, Field(ge=1, le=360)] = 40.0
    """Width of the widest window in which it looks for a lost prism by itself; a tenth of it, at least 1.5, comes first."""
    search_height_deg: Annotated[float, Field(ge=1, le=90)] = 15.0
    """Height of that window."""
    search_distance_m: tuple[Annotated[int, Field(ge=0, le=390)], Annotated[int, Field(ge=10, le=400)]] = (
        1,
        400,
    )
    """Between these distances it looks for the prism: something shiny outside is passed over."""
    reduced_field_of_view: bool = False
    """Whether to see only the middle of the field of view, so that a neighbouring prism is not taken for the tracked one."""
    target: Literal["foil", "prism"] = "foil"
    """What single measurements are made of."""
    target_faces: Literal[1, 2] = 1
    """In how many faces a target is measured; with two the errors of the axes cancel, and a shot takes 10 s longer."""


class BridgeInstrumentConfig(Model):
    """An instrument read by a program of the user's, which prints a line for each measurement; see the page bridge."""

    kind: Literal["bridge"]
    """A program that knows the instrument."""
    command: Annotated[tuple[str, ...], Field(min_length=1)]
    """The program and its arguments; it is started again when it ends."""
    stall_timeout_s: Positive = 5.0
    """A program that says nothing for so long while it should measure has stalled, and is started again."""
    latency_ms: Annotated[float, Field(ge=-1000, le=1000)] = 0.0
    """From a measurement to the time that the program gives, taken off each stamp."""


InstrumentConfig = Annotated[LeicaInstrumentConfig | BridgeInstrumentConfig, Field(discriminator="kind")]


class JournalConfig(Model):
    """Where the client writes every measurement before anything else is done with it."""

    directory: RelativePath = Path("/var/lib/tsgt")
    """Folder that gets one journal per run."""
    fsync_interval_s: Positive = 1.0
    """What a power cut can cost at most."""


class ClientConfig(Model):
    """The client beside one total station: instrument in, radio out."""

    kind: Literal["client"]
    """What this file is."""
    station: Annotated[int, Field(ge=1, le=16)]
    """Number of this station; 1 to 9 with the protocol `classic`, to 16 with `superframe`."""
    prism: Annotated[int, Field(ge=1, le=16)]
    """Number of the prism that it tracks from the start; the same."""
    instrument: InstrumentConfig
    """The total station."""
    radio: RadioConfig
    """The radio; the same modem settings as the master's."""
    protocol: ProtocolConfig
    """What is spoken over it; the same as the master's."""
    journal: JournalConfig = JournalConfig()
    """What stays."""
    status_socket: RelativePath = Path("/run/tsgt/client.sock")
    """UNIX socket on which `tsgt status` asks."""

    @model_validator(mode="after")
    def _numbers_fit_the_protocol(self) -> ClientConfig:
        check_numbers(self.protocol, self.station, self.prism)
        return self
