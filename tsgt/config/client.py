"""What the configuration of a station client holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from tsgt.config.base import Model, Positive, RelativePath
from tsgt.config.radio import ProtocolConfig, RadioConfig, check_numbers


class SimulatedInstrumentConfig(Model):
    """A simulated total station of `tsgt demo`, reached over a UNIX socket."""

    kind: Literal["simulated"]
    """The instrument is simulated."""
    socket: RelativePath
    """UNIX socket of the simulated instrument."""


InstrumentConfig = SimulatedInstrumentConfig


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
