"""Legality of daemons' configurations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tsgt.config import ClientConfig, MasterConfig, load
from tsgt.errors import ConfigError
from tsgt.radio.legality import check_legality, legality

EXAMPLES = Path(__file__).parents[3] / "configs"
PATH = EXAMPLES / "master.example.toml"


def master(**radio: Any) -> MasterConfig:
    """Return the example for Canada with changes of its radio."""
    config = load(PATH, MasterConfig)
    return config.model_copy(update={"radio": config.radio.model_copy(update=radio)})


def test_violation_is_refused_with_limit_and_remedy() -> None:
    """In one line, which names the file."""
    with pytest.raises(ConfigError) as refused:
        check_legality(master(bandwidth_khz=250.0), PATH)
    text = str(refused.value)
    assert text.startswith(f"{PATH}: radio: CA915 (RSS-210): a fixed channel of 250 kHz")
    assert "Remedy: bandwidth_khz = 500, power_dbm = 17, or state your licence" in text
    assert "\n" not in text


def test_remedy_complies() -> None:
    """It is what the message says."""
    check_legality(master(bandwidth_khz=500.0, power_dbm=17), PATH)


def test_licence_lifts_the_limits_of_the_region() -> None:
    """Its limits are those of the licence, which are not known."""
    check_legality(master(bandwidth_khz=250.0, power_dbm=17, licence="ISED 010123456-001"), PATH)


def test_duty_cycle_of_the_mission_counts() -> None:
    """At 869.525 MHz three stations are too many, and eight at spreading factor 7 are allowed."""
    config = load(EXAMPLES / "master.eu868.example.toml", MasterConfig)
    radio = config.radio.model_copy(update={"frequency_mhz": 869.525, "spreading_factor": 7})
    config = config.model_copy(update={"radio": radio})
    assert "10 % of any hour" in legality(config, PATH).violations[0]
    eight = tuple(config.stations[0].model_copy(update={"station": n, "prism": n}) for n in range(1, 9))
    found = legality(config.model_copy(update={"stations": eight}), PATH)
    assert found.violations == ()
    assert str(found.warning).startswith("With instruments that measure at 10 Hz it would violate EU868")


def test_client_leaves_the_duty_cycle_to_its_master() -> None:
    """It does not know the number of stations, and a station of many transmits less."""
    config = load(EXAMPLES / "client.eu868.example.toml", ClientConfig)
    radio = config.radio.model_copy(update={"frequency_mhz": 869.525, "spreading_factor": 7})
    assert legality(config.model_copy(update={"radio": radio}), PATH).violations == ()


def test_chip_limit_is_a_warning() -> None:
    """The configuration allows 20 dBm explicitly."""
    found = legality(master(power_dbm=20, allow_20_dbm=True), PATH)
    assert found.violations == ()
    assert "1 % of the time" in str(found.warning)
