"""What an operator sets up wrongly at a station: its configuration and key differ from what the master expects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tsgt.radio import LoRaSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class SetupMistake:
    """What differs at a station's client; the defaults are right."""

    key: bytes | None = None  # None: the mission's
    spreading_factor: int | None = None  # None: the mission's
    frequency_mhz: float | None = None  # None: the mission's
    other_protocol: bool = False  # whether it does not speak that of the mission
    station: int | None = None  # station number; None: its own
    prism: int | None = None  # that it tracks from the start; None: its own
    prism_constant_mm: float = 0.0  # what the instrument adds, besides the master

    @property
    def delivers(self) -> bool:
        """Whether the master gets its measurements as those of this station, at the latest after the correction."""
        return self.station is None and not self.other_protocol

    def applied_to(self, settings: LoRaSettings) -> LoRaSettings:
        """Return the settings of its radio."""
        if self.spreading_factor is not None:
            settings = replace(settings, spreading_factor=self.spreading_factor)
        if self.frequency_mhz is not None:
            settings = replace(settings, frequency_hz=round(self.frequency_mhz * 1e6))
        return settings


NO_MISTAKE = SetupMistake()
