"""Limits of regions and chip, preset power, and uses that comply."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tsgt.errors import RadioSettingsError
from tsgt.radio import LoRaSettings
from tsgt.radio.planning import (
    CHANNELS,
    DIPOLE_DBI,
    MIN_POWER_DBM,
    REGIONS,
    ChannelUse,
    chip_violation,
    compliant_use,
    preset_power_dbm,
    violations,
)


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


@pytest.mark.parametrize(("duty", "master_duty"), [(0.02, 0.001), (0.001, 0.02)])
def test_20_dbm_above_one_percent_duty_cycle_is_reported(duty: float, master_duty: float) -> None:
    """The chip's limit applies to master and station; 17 dBm would comply."""
    text = chip_violation(use(power_dbm=20, duty=duty, master_duty=master_duty))
    assert text is not None
    assert "the chip allows 20 dBm for 1 % of the time" in text
    assert text.endswith("use 17 dBm")


def test_20_dbm_below_one_percent_duty_cycle_is_allowed() -> None:
    """The data sheet allows 20 dBm at 1 % duty cycle."""
    assert chip_violation(use(power_dbm=20)) is None


@pytest.mark.parametrize(
    ("frequency_hz", "allowed"),
    [(864_000_000, 0.001), (866_000_000, 0.01), (868_900_000, 0.001), (869_525_000, 0.1), (433_900_000, 0.1)],
)
def test_europe_limits_the_duty_cycle(frequency_hz: int, allowed: float) -> None:
    """Each band has its own limit."""
    region = "EU433" if frequency_hz < 500_000_000 else "EU868"
    power_dbm = 10 if region == "EU433" else 14
    settings = {"frequency_hz": frequency_hz, "power_dbm": power_dbm}
    assert violations(use(duty=allowed, master_duty=0, **settings), region) == []
    (text,) = violations(use(duty=1.01 * allowed, master_duty=0, **settings), region)
    assert f"may transmit for {100 * allowed:g} % of any hour" in text


def test_channel_in_two_bands_has_the_stricter_limit() -> None:
    """Across 865 MHz both limits apply; only that of 0.1 % is violated."""
    (text,) = violations(use(frequency_hz=865_000_000), "EU868")
    assert "863 to 865 MHz" in text


@pytest.mark.parametrize(
    ("region", "frequency_hz", "power_dbm"), [("EU868", 869_850_000, 7), ("EU433", 433_920_000, 2)]
)
def test_low_power_has_no_duty_limit_in_two_bands(region: str, frequency_hz: int, power_dbm: int) -> None:
    """5 mW above 869.7 MHz and 1 mW at 433 MHz are unlimited, more is not; the gain of the antenna counts."""
    # 0 dBm are radiated by 2 dBm and an antenna 2 dB worse than a dipole.
    gain_dbi = DIPOLE_DBI if region == "EU868" else DIPOLE_DBI - 2
    settings = {"frequency_hz": frequency_hz, "power_dbm": power_dbm, "duty": 0.5}
    assert violations(use(**settings, gain_dbi=gain_dbi), region) == []
    assert len(violations(use(**settings, gain_dbi=gain_dbi + 0.1), region)) == 1


def test_antenna_gain_reduces_the_allowed_power() -> None:
    """Gain above a dipole counts against the e.r.p. limit."""
    (text,) = violations(use(frequency_hz=868_100_000, gain_dbi=8.15), "EU868")
    assert "14 dBm into 8.15 dBi are 20.0" in text


@pytest.mark.parametrize(("region", "law"), [("US915", "47 CFR 15.249"), ("CA915", "RSS-210")])
def test_narrow_fixed_channel_in_north_america_has_a_low_limit(region: str, law: str) -> None:
    """The paper's 250 kHz may radiate -1.25 dBm; each region names its own rule."""
    channel = {"frequency_hz": 905_000_000, "bandwidth_hz": 250_000, "duty": 0.3}
    (text,) = violations(use(**channel, power_dbm=17), region)
    assert law in text
    assert violations(use(**channel, power_dbm=2, gain_dbi=-3.25), region) == []
    assert len(violations(use(**channel, power_dbm=2, gain_dbi=-3.15), region)) == 1


