"""What may be transmitted where: limits of regions and chip, the violations of a planned use, and a use that complies.

ERC/REC 70-03 and EN 300 220-2 (Europe, e.r.p.); 47 CFR 15.247 and 15.249 (USA), RSS-247 and RSS-210 (Canada); SX1276 data
sheet. As of 2026; the local law decides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

from tsgt.errors import RadioSettingsError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tsgt.radio.base import LoRaSettings

MAX_PRESET_DBM = 17  # above it the chip has its own limit of 1 % duty cycle

MIN_POWER_DBM = 2  # minimum of PA_BOOST

WIDE_HZ = 500_000  # from this bandwidth on, a fixed channel is a digital modulation by 15.247(a)(2)

DIPOLE_DBI = 2.15  # difference of e.i.r.p. and e.r.p.

NARROW_EIRP_DBM = -1.25  # 15.249: 50 mV/m at 3 m, for a fixed channel of any bandwidth

WIDE_DBM = 30  # 15.247(b)(3): 1 W into the antenna

WIDE_GAIN_DBI = 6  # 15.247(b)(4): gain above this reduces the allowed power

CHIP_DBM = 20
CHIP_DUTY = 0.01  # duty cycle limit of the chip at +20 dBm


@dataclass(frozen=True, slots=True)
class Band:
    """A range of frequencies with one set of limits.

    Attributes
    ----------
    low_hz, high_hz
        A channel may extend over adjoining bands; then the stricter limits apply.
    erp_dbm
        Limit of the radiated power; None: that of North America, which depends on the bandwidth.
    duty_cycle
        Limit within any hour; None: unlimited.
    unlimited_duty_erp_dbm
        Power up to which the duty cycle is unlimited.
    """

    low_hz: int
    high_hz: int
    erp_dbm: float | None = None
    duty_cycle: float | None = None
    unlimited_duty_erp_dbm: float | None = None


# 25 mW are 14 dBm, 10 mW are 10 dBm, 1 mW is 0 dBm.
_NORTH_AMERICA = (Band(902_000_000, 928_000_000),)
REGIONS: dict[str, tuple[Band, ...]] = {
    "EU868": (
        Band(863_000_000, 865_000_000, 14, 0.001),
        Band(865_000_000, 868_600_000, 14, 0.01),
        Band(868_700_000, 869_200_000, 14, 0.001),
        Band(869_400_000, 869_650_000, 27, 0.1),
        Band(869_700_000, 870_000_000, 14, 0.01, unlimited_duty_erp_dbm=7),
    ),
    # At 1 mW a bandwidth above 250 kHz is limited to -13 dBm per 10 kHz as well: 4 dBm in 500 kHz.
    "EU433": (Band(433_050_000, 434_790_000, 10, 0.1, unlimited_duty_erp_dbm=0),),
    "US915": _NORTH_AMERICA,
    "CA915": _NORTH_AMERICA,
}


class Channel(NamedTuple):
    """Carrier frequency and bandwidth."""

    frequency_hz: int
    bandwidth_hz: int


CHANNELS: dict[str, Channel] = {
    "EU868": Channel(869_850_000, 250_000),
    "EU433": Channel(433_920_000, 250_000),
    "US915": Channel(905_000_000, WIDE_HZ),
    "CA915": Channel(905_000_000, WIDE_HZ),
}
"""Default channel of a region: the one with the highest power at an unlimited duty cycle."""


def bands_of(region: str, *, frequency_hz: int, bandwidth_hz: int) -> tuple[Band, ...]:
    """Return the band of a channel, or the adjoining bands; raises RadioSettingsError outside the region's bands."""
    low_hz, high_hz = frequency_hz - bandwidth_hz // 2, frequency_hz + bandwidth_hz // 2
    touched = tuple(band for band in REGIONS[region] if band.low_hz < high_hz and low_hz < band.high_hz)
    if (
        touched
        and touched[0].low_hz <= low_hz
        and high_hz <= touched[-1].high_hz
        and all(one.high_hz == other.low_hz for one, other in pairwise(touched))
    ):
        return touched
    bands = ", ".join(f"{band.low_hz / 1e6:g} to {band.high_hz / 1e6:g}" for band in REGIONS[region])
    raise RadioSettingsError(
        f"{frequency_hz / 1e6:g} MHz with {bandwidth_hz / 1e3:g} kHz is not within a band of {region} "
        f"({bands} MHz); choose another frequency"
    )


