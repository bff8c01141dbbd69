"""What may be transmitted where: presets of power per region, and limits. Data, and two questions to it.

From ERC/REC 70-03 and EN 300 220-2 (Europe, power is e.r.p.) and 47 CFR 15.247 and 15.249 (USA, likewise RSS-247 in
Canada), as of 2026. For the presets an antenna like a dipole is assumed, so that e.r.p. is the power at the pin. The
law of the place decides, not this table.

What law and chip allow, held against what is planned: each limit that is exceeded, and what would comply.

ERC/REC 70-03 and EN 300 220-2 for Europe; 47 CFR 15.247 and 15.249 for the USA, RSS-247 and RSS-210 for Canada; the
SX1276's data sheet. As of 2026; the law of the place decides, not this module.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

from tsgt.errors import RadioSettingsError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.radio.base import LoRaSettings

HIGHEST_DBM = 17
"""More is not a preset: +20 dBm is the chip's own exception, at 1 % duty cycle."""

LOWEST_DBM = 2
"""The least that PA_BOOST gives."""

WIDE_HZ = 500_000
"""From this bandwidth on a fixed channel is a digital modulation in the sense of 15.247(a)(2)."""


@dataclass(frozen=True, slots=True)
class Band:
    """A range of frequencies with one set of limits.

    Attributes
    ----------
    low_hz, high_hz
        The channel must lie within, or within this and its neighbours; then the stricter limits count.
    power_dbm
        Preset at the PA_BOOST pin.
    erp_dbm
        Most that may be radiated, in terms of a dipole; None: the limit is not of this kind.
    duty_cycle
        For what part of any hour a transmitter may send; None: not limited.
    narrowest_hz
        The preset is for bandwidths from this on; below it is :data:`LOWEST_DBM`.
    unlimited_erp_dbm
        Up to this power the duty cycle is not limited.
    """

    low_hz: int
    high_hz: int
    power_dbm: int
    erp_dbm: float | None = None
    duty_cycle: float | None = None
    narrowest_hz: int = 0
    unlimited_erp_dbm: float | None = None


# 25 mW are 14 dBm, 10 mW are 10 dBm. On 902-928 MHz a fixed narrow channel fits no rule but 15.249, -1.25 dBm e.i.r.p.
_NORTH_AMERICA = (Band(902_000_000, 928_000_000, HIGHEST_DBM, narrowest_hz=WIDE_HZ),)
REGIONS: dict[str, tuple[Band, ...]] = {
    "EU868": (
        Band(863_000_000, 865_000_000, 14, 14, 0.001),
        Band(865_000_000, 868_600_000, 14, 14, 0.01),
        Band(868_700_000, 869_200_000, 14, 14, 0.001),
        Band(869_400_000, 869_650_000, HIGHEST_DBM, 27, 0.1),
        Band(869_700_000, 870_000_000, 14, 14, 0.01, unlimited_erp_dbm=7),
    ),
    "EU433": (Band(433_050_000, 434_790_000, 10, 10, 0.1),),
    "US915": _NORTH_AMERICA,
    "CA915": _NORTH_AMERICA,
}


def preset_power_dbm(region: str, *, frequency_hz: int, bandwidth_hz: int) -> int:
    """Return the power at the PA_BOOST pin for a channel in a region.

    Raises
    ------
    RadioSettingsError
        The channel does not lie in any band of the region.
    """
    bands = bands_of(region, frequency_hz=frequency_hz, bandwidth_hz=bandwidth_hz)
    return min(band.power_dbm if bandwidth_hz >= band.narrowest_hz else LOWEST_DBM for band in bands)


def bands_of(region: str, *, frequency_hz: int, bandwidth_hz: int) -> tuple[Band, ...]:
    """Return the bands that a channel lies in, one or several that adjoin each other.

    Raises
    ------
    RadioSettingsError
        It does not lie within the bands of the region.
    """
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


DIPOLE_DBI = 2.15
"""e.i.r.p. is this much more than e.r.p."""

NARROW_EIRP_DBM = -1.25
"""15.249: 50 mV/m at 3 m, for a fixed channel of any bandwidth."""

WIDE_DBM = 30
"""15.247(b)(3): 1 W into the antenna."""

WIDE_GAIN_DBI = 6
"""15.247(b)(4): with more gain than this, as much less power."""

CHIP_DBM = 20
CHIP_DUTY = 0.01
"""At +20 dBm the chip may transmit for so much of the time."""


class Use(NamedTuple):
    """How radios are used.

    Attributes
    ----------
    settings
        Of the modem, power included.
    antenna_gain_dbi
        Of each antenna, its cable deducted.
    master_duty, station_duty
        For what part of the time the master transmits, and each station.
    """

    settings: LoRaSettings
    antenna_gain_dbi: float
    master_duty: float
    station_duty: float

    @property
    def duty(self) -> float:
        """Of the one that transmits most."""
        return max(self.master_duty, self.station_duty)

    @property
    def eirp_dbm(self) -> float:
        """What is radiated, in terms of an antenna that radiates evenly."""
        return self.settings.power_dbm + self.antenna_gain_dbi