def test_wide_channel_in_north_america_has_a_high_limit() -> None:
    """500 kHz may have 30 dBm into 6 dBi, and less into more gain."""
    channel = {"frequency_hz": 905_000_000, "bandwidth_hz": 500_000, "duty": 0.3}
    assert violations(use(**channel, power_dbm=17, gain_dbi=6), "US915") == []
    (text,) = violations(use(**channel, power_dbm=17, gain_dbi=21), "US915")
    assert "with an antenna of 21 dBi at most 15 dBm; it is 17 dBm" in text


def test_channel_outside_the_bands_is_rejected() -> None:
    """It has no limits to compare with."""
    with pytest.raises(RadioSettingsError, match="not within a band"):
        violations(use(frequency_hz=905_000_000), "EU868")


@pytest.mark.parametrize(
    ("region", "settings", "changed"),
    [
        ("EU868", {"frequency_hz": 869_850_000, "power_dbm": 10}, {"power_dbm": 7}),
        ("EU868", {}, {"frequency_hz": 869_850_000, "bandwidth_hz": 250_000, "power_dbm": 7}),
        ("CA915", {"frequency_hz": 905_000_000}, {"bandwidth_hz": 500_000, "power_dbm": 17}),
    ],
    ids=["power", "channel", "bandwidth"],
)
def test_compliant_use_changes_little(region: str, settings: dict[str, int], changed: dict[str, int]) -> None:
    """Less power if that is enough, else the channel of the region."""
    planned = use(duty=0.3, **settings)
    found = compliant_use(planned, region, lambda other: planned._replace(settings=other))
    assert found == use(duty=0.3, **{**settings, **changed})


@given(
    region=st.sampled_from(sorted(REGIONS)),
    bandwidth_hz=st.sampled_from([125_000, 250_000]),
    power_dbm=st.integers(2, 17),
    gain_dbi=st.floats(-40, 40),
    duty=st.floats(0, 1),
)
@pytest.mark.slow
def test_compliant_use_has_no_violations(
    *, region: str, bandwidth_hz: int, power_dbm: int, gain_dbi: float, duty: float
) -> None:
    """Whatever power, antenna and duty cycle are."""
    channel = {"frequency_hz": CHANNELS[region].frequency_hz, "bandwidth_hz": bandwidth_hz}
    planned = use(**channel, power_dbm=power_dbm, gain_dbi=gain_dbi, duty=duty)
    found = compliant_use(planned, region, lambda other: planned._replace(settings=other))
    assert violations(found, region) == []
    assert found.antenna_gain_dbi <= gain_dbi


@pytest.mark.parametrize(
    ("region", "frequency_hz", "bandwidth_hz", "gain_dbi", "power_dbm"),
    [
        ("EU868", 868_100_000, 125_000, DIPOLE_DBI, 14),
        ("EU868", 868_100_000, 125_000, 5.0, 11),
        ("EU868", 869_525_000, 250_000, DIPOLE_DBI, 17),
        ("EU868", 869_850_000, 250_000, DIPOLE_DBI, 7),
        ("EU433", 433_900_000, 250_000, -3.0, 5),
        ("US915", 905_000_000, 500_000, 6.0, 17),
        ("CA915", 905_000_000, 250_000, DIPOLE_DBI, MIN_POWER_DBM),
    ],
)
def test_preset_power_of_a_channel(
    *, region: str, frequency_hz: int, bandwidth_hz: int, gain_dbi: float, power_dbm: int
) -> None:
    """The band and the antenna decide, and in North America the bandwidth of a fixed channel."""
    preset_dbm = preset_power_dbm(
        region, frequency_hz=frequency_hz, bandwidth_hz=bandwidth_hz, antenna_gain_dbi=gain_dbi
    )
    assert preset_dbm == power_dbm


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
