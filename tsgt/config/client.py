"""What the configuration of a station client holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from tsgt.config.base import Model, Positive, RelativePath
from tsgt.config.radio import ClassicConfig, RadioConfig


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
    station: Annotated[int, Field(ge=1, le=9)]
    """Number of this station; one digit, as it goes over the radio."""
    prism: Annotated[int, Field(ge=1, le=9)]
    """Number of the prism that it tracks from the start; one digit too."""
    instrument: InstrumentConfig
    """The total station."""
    radio: RadioConfig
    """The radio; the same modem settings as the master's."""
    protocol: ClassicConfig
    """What is spoken over it; the same as the master's."""
    journal: JournalConfig = JournalConfig()
    """What stays."""
    status_socket: RelativePath = Path("/run/tsgt/client.sock")
    """UNIX socket on which `tsgt status` asks."""
