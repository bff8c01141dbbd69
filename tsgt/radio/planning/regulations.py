"""What may be transmitted where: power presets and limits of regions and chip, and the violations of a planned use.

ERC/REC 70-03 and EN 300 220-2 (Europe, e.r.p.); 47 CFR 15.247 and 15.249 (USA), RSS-247 and RSS-210 (Canada); SX1276 data
sheet. As of 2026; the local law decides. The presets assume a dipole, so that the e.r.p. is the power at the pin.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

from tsgt.errors import RadioSettingsError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tsgt.radio.base import LoRaSettings

MAX_PRESET_DBM = 17  # above it the chip has its own limit of 1 % duty cycle

MIN_POWER_DBM = 2  # minimum of PA_BOOST

WIDE_HZ = 500_000  # from this bandwidth on, a fixed channel is a digital modulation by 15.247(a)(2)


@dataclass(frozen=True, slots=True)
class Band:
    """A range of frequencies with one set of limits.

    Attributes
    ----------
    low_hz, high_hz
        A channel may extend over adjoining bands; then the stricter limits apply.
    power_dbm
        Preset at the PA_BOOST pin.
    erp_dbm
        Limit of the radiated power; None: the region limits it otherwise.
    duty_cycle
        Limit within any hour; None: unlimited.
    min_bandwidth_hz
        Smallest bandwidth of the preset; below it the preset is :data:`MIN_POWER_DBM`.
    unlimited_duty_erp_dbm
        Power up to which the duty cycle is unlimited.
    """

    low_hz: int
    high_hz: int
    power_dbm: int
    erp_dbm: float | None = None
    duty_cycle: float | None = None
    min_bandwidth_hz: int = 0
    unlimited_duty_erp_dbm: float | None = None


# 25 mW are 14 dBm, 10 mW are 10 dBm. On 902-928 MHz a fixed narrow channel fits no rule but 15.249, -1.25 dBm e.i.r.p.
_NORTH_AMERICA = (Band(902_000_000, 928_000_000, MAX_PRESET_DBM, min_bandwidth_hz=WIDE_HZ),)
REGIONS: dict[str, tuple[Band, ...]] = {
    "EU868": (
        Band(863_000_000, 865_000_000, 14, 14, 0.001),
        Band(865_000_000, 868_600_000, 14, 14, 0.01),
        Band(868_700_000, 869_200_000, 14, 14, 0.001),
        Band(869_400_000, 869_650_000, MAX_PRESET_DBM, 27, 0.1),
        Band(869_700_000, 870_000_000, 14, 14, 0.01, unlimited_duty_erp_dbm=7),
    ),
    "EU433": (Band(433_050_000, 434_790_000, 10, 10, 0.1),),
    "US915": _NORTH_AMERICA,
    "CA915": _NORTH_AMERICA,
}


def preset_power_dbm(region: str, *, frequency_hz: int, bandwidth_hz: int) -> int:
    """Return the preset power at the PA_BOOST pin; raises RadioSettingsError for a channel outside the region."""
    bands = bands_of(region, frequency_hz=frequency_hz, bandwidth_hz=bandwidth_hz)
    return min(band.power_dbm if bandwidth_hz >= band.min_bandwidth_hz else MIN_POWER_DBM for band in bands)


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


DIPOLE_DBI = 2.15  # difference of e.i.r.p. and e.r.p.

NARROW_EIRP_DBM = -1.25  # 15.249: 50 mV/m at 3 m, for a fixed channel of any bandwidth

WIDE_DBM = 30  # 15.247(b)(3): 1 W into the antenna

WIDE_GAIN_DBI = 6  # 15.247(b)(4): gain above this reduces the allowed power

CHIP_DBM = 20
CHIP_DUTY = 0.01  # duty cycle limit of the chip at +20 dBm


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


def violations(use: ChannelUse, region: str | None, others: Sequence[ChannelUse]) -> list[str]:
    """Return a sentence for each violated limit, with what would comply.

    ``region``: None: only the chip's limits apply. ``others``: the same use with other settings, in the order of
    preference. Raises RadioSettingsError if the channel does not lie in any band of the region.
    """
    violated = []
    if use.settings.power_dbm >= CHIP_DBM and use.duty > CHIP_DUTY:
        violated.append(
            f"the chip allows {CHIP_DBM} dBm for {_percent(CHIP_DUTY)} of the time (SX1276 data sheet); {_duty_text(use)}. "
            f"Would comply: {MAX_PRESET_DBM} dBm"
        )
    if region is None:
        return violated
    settings = use.settings
    for band in bands_of(region, frequency_hz=settings.frequency_hz, bandwidth_hz=settings.bandwidth_hz):
        if band.erp_dbm is None:
            violated += _american(use, region)
        else:
            violated += _european(use, region, band, band.erp_dbm, others)
    return violated


def _european(
    use: ChannelUse, region: str, band: Band, limit_dbm: float, others: Sequence[ChannelUse]
) -> list[str]:
    violated = []
    name = f"{region}, {_mhz(band)} (ERC/REC 70-03)"
    erp_dbm = use.eirp_dbm - DIPOLE_DBI
    if erp_dbm > limit_dbm:
        violated.append(
            f"{name}: at most {limit_dbm:g} dBm e.r.p.; {use.settings.power_dbm} dBm into {use.antenna_gain_dbi:g} dBi "
            f"are {erp_dbm:.1f}. Would comply: {erp_dbm - limit_dbm:.1f} dB less power or gain"
        )
    unlimited = band.unlimited_duty_erp_dbm is not None and erp_dbm <= band.unlimited_duty_erp_dbm
    if band.duty_cycle is not None and use.duty > band.duty_cycle and not unlimited:
        remedies = [
            _alternative(other, use) for other in others if other.duty <= band.duty_cycle and other is not use
        ][:1]
        remedies += [
            f"{_mhz(free)} with at most {free.unlimited_duty_erp_dbm:g} dBm e.r.p., where it is not limited"
            for free in REGIONS[region]
            if free.unlimited_duty_erp_dbm is not None
            and use.settings.bandwidth_hz <= free.high_hz - free.low_hz
        ]
        remedies.append("listening before talking with a change of frequency, which tsgt does not do")
        violated.append(
            f"{name}: a radio may transmit for {_percent(band.duty_cycle)} of any hour; {_duty_text(use)}. "
            f"Would comply: {'; '.join(remedies)}"
        )
    return violated


def _american(use: ChannelUse, region: str) -> list[str]:
    narrow, wide = ("RSS-210", "RSS-247") if region.startswith("CA") else ("47 CFR 15.249", "47 CFR 15.247")
    settings, gain_dbi = use.settings, use.antenna_gain_dbi
    if settings.bandwidth_hz >= WIDE_HZ:
        limit_dbm = WIDE_DBM - max(gain_dbi - WIDE_GAIN_DBI, 0)
        if settings.power_dbm <= limit_dbm:
            return []
        excess_db = settings.power_dbm - limit_dbm
        sentence = (
            f"{region} ({wide}): with an antenna of {gain_dbi:g} dBi at most {limit_dbm:g} dBm; it is "
            f"{settings.power_dbm} dBm. Would comply: {excess_db:.1f} dB less power or gain"
        )
        return [sentence]
    excess_db = use.eirp_dbm - NARROW_EIRP_DBM
    if excess_db <= 0:
        return []
    remedies = [
        f"a bandwidth of {WIDE_HZ // 1000} kHz, then up to {WIDE_DBM} dBm ({wide})",
        "hopping over 25 channels or more, which tsgt does not do",
    ]
    if settings.power_dbm - excess_db >= MIN_POWER_DBM:
        remedies.insert(1, f"{excess_db:.1f} dB less power")
    else:
        attenuation_db = MIN_POWER_DBM + gain_dbi - NARROW_EIRP_DBM
        remedies.insert(
            1,
            f"{MIN_POWER_DBM} dBm, the least that the chip gives, and {attenuation_db:.1f} dB of attenuation",
        )
    sentence = (
        f"{region} ({narrow}): a fixed channel of {settings.bandwidth_hz / 1000:g} kHz may radiate {NARROW_EIRP_DBM} "
        f"dBm e.i.r.p. (50 mV/m at 3 m); {settings.power_dbm} dBm into {gain_dbi:g} dBi are {use.eirp_dbm:.1f}. "
        f"Would comply: {'; '.join(remedies)}"
    )
    return [sentence]


def _alternative(other: ChannelUse, use: ChannelUse) -> str:
    settings = other.settings
    return (
        f"SF {settings.spreading_factor} with 4/{settings.coding_rate}, {_percent(other.duty)} instead of "
        f"{_percent(use.duty)}"
    )


def _duty_text(use: ChannelUse) -> str:
    return (
        f"the master transmits for {_percent(use.master_duty)}, each station for {_percent(use.station_duty)}"
    )


def _percent(part: float) -> str:
    return f"{100 * part:.3g} %"


def _mhz(band: Band) -> str:
    return f"{band.low_hz / 1e6:g} to {band.high_hz / 1e6:g} MHz"
