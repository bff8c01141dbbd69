"""What the operator decides: the answers that a configuration is written from, and those that an existing one contains."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

from tsgt.config import (
    ClientConfig,
    HardwareRadioConfig,
    LeicaInstrumentConfig,
    MasterConfig,
    SuperframeConfig,
    WiringConfig,
)

if TYPE_CHECKING:
    from collections.abc import Collection

    from tsgt.config import RadioConfig
    from tsgt.setup.mission import Mission

NO_INSTRUMENT = "/dev/serial/by-id/none-yet"
"""Port of a station whose instrument is not there yet; the client waits for it, and says so."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RadioAnswers:
    """Channel, antenna and wiring of a radio; ``power_dbm``: None for the most that the region allows."""

    region: str | None
    antenna_gain_dbi: float
    licence: str | None
    frequency_mhz: float
    bandwidth_khz: float
    spreading_factor: int
    coding_rate: int
    preamble_symbols: int
    sync_word: int
    power_dbm: int | None
    wiring: WiringConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class StationAnswers:
    """Answers of a station; ``prism_constant_mm``: None for that of the type."""

    station: int
    prism: int
    port: str
    baud: int
    checksum: bool
    prism_type: str
    prism_constant_mm: float | None
    radio: RadioAnswers

    @classmethod
    def of(cls, config: ClientConfig) -> StationAnswers | None:
        """Return the answers in a configuration; None for one with an instrument, radio or protocol of another kind."""
        radio = _radio(config.radio)
        instrument = config.instrument
        if (
            radio is None
            or not isinstance(instrument, LeicaInstrumentConfig)
            or not isinstance(config.protocol, SuperframeConfig)
        ):
            return None
        return cls(
            station=config.station,
            prism=config.prism,
            port=str(instrument.port),
            baud=instrument.baud,
            checksum=instrument.checksum,
            prism_type=instrument.prism_type,
            prism_constant_mm=instrument.prism_constant_mm,
            radio=radio,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class MasterAnswers:
    """Answers of a master. Stations have the numbers from 1, and track the prism of their own number."""

    stations: int
    radio: RadioAnswers

    @classmethod
    def of(cls, config: MasterConfig) -> MasterAnswers | None:
        """Return the answers in a configuration; None for one with a radio or protocol of another kind."""
        radio = _radio(config.radio)
        if radio is None or not isinstance(config.protocol, SuperframeConfig):
            return None
        return cls(stations=len(config.stations), radio=radio)


def differing_answers(
    before: StationAnswers | MasterAnswers, asked: StationAnswers | MasterAnswers, *, found: Collection[str]
) -> list[str]:
    """Return the names of the answers that a configuration has otherwise than asked for.

    ``found``: names of those that nobody asked for, as setup found them itself.
    """
    pairs = [(before, asked), (before.radio, asked.radio)]
    return [
        each.name
        for one, other in pairs
        for each in fields(one)
        if each.name not in ("radio", *found) and getattr(one, each.name) != getattr(other, each.name)
    ]


def of_mission(
    mission: Mission,
    *,
    antenna_gain_dbi: float,
    licence: str | None,
    power_dbm: int | None,
    wiring: WiringConfig,
) -> RadioAnswers:
    """Return the answers for a radio of a mission."""
    return RadioAnswers(
        region=mission.region,
        antenna_gain_dbi=antenna_gain_dbi,
        licence=licence,
        frequency_mhz=mission.frequency_hz / 1e6,
        bandwidth_khz=mission.bandwidth_hz / 1e3,
        spreading_factor=mission.spreading_factor,
        coding_rate=mission.coding_rate,
        preamble_symbols=mission.preamble_symbols,
        sync_word=mission.sync_word,
        power_dbm=power_dbm,
        wiring=wiring,
    )


def _radio(config: RadioConfig) -> RadioAnswers | None:
    if not isinstance(config, HardwareRadioConfig):
        return None
    return RadioAnswers(
        region=config.region,
        antenna_gain_dbi=config.antenna_gain_dbi,
        licence=config.licence,
        frequency_mhz=config.frequency_mhz,
        bandwidth_khz=config.bandwidth_khz,
        spreading_factor=config.spreading_factor,
        coding_rate=config.coding_rate,
        preamble_symbols=config.preamble_symbols,
        sync_word=config.sync_word,
        power_dbm=config.power_dbm,
        wiring=config.wiring,
    )
