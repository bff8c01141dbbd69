"""``tsgt radio plan``."""

from __future__ import annotations

from statistics import fmean
from typing import TYPE_CHECKING, Any

import pytest

from tsgt.cli.radio import plan as plan_command
from tsgt.radio.from_config import planned_cycle

if TYPE_CHECKING:
    from pathlib import Path

    from harness.files.cli import Tsgt

    from tsgt.radio.planning import CycleEstimate

SUPERFRAME = ("radio", "plan", "--protocol", "superframe", "--stations")
CLASSIC = ("radio", "plan", "--protocol", "classic", "--stations")


@pytest.mark.slow
def test_plan_as_json(tsgt: Tsgt) -> None:
    """The output has all figures, for the given settings and for the table of others."""
    outcome = tsgt(*SUPERFRAME, 3, "--table", "--json")
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
    """The given number of stations has a column in the table, which is printed on request."""
    assert "SF 7" not in tsgt(*CLASSIC, 5).out
    outcome = tsgt(*CLASSIC, 5, "--table")
    assert outcome.code == 0
    lines = outcome.out.splitlines()
    assert lines[0] == "channel      905 MHz, SF 9, 250 kHz, 4/6, 2 dBm"
    assert lines[1] == "radiated     4.2 dBm e.i.r.p., 2.0 dBm e.r.p. with an antenna of 2.15 dBi"
    assert lines[2] == "cycle        1017 ms for 5 stations"
    assert any(line.split() == ["margin", *"12345", "6", "8"] for line in lines)
    assert sum(line.startswith("SF ") for line in lines) == 24


@pytest.mark.parametrize(
    ("arguments", "rows"),
    [
        ((3, "--loss", 0.1), 1),
        pytest.param((16, "--loss", 0.9), 1 + 24, marks=pytest.mark.slow),
        pytest.param((3, "--table"), 1 + 192, marks=pytest.mark.slow),
    ],
)
def test_other_settings_are_computed_where_they_are_needed(
    tsgt: Tsgt, monkeypatch: pytest.MonkeyPatch, arguments: tuple[object, ...], rows: int
) -> None:
    """For the table, and for a remedy: with a high loss each takes a second of a small computer."""
    computed: list[object] = []

    def counted(*of: Any) -> CycleEstimate:
        computed.append(of)
        return planned_cycle(*of)

    monkeypatch.setattr(plan_command, "planned_cycle", counted)
    assert tsgt(*SUPERFRAME, *arguments).code == 0
    assert len(computed) == rows


@pytest.mark.slow
def test_link_margin_is_power_minus_loss_minus_sensitivity(tsgt: Tsgt) -> None:
    """1 km of free space is 91.6 dB at 905 MHz; SF 9 at 250 kHz needs -126 dBm."""
    arguments = ("--power-dbm", 14, "--antenna-gain-dbi", 0, "--path-loss-exponent", 2, "--distance-m", 1000)
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
    ("region", "frequency_mhz", "bandwidth_khz", "power_dbm"),
    [("EU868", 869.85, 250, 7), ("US915", 905.0, 500, 17), ("CA915", 905.0, 500, 17)],
)
@pytest.mark.slow
def test_region_selects_a_legal_channel(
    tsgt: Tsgt, region: str, frequency_mhz: float, bandwidth_khz: float, power_dbm: int
) -> None:
    """Without other options the plan is legal: with the channel, bandwidth and power of the region."""
    outcome = tsgt(*SUPERFRAME, 3, "--region", region, "--json")
    plan = outcome.json()
    assert (outcome.code, plan["violations"], plan["remedy"], plan["warnings"]) == (0, [], None, [])
    found = (plan["frequency_mhz"], plan["bandwidth_khz"], plan["power_dbm"])
    assert found == (frequency_mhz, bandwidth_khz, power_dbm)
    assert "table" not in plan


@pytest.mark.parametrize(
    ("arguments", "exceeded", "remedy"),
    [
        (
            ("EU868", "--frequency-mhz", 869.525),
            "may transmit for 10 % of any hour",
            "frequency_mhz = 869.85, power_dbm = 7",
        ),
        (("US915", "--bandwidth-khz", 250), "47 CFR 15.249", "bandwidth_khz = 500, power_dbm = 17"),
        (("EU433",), "above 0 dBm e.r.p.", "antenna_gain_dbi = 0.1 by an attenuator of 2.0 dB"),
    ],
)
@pytest.mark.slow
def test_violation_ends_with_the_remedy(
    tsgt: Tsgt, arguments: tuple[object, ...], exceeded: str, remedy: str
) -> None:
    """Exit code 3; the remedy is the last line."""
    outcome = tsgt(*SUPERFRAME, 3, "--region", *arguments)
    assert outcome.code == 3
    *_, violation, last = outcome.out.splitlines()
    assert violation.startswith("VIOLATION")
    assert exceeded in violation
    assert last == f"remedy       {remedy}"


@pytest.mark.slow
def test_20_dbm_is_a_warning(tsgt: Tsgt) -> None:
    """The chip supports 20 dBm at a duty cycle of 1 % only."""
    (warning,) = tsgt(*SUPERFRAME, 3, "--power-dbm", 20, "--json").json()["warnings"]
    assert "SX1276 data sheet" in warning


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ((*CLASSIC, 10), "--stations 10: classic supports at most 9"),
        ((*CLASSIC, 3, "--no-phase-lock"), "--no-phase-lock has no effect with --protocol classic"),
        ((*CLASSIC, 3, "--turnaround-ms", 50), "--turnaround-ms has no effect"),
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
    options = ("--estimator", "linear", "--duration", seconds, "--json")
    found = tsgt("simulate", scenario, *spoken, *options).json()
    duty = plan["duty_cycle"]
    assert found["airtime_fraction"] == pytest.approx(duty["master"] + stations * duty["station"], rel=0.03)
    each = found["stations"].values()
    assert fmean(station["rate_hz"] for station in each) == pytest.approx(plan["rate_hz"], rel=0.05)
    assert fmean(station["age_ms"]["p50"] for station in each) == pytest.approx(
        plan["age_ms"]["p50"], rel=age_tolerance
    )
    if protocol == "superframe":
        assert found["frame_ms"] == pytest.approx(plan["cycle_ms"], rel=0.03)
