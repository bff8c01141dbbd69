"""What may be transmitted where: presets of power per region, and limits. Data, and two questions to it.

From ERC/REC 70-03 and EN 300 220-2 (Europe, power is e.r.p.) and 47 CFR 15.247 and 15.249 (USA, likewise RSS-247 in
Canada), as of 2026. For the presets an antenna like a dipole is assumed, so that e.r.p. is the power at the pin. The
law of the place decides, not this table.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from tsgt.errors import RadioSettingsError

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