def power_limit_dbm(region: str, *, frequency_hz: int, bandwidth_hz: int, antenna_gain_dbi: float) -> float:
    """Return the limit of the power at the antenna connector, where there is one at an unlimited duty cycle.

    Elsewhere :func:`duty_cycle_limit` has to be kept as well.

    ``antenna_gain_dbi``: less the loss of the cable. Raises RadioSettingsError for a channel outside the region.
    """
    limits_dbm = []
    for band in bands_of(region, frequency_hz=frequency_hz, bandwidth_hz=bandwidth_hz):
        if band.erp_dbm is not None:
            erp_dbm = band.erp_dbm if band.unlimited_duty_erp_dbm is None else band.unlimited_duty_erp_dbm
            limits_dbm.append(erp_dbm + DIPOLE_DBI - antenna_gain_dbi)
        elif bandwidth_hz >= WIDE_HZ:
            limits_dbm.append(WIDE_DBM - max(antenna_gain_dbi - WIDE_GAIN_DBI, 0))
        else:
            limits_dbm.append(NARROW_EIRP_DBM - antenna_gain_dbi)
    return min(limits_dbm)


def duty_cycle_limit(region: str, *, frequency_hz: int, bandwidth_hz: int) -> float | None:
    """Return the limit of the duty cycle within any hour at the power of :func:`power_limit_dbm`; None: unlimited.

    Raises RadioSettingsError for a channel outside the region.
    """
    limits = [
        band.duty_cycle
        for band in bands_of(region, frequency_hz=frequency_hz, bandwidth_hz=bandwidth_hz)
        if band.duty_cycle is not None and band.unlimited_duty_erp_dbm is None
    ]
    return min(limits, default=None)


def preset_power_dbm(
    region: str, *, frequency_hz: int, bandwidth_hz: int, antenna_gain_dbi: float = DIPOLE_DBI
) -> int:
    """Return the largest power that the limit of :func:`power_limit_dbm` allows, within those of the chip."""
    limit_dbm = power_limit_dbm(
        region, frequency_hz=frequency_hz, bandwidth_hz=bandwidth_hz, antenna_gain_dbi=antenna_gain_dbi
    )
    return min(max(math.floor(limit_dbm + _ROUNDING_DB), MIN_POWER_DBM), MAX_PRESET_DBM)


_ROUNDING_DB = 1e-9  # of sums of gains


class ChannelUse(NamedTuple):
    """The planned use of a channel.

    ``antenna_gain_dbi``: of each antenna, less the loss of its cable. ``master_duty``, ``station_duty``: duty cycle of
    the master, and of each station.
    """

    settings: LoRaSettings
    antenna_gain_dbi: float
    master_duty: float
    station_duty: float

    @property
    def duty(self) -> float:
        """The largest duty cycle of a radio."""
        return max(self.master_duty, self.station_duty)

    @property
    def eirp_dbm(self) -> float:
        """Radiated power, relative to an isotropic antenna."""
        return self.settings.power_dbm + self.antenna_gain_dbi

    @property
    def erp_dbm(self) -> float:
        """Radiated power, relative to a dipole."""
        return self.eirp_dbm - DIPOLE_DBI


def chip_violation(use: ChannelUse) -> str | None:
    """Return a sentence if the chip does not tolerate the use."""
    if use.settings.power_dbm < CHIP_DBM or use.duty <= CHIP_DUTY:
        return None
    return (
        f"the chip allows {CHIP_DBM} dBm for {_percent(CHIP_DUTY)} of the time (SX1276 data sheet); {_duty_text(use)}: "
        f"use {MAX_PRESET_DBM} dBm"
    )


def violations(use: ChannelUse, region: str) -> list[str]:
    """Return a sentence for each violated limit of a region; raises RadioSettingsError for a channel outside of it."""
    settings = use.settings
    violated: list[str] = []
    for band in bands_of(region, frequency_hz=settings.frequency_hz, bandwidth_hz=settings.bandwidth_hz):
        if band.erp_dbm is None:
            violated += _american(use, region)
        else:
            violated += _european(use, region, band, band.erp_dbm)
    return violated


