"""Whether a daemon's configuration obeys the law of its region, and the settings that would."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, NamedTuple

from tsgt.config import (
    MAX_STATION_NUMBERS,
    ClassicConfig,
    ClassicMasterConfig,
    MasterConfig,
    SuperframeMasterConfig,
)
from tsgt.errors import ConfigError
from tsgt.radio.from_config import lora_settings, planned_cycle
from tsgt.radio.planning import ChannelUse, TrafficLoad, chip_violation, compliant_use, violations

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tsgt.config import ClientConfig, MasterProtocolConfig
    from tsgt.radio.base import LoRaSettings

RATE_HZ = 2.5
"""Measurement rate of an instrument, which no configuration states; the duty cycles follow from it."""
FASTER_HZ = (5.0, 10.0, 20.0)
"""Rates of other instruments, whose longer replies may violate a limit that is kept at :data:`RATE_HZ`."""


class Legality(NamedTuple):
    """The use of a channel, and the law.

    Attributes
    ----------
    use
        At :data:`RATE_HZ`, of the master with its stations; of a client, whose master decides their number, with as many stations as there
        may be: a station of fewer transmits more.
    stations
        Number of stations for which that is.
    violations
        A sentence for each violated limit of the region; empty without a region, or with a licence.
    remedy
        One line that complies, as keys of ``[radio]``; None: nothing is violated.
    warning
        What the chip does not tolerate, whatever the law says; or what faster instruments would violate.
    """

    use: ChannelUse
    stations: int
    violations: tuple[str, ...]
    remedy: str | None
    warning: str | None


def legality(config: ClientConfig | MasterConfig, path: Path) -> Legality:
    """Compare the configuration in the file ``path`` with the law; raises as :func:`lora_settings`."""
    radio = config.radio
    stations = (
        len(config.stations)
        if isinstance(config, MasterConfig)
        else MAX_STATION_NUMBERS[config.protocol.kind]
    )

    def plan(settings: LoRaSettings, rate_hz: float = RATE_HZ) -> ChannelUse:
        cycle = planned_cycle(_protocol(config), TrafficLoad(stations=stations, rate_hz=rate_hz), settings)
        return ChannelUse(settings, radio.antenna_gain_dbi, cycle.master_duty, cycle.station_duty)

    use = plan(lora_settings(radio, path))
    found: list[str] = []
    remedy = None
    warning = chip_violation(use)
    if radio.region is not None and radio.licence is None:
        found = violations(use, radio.region)
        if found:
            remedy = remedy_text(use, compliant_use(use, radio.region, plan))
        elif warning is None:
            warning = _faster_violation(partial(plan, use.settings), radio.region)
    return Legality(use, stations, tuple(found), remedy, warning)


def _faster_violation(plan: Callable[[float], ChannelUse], region: str) -> str | None:
    for rate_hz in FASTER_HZ:
        if found := violations(plan(rate_hz), region):
            return f"With instruments that measure at {rate_hz:g} Hz it would violate {'; '.join(found)}"
    return None


def check_legality(config: ClientConfig | MasterConfig, path: Path) -> None:
    """Raise ConfigError for a configuration that would break the law of its region."""
    found = legality(config, path)
    if found.violations:
        raise ConfigError(
            f"{path}: radio: {'; '.join(found.violations)}. Remedy: {found.remedy}, or state your licence: "
            'licence = "..."',
            path=path,
            key="radio",
        )


def remedy_text(use: ChannelUse, compliant: ChannelUse) -> str:
    """Return the keys of ``[radio]`` that change, in one line."""
    old, new = use.settings, compliant.settings
    changes: list[str] = []
    if new.frequency_hz != old.frequency_hz:
        changes.append(f"frequency_mhz = {new.frequency_hz / 1e6:g}")
    if new.bandwidth_hz != old.bandwidth_hz:
        changes.append(f"bandwidth_khz = {new.bandwidth_hz / 1e3:g}")
    if new.power_dbm != old.power_dbm:
        changes.append(f"power_dbm = {new.power_dbm}")
    attenuation_db = use.antenna_gain_dbi - compliant.antenna_gain_dbi
    if attenuation_db > 0:
        changes.append(
            f"antenna_gain_dbi = {compliant.antenna_gain_dbi:g} by an attenuator of {attenuation_db:.1f} dB"
        )
    return ", ".join(changes)


def _protocol(config: ClientConfig | MasterConfig) -> MasterProtocolConfig:
    """Return the protocol settings of the master; for a client the defaults."""
    if isinstance(config, MasterConfig):
        return config.protocol
    if isinstance(config.protocol, ClassicConfig):
        return ClassicMasterConfig(kind="classic")
    return SuperframeMasterConfig(kind="superframe")