def exceeded(use: Use, region: str | None, others: Sequence[Use]) -> list[str]:
    """Return a sentence for each limit that is exceeded, which ends with what would comply.

    Parameters
    ----------
    use
        What is planned.
    region
        Where; None: only the chip's limits are looked at.
    others
        The same with other settings, in the order in which to prefer them.

    Raises
    ------
    RadioSettingsError
        The channel does not lie in any band of the region.
    """
    found = []
    if use.settings.power_dbm >= CHIP_DBM and use.duty > CHIP_DUTY:
        found.append(
            f"the chip bears {CHIP_DBM} dBm for {_percent(CHIP_DUTY)} of the time (SX1276 data sheet); {_sending(use)}. "
            f"Would comply: {HIGHEST_DBM} dBm"
        )
    if region is None:
        return found
    settings = use.settings
    for band in bands_of(region, frequency_hz=settings.frequency_hz, bandwidth_hz=settings.bandwidth_hz):
        if band.erp_dbm is None:
            found += _american(use, region)
        else:
            found += _european(use, region, band, band.erp_dbm, others)
    return found


def _european(use: Use, region: str, band: Band, limit_dbm: float, others: Sequence[Use]) -> list[str]:
    found = []
    name = f"{region}, {_mhz(band)} (ERC/REC 70-03)"
    erp_dbm = use.eirp_dbm - DIPOLE_DBI
    if erp_dbm > limit_dbm:
        found.append(
            f"{name}: at most {limit_dbm:g} dBm e.r.p.; {use.settings.power_dbm} dBm into {use.antenna_gain_dbi:g} dBi "
            f"are {erp_dbm:.1f}. Would comply: {erp_dbm - limit_dbm:.1f} dB less power or gain"
        )
    unlimited = band.unlimited_erp_dbm is not None and erp_dbm <= band.unlimited_erp_dbm
    if band.duty_cycle is not None and use.duty > band.duty_cycle and not unlimited:
        remedies = [
            _changed(other, use) for other in others if other.duty <= band.duty_cycle and other is not use
        ][:1]
        remedies += [
            f"{_mhz(free)} with at most {free.unlimited_erp_dbm:g} dBm e.r.p., where it is not limited"
            for free in REGIONS[region]
            if free.unlimited_erp_dbm is not None and use.settings.bandwidth_hz <= free.high_hz - free.low_hz
        ]
        remedies.append("listening before talking with a change of frequency, which tsgt does not do")
        found.append(
            f"{name}: a radio may transmit for {_percent(band.duty_cycle)} of any hour; {_sending(use)}. "
            f"Would comply: {'; '.join(remedies)}"
        )
    return found


def _american(use: Use, region: str) -> list[str]:
    narrow, wide = ("RSS-210", "RSS-247") if region.startswith("CA") else ("47 CFR 15.249", "47 CFR 15.247")
    settings, gain_dbi = use.settings, use.antenna_gain_dbi
    if settings.bandwidth_hz >= WIDE_HZ:
        limit_dbm = WIDE_DBM - max(gain_dbi - WIDE_GAIN_DBI, 0)
        if settings.power_dbm <= limit_dbm:
            return []
        much_db = settings.power_dbm - limit_dbm
        sentence = (
            f"{region} ({wide}): with an antenna of {gain_dbi:g} dBi at most {limit_dbm:g} dBm; it is "
            f"{settings.power_dbm} dBm. Would comply: {much_db:.1f} dB less power or gain"
        )
        return [sentence]
    too_much_db = use.eirp_dbm - NARROW_EIRP_DBM
    if too_much_db <= 0:
        return []
    remedies = [
        f"a bandwidth of {WIDE_HZ // 1000} kHz, then up to {WIDE_DBM} dBm ({wide})",
        "hopping over 25 channels or more, which tsgt does not do",
    ]
    if settings.power_dbm - too_much_db >= LOWEST_DBM:
        remedies.insert(1, f"{too_much_db:.1f} dB less power")
    else:
        rest_db = LOWEST_DBM + gain_dbi - NARROW_EIRP_DBM
        remedies.insert(
            1, f"{LOWEST_DBM} dBm, the least that the chip gives, and {rest_db:.1f} dB of attenuation"
        )
    sentence = (
        f"{region} ({narrow}): a fixed channel of {settings.bandwidth_hz / 1000:g} kHz may radiate {NARROW_EIRP_DBM} "
        f"dBm e.i.r.p. (50 mV/m at 3 m); {settings.power_dbm} dBm into {gain_dbi:g} dBi are {use.eirp_dbm:.1f}. "
        f"Would comply: {'; '.join(remedies)}"
    )
    return [sentence]


def _changed(other: Use, use: Use) -> str:
    settings = other.settings
    return (
        f"SF {settings.spreading_factor} with 4/{settings.coding_rate}, {_percent(other.duty)} instead of "
        f"{_percent(use.duty)}"
    )


def _sending(use: Use) -> str:
    return (
        f"the master transmits for {_percent(use.master_duty)}, each station for {_percent(use.station_duty)}"
    )


def _percent(part: float) -> str:
    return f"{100 * part:.3g} %"


def _mhz(band: Band) -> str:
    return f"{band.low_hz / 1e6:g} to {band.high_hz / 1e6:g} MHz"
