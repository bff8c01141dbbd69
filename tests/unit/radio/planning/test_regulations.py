"""Power presets, and limits of regions and chip."""

from __future__ import annotations

from typing import Any

import pytest

from tsgt.errors import RadioSettingsError
from tsgt.radio import LoRaSettings
from tsgt.radio.planning import DIPOLE_DBI, MIN_POWER_DBM, REGIONS, ChannelUse, preset_power_dbm, violations
from tsgt.radio.planning.regulations import MAX_PRESET_DBM


def use(
    *, duty: float = 0.005, master_duty: float = 0.001, gain_dbi: float = DIPOLE_DBI, **settings: Any
) -> ChannelUse:
    """Return a use within most European limits, with changes."""
    usual = {
        "frequency_hz": 869_525_000,
        "spreading_factor": 9,
        "bandwidth_hz": 125_000,
        "coding_rate": 6,
        "power_dbm": 14,
    }
    return ChannelUse(LoRaSettings(**{**usual, **settings}), gain_dbi, master_duty, duty)


def test_without_a_region_only_the_chip_limit_applies() -> None:
    """Without a region no legal limit is known."""
    assert violations(use(duty=1.0), None, []) == []


@pytest.mark.parametrize(("duty", "master_duty"), [(0.02, 0.001), (0.001, 0.02)])
def test_20_dbm_above_one_percent_duty_cycle_is_reported(duty: float, master_duty: float) -> None:
    """The chip's limit applies to master and station; 17 dBm would comply."""
    (text,) = violations(use(power_dbm=20, duty=duty, master_duty=master_duty), None, [])
    assert "the chip allows 20 dBm for 1 % of the time" in text
    assert text.endswith("Would comply: 17 dBm")


def test_20_dbm_below_one_percent_duty_cycle_is_allowed() -> None:
    """The data sheet allows 20 dBm at 1 % duty cycle."""
    assert violations(use(power_dbm=20), None, []) == []


@pytest.mark.parametrize(
    ("frequency_hz", "allowed"),
    [(864_000_000, 0.001), (866_000_000, 0.01), (868_900_000, 0.001), (869_525_000, 0.1), (433_900_000, 0.1)],
)
def test_europe_limits_the_duty_cycle(frequency_hz: int, allowed: float) -> None:
    """Each band has its own limit."""
    region = "EU433" if frequency_hz < 500_000_000 else "EU868"
    power_dbm = 10 if region == "EU433" else 14
    settings = {"frequency_hz": frequency_hz, "power_dbm": power_dbm}
    assert violations(use(duty=allowed, master_duty=0, **settings), region, []) == []
    (text,) = violations(use(duty=1.01 * allowed, master_duty=0, **settings), region, [])
    assert f"may transmit for {100 * allowed:g} % of any hour" in text


def test_channel_in_two_bands_has_the_stricter_limit() -> None:
    """Across 865 MHz both limits apply; only that of 0.1 % is violated."""
    (text,) = violations(use(frequency_hz=865_000_000), "EU868", [])
    assert "863 to 865 MHz" in text


def test_complying_settings_are_named() -> None:
    """The first alternative within the limit is named, and the band without a limit."""
    others = [use(duty=0.5), use(duty=0.09, spreading_factor=8), use(duty=0.05, spreading_factor=7)]
    (text,) = violations(use(duty=0.24), "EU868", others)
    assert (
        "Would comply: SF 8 with 4/6, 9 % instead of 24 %; 869.7 to 870 MHz with at most 7 dBm e.r.p." in text
    )


def test_low_power_has_no_duty_limit_in_one_band() -> None:
    """5 mW between 869.7 and 870 MHz are unlimited, more is not."""
    settings = {"frequency_hz": 869_850_000, "duty": 0.5}
    assert violations(use(power_dbm=7, **settings), "EU868", []) == []
    assert len(violations(use(power_dbm=8, **settings), "EU868", [])) == 1


def test_antenna_gain_reduces_the_allowed_power() -> None:
    """Gain above a dipole counts against the e.r.p. limit."""
    (text,) = violations(use(frequency_hz=868_100_000, gain_dbi=8.15), "EU868", [])
    assert "14 dBm into 8.15 dBi are 20.0. Would comply: 6.0 dB less power or gain" in text


@pytest.mark.parametrize(("region", "law"), [("US915", "47 CFR 15.249"), ("CA915", "RSS-210")])
def test_narrow_fixed_channel_in_north_america_has_a_low_limit(region: str, law: str) -> None:
    """The paper's 250 kHz may radiate -1.25 dBm; each region names its own rule, and 500 kHz comply."""
    channel = {"frequency_hz": 905_000_000, "bandwidth_hz": 250_000, "duty": 0.3}
    (text,) = violations(use(**channel, power_dbm=17), region, [])
    assert law in text
    assert "a bandwidth of 500 kHz, then up to 30 dBm" in text
    assert "2 dBm, the least that the chip gives, and 5.4 dB of attenuation" in text
    assert violations(use(**channel, power_dbm=2, gain_dbi=-3.25), region, []) == []
    (text,) = violations(use(**channel, power_dbm=17, gain_dbi=-10), region, [])
    assert "8.2 dB less power" in text


def test_wide_channel_in_north_america_has_a_high_limit() -> None:
    """500 kHz may have 30 dBm into 6 dBi, and less into more gain."""
    channel = {"frequency_hz": 905_000_000, "bandwidth_hz": 500_000, "duty": 0.3}
    assert violations(use(**channel, power_dbm=17, gain_dbi=6), "US915", []) == []
    (text,) = violations(use(**channel, power_dbm=17, gain_dbi=21), "US915", [])
    assert "at most 15 dBm; it is 17 dBm. Would comply: 2.0 dB less power or gain" in text


def test_channel_outside_the_bands_is_rejected() -> None:
    """It has no limits to compare with."""
    with pytest.raises(RadioSettingsError, match="not within a band"):
        violations(use(frequency_hz=905_000_000), "EU868", [])


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
def test_preset_of_a_channel_outside_the_bands_is_rejected(
    region: str, frequency_hz: int, bandwidth_hz: int
) -> None:
    """Wrong region, a gap between bands, or too wide for the band: the message names the bands."""
    with pytest.raises(RadioSettingsError, match="not within a band of EU868"):
        preset_power_dbm(region, frequency_hz=frequency_hz, bandwidth_hz=bandwidth_hz)


def test_presets_stay_within_the_chip_limit() -> None:
    """No preset exceeds what the chip allows at any duty cycle."""
    for bands in REGIONS.values():
        assert all(MIN_POWER_DBM <= band.power_dbm <= MAX_PRESET_DBM for band in bands)
