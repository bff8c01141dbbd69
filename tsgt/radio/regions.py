"""What power may be used where: presets per region. Data, and one question to it.

From ERC/REC 70-03 and EN 300 220-2 (Europe, power is e.r.p.) and 47 CFR 15.247 and 15.249 (USA, likewise RSS-247 in
Canada), as of 2026. An antenna like a dipole is assumed, so that e.r.p. is the power at the pin. The law of the place
decides, not this table; duty cycles are not watched here.
"""

from __future__ import annotations

from dataclasses import dataclass

from tsgt.errors import RadioSettingsError

HIGHEST_DBM = 17
"""More is not a preset: +20 dBm is the chip's own exception, at 1 % duty cycle."""

LOWEST_DBM = 2
"""The least that PA_BOOST gives."""

WIDE_HZ = 500_000
"""From this bandwidth on a fixed channel is a digital modulation in the sense of 15.247(a)(2)."""


@dataclass(frozen=True, slots=True)
class Band:
    """A range of frequencies with one limit.

    Attributes
    ----------
    low_hz, high_hz
        The whole channel must lie within.
    power_dbm
        Preset at the PA_BOOST pin.
    narrowest_hz
        The preset is for bandwidths from this on; below it is :data:`LOWEST_DBM`.
    """

    low_hz: int
    high_hz: int
    power_dbm: int
    narrowest_hz: int = 0


# 25 mW are 14 dBm, 10 mW are 10 dBm. On 902-928 MHz a fixed narrow channel fits no rule but 15.249, -1.25 dBm e.i.r.p.
_NORTH_AMERICA = (Band(902_000_000, 928_000_000, HIGHEST_DBM, narrowest_hz=WIDE_HZ),)
REGIONS: dict[str, tuple[Band, ...]] = {
    "EU868": (
        Band(863_000_000, 868_600_000, 14),
        Band(868_700_000, 869_200_000, 14),
        Band(869_400_000, 869_650_000, HIGHEST_DBM),
        Band(869_700_000, 870_000_000, 14),
    ),
    "EU433": (Band(433_050_000, 434_790_000, 10),),
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
    half_hz = bandwidth_hz // 2
    for band in REGIONS[region]:
        if band.low_hz <= frequency_hz - half_hz and frequency_hz + half_hz <= band.high_hz:
            return band.power_dbm if bandwidth_hz >= band.narrowest_hz else LOWEST_DBM
    bands = ", ".join(f"{band.low_hz / 1e6:g} to {band.high_hz / 1e6:g}" for band in REGIONS[region])
    raise RadioSettingsError(
        f"{frequency_hz / 1e6:g} MHz with {bandwidth_hz / 1e3:g} kHz is not within a band of {region} "
        f"({bands} MHz); choose another frequency"
    )
