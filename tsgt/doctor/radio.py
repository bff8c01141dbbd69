"""Checks of the radio: devices, chip, and legal limits of its settings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tsgt.config import HardwareRadioConfig, MasterConfig
from tsgt.doctor.finding import failed, note, ok, skipped
from tsgt.doctor.serial_line import access_hint
from tsgt.radio.from_config import lora_settings, wiring
from tsgt.radio.legality import RATE_HZ, legality
from tsgt.radio.sx127x import Chip, Register, RegisterAccess

if TYPE_CHECKING:
    from tsgt.config import ClientConfig, RadioConfig
    from tsgt.doctor.finding import Finding
    from tsgt.doctor.machine import Machine, User


def check_radio_devices(machine: Machine, config: RadioConfig, user: User) -> Finding:
    """Check that bus and pins exist and may be used."""
    if not isinstance(config, HardwareRadioConfig):
        return skipped("radio_devices", "the radio is simulated")
    bus = spi_device(machine, config)
    if not bus.exists():
        return failed(
            "radio_devices",
            f"{bus} does not exist: enable SPI (sudo raspi-config nonint do_spi 0) and reboot",
        )
    chips = sorted(machine.dev.glob("gpiochip*"))
    if config.wiring.gpio_chip is not None:
        chips = [Path(config.wiring.gpio_chip)]
    if config.wiring.backend == "gpiod" and not (chips and chips[0].exists()):
        return failed(
            "radio_devices",
            f"{chips[0] if chips else machine.dev / 'gpiochip*'} does not exist: the kernel has no driver for the pins; "
            "`gpiodetect` lists GPIO devices, gpio_chip under [radio.wiring] selects one",
        )
    devices = [bus, *(chips if config.wiring.backend == "gpiod" else [])]
    refused = [access_hint(machine, device, user) for device in devices if not user.may_use(device)]
    if refused:
        return failed("radio_devices", "; ".join(refused))
    return ok("radio_devices", f"{bus} and the pins exist, and the user {user.name} may use them")


def spi_device(machine: Machine, config: HardwareRadioConfig) -> Path:
    """Return the SPI device of the radio."""
    return machine.dev / f"spidev{config.wiring.spi_bus}.{config.wiring.spi_device}"


async def check_radio(machine: Machine, config: RadioConfig, path: Path, *, daemon: bool) -> Finding:
    """Check that the radio responds and accepts its settings, without transmitting; skipped while the daemon owns it."""
    if not isinstance(config, HardwareRadioConfig):
        return skipped("radio", "the radio is simulated")
    if daemon:
        return skipped("radio", "the running daemon has it open; `tsgt status` shows its status")
    bus = spi_device(machine, config)
    if not bus.exists():
        return skipped("radio", f"{bus} does not exist")
    if not machine.user.may_use(bus):
        return skipped("radio", f"the user {machine.user.name} may not use {bus}: sudo tsgt doctor")
    if holder := machine.port_holder(bus):
        return failed("radio", f"{bus} is open in {holder}: end it, or stop its service")
    settings = lora_settings(config, path)
    hal = machine.open_hal(wiring(config.wiring))
    try:
        chip = Chip(hal, machine.clock, settings)
        await chip.set_up()
        version = RegisterAccess(hal).read(Register.VERSION)
        connected = await chip.dio0_connected()
        chip.sleep()
    finally:
        hal.close()
    if not connected:
        return failed(
            "radio",
            f"the radio responds, but BCM {config.wiring.dio0_pin} does not follow its DIO0: packets would be read up to 100 ms "
            "late, and their times would be useless. Check the wire, or dio0_pin under [radio.wiring]",
        )
    return ok(
        "radio",
        f"the radio responds (version 0x{version:02X}) and accepts its settings; nothing was transmitted",
    )


def check_limits(config: ClientConfig | MasterConfig, path: Path) -> Finding:
    """Check power and duty cycle against the limits of the region and the chip."""
    found, radio = legality(config, path), config.radio
    settings, use = found.use.settings, found.use
    if isinstance(config, MasterConfig):
        duty = f"{100 * use.master_duty:.0f} % (master), {100 * use.station_duty:.0f} % (each of {found.stations} stations)"
    else:
        duty = f"at least {100 * use.station_duty:.0f} %"
    text = (
        f"{settings.frequency_hz / 1e6:g} MHz, SF {settings.spreading_factor}, {settings.bandwidth_hz / 1e3:g} kHz, "
        f"{settings.power_dbm} dBm into {radio.antenna_gain_dbi:g} dBi ({use.eirp_dbm:.1f} dBm e.i.r.p., "
        f"{use.erp_dbm:.1f} e.r.p.), duty cycle at {RATE_HZ:g} Hz: {duty}"
    )
    if found.violations:
        return failed(
            "limits", f"{text}. {'; '.join(found.violations)}. Under [radio], in all radios: {found.remedy}"
        )
    if found.warning is not None:
        return note("limits", f"{text}. {found.warning}")
    if radio.licence is not None:
        return note("limits", f"{text}; the licence {radio.licence!r} is stated, and its limits are unknown")
    if radio.region is None:
        return skipped("limits", f"{text}; nothing is transmitted, as the radio is simulated")
    return ok("limits", f"{text}; within the limits of {radio.region}")
