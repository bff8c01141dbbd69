"""What an operator changes in the configuration of a daemon in the middle of a mission, and takes back later."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from tsgt.config import ReferencePointConfig, ScenarioConfig
    from tsgt.radio import LoRaSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class MasterEdit:
    """What differs in the master's configuration; the defaults change nothing."""

    pipeline: Mapping[str, object] = field(default_factory=dict)  # keys of ``[pipeline]``
    reference_point: ReferencePointConfig | None = None
    prism_constants_by_mm: float = 0.0  # added to those of all stations
    without_station: int | None = None  # removed from the list of stations
    frequency_mhz: float | None = None  # of the radio: a mistake, no station hears it

    def applied_to(self, scenario: ScenarioConfig) -> ScenarioConfig:
        """Return the scenario from which the master's configuration is made."""
        stations = tuple(
            each.model_copy(update={"prism_constant_mm": each.prism_constant_mm + self.prism_constants_by_mm})
            for each in scenario.stations
            if each.station != self.without_station
        )
        return scenario.model_copy(
            update={
                "pipeline": scenario.pipeline.model_copy(update=self.pipeline),
                "reference_point": self.reference_point or scenario.reference_point,
                "stations": stations,
            }
        )

    def applied_to_radio(self, settings: LoRaSettings) -> LoRaSettings:
        """Return the settings of the radio."""
        if self.frequency_mhz is None:
            return settings
        return replace(settings, frequency_hz=round(self.frequency_mhz * 1e6))


NO_EDIT = MasterEdit()
