"""``tsgt radio plan``."""

from __future__ import annotations

from statistics import fmean
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from pathlib import Path

    from harness.cli import Tsgt

SUPERFRAME = ("radio", "plan", "--protocol", "superframe", "--stations")
CLASSIC = ("radio", "plan", "--protocol", "classic", "--stations")


def test_plan_as_json(tsgt: Tsgt) -> None:
    """The output has all figures, for the given settings and for the table of others."""
    outcome = tsgt(*SUPERFRAME, 3, "--json")
    assert outcome.code == 0
    plan = outcome.json()
    assert (plan["cycle_ms"], plan["rate_hz"], plan["warnings"]) == (pytest.approx(400), 2.5, [])
    assert plan["age_ms"]["p50"] < plan["age_ms"]["p99"]
    assert set(plan["duty_cycle"]) == {"master", "station"}
    (same,) = [row for row in plan["table"] if (row["sf"], row["coding_rate"], row["stations"]) == (9, 6, 3)]
    assert same["age_ms"] == plan["age_ms"]
    assert same["link_margin_db"] == plan["link_margin_db"]
    assert {row["sf"] for row in plan["table"]} == set(range(7, 13))
    assert {row["coding_rate"] for row in plan["table"]} == set(range(5, 9))
    assert {3, 8, 16} <= {row["stations"] for row in plan["table"]}


def test_plan_as_text(tsgt: Tsgt) -> None:
    """The given number of stations has a column in the table."""
    outcome = tsgt(*CLASSIC, 5)
    assert outcome.code == 0
    lines = outcome.out.splitlines()
    assert lines[0] == "channel      905 MHz, SF 9, 250 kHz, 4/6, 2 dBm"
    assert lines[1] == "cycle        1017 ms for 5 stations"
    assert any(line.split() == ["margin", *"12345", "6", "8"] for line in lines)
    assert sum(line.startswith("SF ") for line in lines) == 24


def test_link_margin_is_power_minus_loss_minus_sensitivity(tsgt: Tsgt) -> None:
    """1 km of free space is 91.6 dB at 905 MHz; SF 9 at 250 kHz needs -126 dBm."""
    arguments = ("--power-dbm", 14, "--antenna-gain-db", 0, "--path-loss-exponent", 2, "--distance-m", 1000)
    plan = tsgt(*SUPERFRAME, 3, *arguments, "--json").json()
    assert plan["link_margin_db"] == pytest.approx(14 - 91.58 + 126.02, abs=0.05)


@pytest.mark.slow
def test_weak_link_is_a_warning(tsgt: Tsgt) -> None:
    """The field needs ten decibels."""
    plan = tsgt(*SUPERFRAME, 3, "--distance-m", 5000, "--json").json()
    assert plan["link_margin_db"] < 10
    assert "the link margin is" in plan["warnings"][0]


def test_insufficient_capacity_is_a_warning(tsgt: Tsgt) -> None:
    """Classic does not carry three stations; the warning names sufficient settings and the other protocol."""
    (warning,) = tsgt(*CLASSIC, 3, "--json").json()["warnings"]
    assert warning.startswith("1.61 of 2.5 measurements per second and station are delivered")
    assert "--protocol superframe" in warning


@pytest.mark.parametrize(
    ("region", "frequency_mhz", "exceeds"),
    [("EU868", 869.525, "10 % of any hour"), ("US915", 905.0, "47 CFR 15.249"), ("CA915", 905.0, "RSS-210")],
)
@pytest.mark.slow
def test_region_selects_channel_and_limits(
    tsgt: Tsgt, region: str, frequency_mhz: float, exceeds: str
) -> None:
    """The plan is checked against the region's limits, with settings that comply."""
    plan = tsgt(*SUPERFRAME, 3, "--region", region, "--json").json()
    assert plan["frequency_mhz"] == frequency_mhz
    (warning,) = plan["warnings"]
    assert exceeds in warning
    assert "Would comply: " in warning


@pytest.mark.slow
def test_compliant_settings_have_no_warning(tsgt: Tsgt) -> None:
    """500 kHz in the USA, and 7 dBm above 869.7 MHz in Europe."""
    for arguments in (
        ("--region", "US915", "--bandwidth-khz", 500),
        ("--region", "EU868", "--frequency-mhz", 869.85, "--power-dbm", 7),
    ):
        assert tsgt(*SUPERFRAME, 3, *arguments, "--json").json()["warnings"] == []


