"""Presets of power per region."""

from __future__ import annotations

import pytest

from tsgt.errors import RadioSettingsError
from tsgt.radio.planning import MIN_POWER_DBM, REGIONS, preset_power_dbm
from tsgt.radio.planning.regulations import MAX_PRESET_DBM


@pytest.mark.parametrize(
    ("region", "frequency_hz", "bandwidth_hz", "power_dbm"),
    [
        ("EU868", 868_100_000, 125_000, 14),
        ("EU868", 869_525_000, 250_000, 17),
        ("EU433", 433_900_000, 250_000, 10),
        ("US915", 905_000_000, 500_000, 17),
        ("CA915", 905_000_000, 250_000, MIN_POWER_DBM),
    ],
)
def test_preset_power_of_a_channel(region: str, frequency_hz: int, bandwidth_hz: int, power_dbm: int) -> None:
    """The band decides, and in North America the bandwidth of a fixed channel."""
    assert preset_power_dbm(region, frequency_hz=frequency_hz, bandwidth_hz=bandwidth_hz) == power_dbm


@pytest.mark.parametrize(
    ("region", "frequency_hz", "bandwidth_hz"),
    [("EU868", 905_000_000, 250_000), ("EU868", 868_650_000, 125_000), ("EU868", 869_525_000, 500_000)],
)
def test_channel_outside_the_bands_is_rejected(region: str, frequency_hz: int, bandwidth_hz: int) -> None:
    """Wrong region, a gap between bands, or too wide for the band: the message names the bands."""
    with pytest.raises(RadioSettingsError, match="not within a band of EU868"):
        preset_power_dbm(region, frequency_hz=frequency_hz, bandwidth_hz=bandwidth_hz)


def test_presets_stay_within_the_chip_limit() -> None:
    """No preset exceeds what the chip allows at any duty cycle."""
    for bands in REGIONS.values():
        assert all(MIN_POWER_DBM <= band.power_dbm <= MAX_PRESET_DBM for band in bands)
