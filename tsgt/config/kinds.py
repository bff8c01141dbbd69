"""All kinds of files, by the value of their top-level key ``kind``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from tsgt.config.client import ClientConfig
from tsgt.config.master import MasterConfig
from tsgt.config.scenario import ScenarioConfig
from tsgt.config.setup import PrismLayoutFile, StationFramesFile

if TYPE_CHECKING:
    from tsgt.config.base import Model

Config = Annotated[
    ClientConfig | MasterConfig | StationFramesFile | PrismLayoutFile | ScenarioConfig,
    Field(discriminator="kind"),
]

KINDS: dict[str, type[Model]] = {
    "client": ClientConfig,
    "master": MasterConfig,
    "station_frames": StationFramesFile,
    "prism_layout": PrismLayoutFile,
    "scenario": ScenarioConfig,
}