def compliant_use(use: ChannelUse, region: str, plan: Callable[[LoRaSettings], ChannelUse]) -> ChannelUse:
    """Return a use without violations that changes as little as possible.

    Power first, then channel, then less gain of the antenna, which an attenuator or a longer cable gives. ``plan``:
    returns the use of the channel with other settings.
    """
    return next(
        candidate for candidate in _candidates(use, region, plan) if not violations(candidate, region)
    )


def _candidates(
    use: ChannelUse, region: str, plan: Callable[[LoRaSettings], ChannelUse]
) -> Iterator[ChannelUse]:
    here, there = Channel(use.settings.frequency_hz, use.settings.bandwidth_hz), CHANNELS[region]
    for channel in (here, there):
        power_dbm = preset_power_dbm(
            region, **channel._asdict(), antenna_gain_dbi=use.antenna_gain_dbi
        )  # fmt: skip
        yield plan(replace(use.settings, **channel._asdict(), power_dbm=power_dbm))
    # The limit falls by a decibel per decibel of gain, at most: as much gain as the smallest power allows.
    limit_dbm = power_limit_dbm(region, **there._asdict(), antenna_gain_dbi=use.antenna_gain_dbi)
    gain_dbi = math.floor(10 * (use.antenna_gain_dbi + limit_dbm - MIN_POWER_DBM) + _ROUNDING_DB) / 10
    quiet = plan(replace(use.settings, **there._asdict(), power_dbm=MIN_POWER_DBM))
    yield quiet._replace(antenna_gain_dbi=gain_dbi)


def _european(use: ChannelUse, region: str, band: Band, limit_dbm: float) -> list[str]:
    violated = []
    name = f"{region}, {band.low_hz / 1e6:g} to {band.high_hz / 1e6:g} MHz (ERC/REC 70-03)"
    free_dbm = band.unlimited_duty_erp_dbm
    if use.erp_dbm > limit_dbm + _ROUNDING_DB:
        violated.append(f"{name}: at most {limit_dbm:g} dBm e.r.p.; {_power_text(use)} are {use.erp_dbm:.1f}")
    if band.duty_cycle is None or use.duty <= band.duty_cycle:
        return violated
    if free_dbm is None:
        violated.append(
            f"{name}: a radio may transmit for {_percent(band.duty_cycle)} of any hour; {_duty_text(use)}"
        )
    elif use.erp_dbm > free_dbm + _ROUNDING_DB:
        violated.append(
            f"{name}: above {free_dbm:g} dBm e.r.p. a radio may transmit for {_percent(band.duty_cycle)} of any hour; "
            f"{_power_text(use)} are {use.erp_dbm:.1f}, and {_duty_text(use)}"
        )
    return violated


def _american(use: ChannelUse, region: str) -> list[str]:
    narrow, wide = ("RSS-210", "RSS-247") if region.startswith("CA") else ("47 CFR 15.249", "47 CFR 15.247")
    settings, gain_dbi = use.settings, use.antenna_gain_dbi
    if settings.bandwidth_hz >= WIDE_HZ:
        limit_dbm = WIDE_DBM - max(gain_dbi - WIDE_GAIN_DBI, 0)
        sentence = (
            f"{region} ({wide}): with an antenna of {gain_dbi:g} dBi at most {limit_dbm:g} dBm; it is "
            f"{settings.power_dbm} dBm"
        )
        return [sentence] if settings.power_dbm > limit_dbm + _ROUNDING_DB else []
    sentence = (
        f"{region} ({narrow}): a fixed channel of {settings.bandwidth_hz / 1000:g} kHz may radiate {NARROW_EIRP_DBM} "
        f"dBm e.i.r.p. (50 mV/m at 3 m), from {WIDE_HZ // 1000} kHz on {WIDE_DBM} dBm at the connector ({wide}); "
        f"{_power_text(use)} are {use.eirp_dbm:.1f}"
    )
    return [sentence] if use.eirp_dbm > NARROW_EIRP_DBM + _ROUNDING_DB else []


def _power_text(use: ChannelUse) -> str:
    return f"{use.settings.power_dbm} dBm into {use.antenna_gain_dbi:g} dBi"


def _duty_text(use: ChannelUse) -> str:
    return (
        f"the master transmits for {_percent(use.master_duty)}, each station for {_percent(use.station_duty)}"
    )


def _percent(part: float) -> str:
    return f"{100 * part:.3g} %"