@pytest.mark.slow
def test_20_dbm_is_a_warning(tsgt: Tsgt) -> None:
    """The chip supports 20 dBm at a duty cycle of 1 % only."""
    (warning,) = tsgt(*SUPERFRAME, 3, "--power-dbm", 20, "--json").json()["warnings"]
    assert "SX1276 data sheet" in warning


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ((*CLASSIC, 10), "--stations 10: classic supports at most 9"),
        ((*SUPERFRAME, 17), "--stations"),
        ((*SUPERFRAME, 3, "--loss", 1), "--loss"),
        ((*SUPERFRAME, 3, "--rate-hz", 0), "--rate-hz"),
        ((*SUPERFRAME, 3, "--distance-m", "nan"), "--distance-m"),
        ((*SUPERFRAME, 3, "--rate-hz", "nan"), "--rate-hz"),
        ((*SUPERFRAME, 3, "--loss", "nan"), "--loss"),
        ((*SUPERFRAME, 3, "--region", "MARS"), "--region"),
        (("radio", "plan", "--stations", 3), "--protocol"),
    ],
)
def test_usage_errors_name_the_option(tsgt: Tsgt, arguments: tuple[object, ...], complaint: str) -> None:
    """A usage error names the option to change."""
    outcome = tsgt(*arguments)
    assert outcome.code == 2
    assert complaint in outcome.err


@pytest.mark.parametrize(
    "arguments", [("--region", "EU868", "--frequency-mhz", 905), ("--power-dbm", 19), ("--power-dbm", 1)]
)
def test_illegal_or_unsupported_settings_are_one_line(tsgt: Tsgt, arguments: tuple[object, ...]) -> None:
    """A channel outside the region's bands, or a power that the chip does not have: exit code 1."""
    outcome = tsgt(*SUPERFRAME, 3, *arguments)
    assert outcome.code == 1
    assert outcome.err.count("\n") == 1


# Instruments that measure evenly, and whose measurements can be read at once.
PROMPT = """
[[stations]]
station = {number}
prism = {number}
position_m = [{number}.0, 0.0, 0.0]
rate_hz = {rate_hz}
[stations.instrument]
tick_jitter_ms = 0.1
processing_min_ms = 0.0
processing_max_ms = 0.0
baud = 921600
"""


@pytest.mark.parametrize(
    ("protocol", "stations", "rate_hz", "seconds", "age_tolerance"),
    [
        # A measurement is always newer than the last poll.
        ("classic", 2, 5.0, 120, 0.05),
        # The planner takes the phases of the instruments for random, a run has those of its seed.
        ("superframe", 3, 2.5, 60, 0.2),
    ],
)
@pytest.mark.slow
def test_plan_and_simulation_agree(
    tsgt: Tsgt,
    tmp_path: Path,
    protocol: str,
    stations: int,
    rate_hz: float,
    seconds: int,
    age_tolerance: float,
) -> None:
    """The planned rate and age agree with a mission of daemons, drivers and chips."""
    scenario = tmp_path / "prompt.toml"
    entries = [PROMPT.format(number=number, rate_hz=rate_hz) for number in range(1, stations + 1)]
    scenario.write_text('kind = "scenario"\n' + "".join(entries))
    spoken = ("--protocol", protocol)
    plan = tsgt("radio", "plan", *spoken, "--stations", stations, "--rate-hz", rate_hz, "--json").json()
    found = tsgt("simulate", scenario, *spoken, "--duration", seconds, "--json").json()
    duty = plan["duty_cycle"]
    assert found["airtime_fraction"] == pytest.approx(duty["master"] + stations * duty["station"], rel=0.03)
    each = found["stations"].values()
    assert fmean(station["rate_hz"] for station in each) == pytest.approx(plan["rate_hz"], rel=0.05)
    assert fmean(station["age_ms"]["p50"] for station in each) == pytest.approx(
        plan["age_ms"]["p50"], rel=age_tolerance
    )
    if protocol == "superframe":
        assert found["frame_ms"] == pytest.approx(plan["cycle_ms"], rel=0.03)
