"""From the radio's configuration to the parameters of driver and protocols."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.config import ClassicMasterConfig
from tsgt.errors import ConfigError, RadioSettingsError
from tsgt.radio.base import LoRaSettings
from tsgt.radio.classic import LinkTiming
from tsgt.radio.planning import MIN_POWER_DBM, classic_cycle, preset_power_dbm, superframe_cycle
from tsgt.radio.superframe import FrameTiming
from tsgt.radio.sx127x import Wiring

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.config import MasterProtocolConfig, ModemConfig, WiringConfig
    from tsgt.radio.planning import CycleEstimate, TrafficLoad


def lora_settings(config: ModemConfig, path: Path) -> LoRaSettings:
    """Return the modem settings of section ``[radio]`` in the file ``path``.

    Raises ConfigError if the chip has no such bandwidth, the region has no such channel and there is no licence, or
    20 dBm are not allowed.
    """
    frequency_hz, bandwidth_hz = round(config.frequency_mhz * 1e6), round(config.bandwidth_khz * 1e3)
    try:
        power_dbm = MIN_POWER_DBM if config.power_dbm is None else config.power_dbm
        if config.region is not None:
            try:
                preset = preset_power_dbm(
                    config.region,
                    frequency_hz=frequency_hz,
                    bandwidth_hz=bandwidth_hz,
                    antenna_gain_dbi=config.antenna_gain_dbi,
                )
            except RadioSettingsError:
                if config.licence is None:
                    raise
                preset = MIN_POWER_DBM  # the licence's limit is unknown
            power_dbm = preset if config.power_dbm is None else config.power_dbm
        if power_dbm == 20 and not config.allow_20_dbm:
            raise RadioSettingsError(
                "power_dbm = 20 harms the radio above 1 % duty cycle; use 17, or add allow_20_dbm = true"
            )
        return LoRaSettings(
            frequency_hz=frequency_hz,
            spreading_factor=config.spreading_factor,
            bandwidth_hz=bandwidth_hz,
            coding_rate=config.coding_rate,
            preamble_symbols=config.preamble_symbols,
            sync_word=config.sync_word,
            power_dbm=power_dbm,
        )
    except RadioSettingsError as error:
        raise ConfigError(f"{path}: radio: {error}", path=path, key="radio") from error


def wiring(config: WiringConfig) -> Wiring:
    """Return the wiring of the radio."""
    return Wiring(
        backend=config.backend,
        spi_bus=config.spi_bus,
        spi_device=config.spi_device,
        spi_hz=config.spi_hz,
        reset_pin=config.reset_pin,
        dio0_pin=config.dio0_pin,
        nss_pin=None if config.nss_pin < 0 else config.nss_pin,
        gpio_chip=config.gpio_chip,
    )


def planned_cycle(protocol: MasterProtocolConfig, load: TrafficLoad, settings: LoRaSettings) -> CycleEstimate:
    """Predict the cycle of a protocol with the master's settings."""
    if isinstance(protocol, ClassicMasterConfig):
        return classic_cycle(
            load,
            LinkTiming(settings, round(protocol.reply_timeout_ms * 1e6)),
            resync_cycles=protocol.resync_cycles,
            resync_interval_ns=round(protocol.resync_interval_s * 1e9),
        )
    timing = FrameTiming.from_tolerances(
        settings,
        start_jitter_ns=round(protocol.start_jitter_ms * 1e6),
        turnaround_ns=round(protocol.turnaround_ms * 1e6),
        clock_error_ppm=protocol.clock_error_ppm,
    )
    return superframe_cycle(load, timing, phase_lock=protocol.phase_lock)
