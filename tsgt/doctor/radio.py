"""Checks of the radio: its devices, the chip behind them, and what the law says to its settings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tsgt.config import (
    ClassicConfig,
    ClassicMasterConfig,
    HardwareRadioConfig,
    MasterConfig,
    SuperframeMasterConfig,
)
from tsgt.doctor.finding import failed, note, ok, skipped
from tsgt.doctor.serial_line import no_right
from tsgt.radio.from_config import lora_settings, planned_cycle, wiring
from tsgt.radio.planning import DIPOLE_DBI, Load, Use, exceeded
from tsgt.radio.sx127x import Chip, Register, RegisterAccess

if TYPE_CHECKING:
    from tsgt.config import ClientConfig, MasterProtocolConfig, RadioConfig
    from tsgt.doctor.finding import Finding
    from tsgt.doctor.machine import Machine, User

STATIONS = 3
"""A client does not know how many stations there are; most missions have so many."""

RATE_HZ = 2.5


def check_radio_devices(machine: Machine, config: RadioConfig, user: User) -> Finding:
    """Tell whether bus and pins are there, and may be used."""
    if not isinstance(config, HardwareRadioConfig):
        return skipped("radio_devices", "the radio is simulated")
    bus = spi_device(machine, config)
    if not bus.exists():
        return failed(
            "radio_devices",
            f"there is no {bus}: switch SPI on (sudo raspi-config nonint do_spi 0) and reboot",
        )
    chips = sorted(machine.dev.glob("gpiochip*"))
    if config.wiring.gpio_chip is not None:
        chips = [Path(config.wiring.gpio_chip)]
    if config.wiring.backend == "gpiod" and not (chips and chips[0].exists()):
        return failed(
            "radio_devices",
            f"there is no {chips[0] if chips else machine.dev / 'gpiochip*'}: the kernel has no driver for the pins; "
            "`gpiodetect` lists them, gpio_chip under [radio.wiring] names one",
        )
    devices = [bus, *(chips if config.wiring.backend == "gpiod" else [])]
    refused = [no_right(machine, device, user) for device in devices if not user.may_use(device)]
    if refused:
        return failed("radio_devices", "; ".join(refused))
    return ok("radio_devices", f"{bus} and the pins are there, and the user {user.name} may use them")


def spi_device(machine: Machine, config: HardwareRadioConfig) -> Path:
    """Return the bus that the radio is on."""
    return machine.dev / f"spidev{config.wiring.spi_bus}.{config.wiring.spi_device}"


async def check_radio(machine: Machine, config: RadioConfig, path: Path, *, daemon: bool) -> Finding:
    """Tell whether the radio answers and takes its settings. Nothing is sent.

    Parameters
    ----------
    machine
        Opens it.
    config
        What stands under ``[radio]``.
    path
        In this file.
    daemon
        Whether the daemon runs and so has the radio; it is left alone then.
    """
    if not isinstance(config, HardwareRadioConfig):
        return skipped("radio", "it is simulated")
    if daemon:
        return skipped("radio", "the daemon that runs here has it; `tsgt status` says how it does")
    bus = spi_device(machine, config)
    if not bus.exists():
        return skipped("radio", f"there is no {bus}")
    if not machine.user.may_use(bus):
        return skipped("radio", f"you, {machine.user.name}, may not use {bus}: sudo tsgt doctor tries it")
    if holder := machine.port_holder(bus):
        return failed(
            "radio", f"{bus} is open in {holder}: end that one, or stop the service that it belongs to"
        )
    settings = lora_settings(config, path)
    hal = machine.open_hal(wiring(config.wiring))
    try:
        chip = Chip(hal, machine.clock, settings)
        await chip.set_up()
        version = RegisterAccess(hal).read(Register.VERSION)
        chip.sleep()
    finally:
        hal.close()
    return ok("radio", f"a radio answers (version 0x{version:02X}) and keeps its settings; nothing was sent")


def check_limits(config: ClientConfig | MasterConfig, path: Path) -> Finding:
    """Tell whether power and time on air are within what the region and the chip allow."""
    settings = lora_settings(config.radio, path)
    stations = len(config.stations) if isinstance(config, MasterConfig) else STATIONS
    cycle = planned_cycle(_protocol(config), Load(stations=stations, rate_hz=RATE_HZ), settings)
    use = Use(settings, DIPOLE_DBI, cycle.master_duty, cycle.station_duty)
    duty = cycle.master_duty if isinstance(config, MasterConfig) else cycle.station_duty
    text = (
        f"{settings.frequency_hz / 1e6:g} MHz, SF {settings.spreading_factor}, {settings.bandwidth_hz / 1e3:g} kHz, "
        f"{settings.power_dbm} dBm, sends {100 * duty:.0f} % of the time with {stations} stations"
    )
    found = [sentence.partition(". Would comply")[0] for sentence in exceeded(use, config.radio.region, ())]
    if found:
        plan = (
            f"tsgt radio plan --protocol {config.protocol.kind} --stations {stations} --sf {settings.spreading_factor} "
            f"--bandwidth-khz {settings.bandwidth_hz / 1e3:g} --frequency-mhz {settings.frequency_hz / 1e6:g} "
            f"--power-dbm {settings.power_dbm}"
        )
        if config.radio.region is not None:
            plan += f" --region {config.radio.region}"
        return note("limits", f"{text}. {'; '.join(found)}. What would comply: `{plan}`")
    if config.radio.region is None:
        return note(
            "limits",
            f'{text}; no region is named, so that nobody knows whether that is allowed: region = "EU868"',
        )
    return ok("limits", f"{text}; within the limits of {config.radio.region} that tsgt knows, with a dipole")


def _protocol(config: ClientConfig | MasterConfig) -> MasterProtocolConfig:
    """Return the protocol as the master runs it; a client takes the usual."""
    if isinstance(config, MasterConfig):
        return config.protocol
    if isinstance(config.protocol, ClassicConfig):
        return ClassicMasterConfig(kind="classic")
    return SuperframeMasterConfig(kind="superframe")
