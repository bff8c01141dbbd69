"""The command ``radio plan``: capacity, link margin and legal limits of a channel."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import click

from tsgt.cli.model_options import model_option
from tsgt.cli.options import FiniteRange, json_option, refuse_given
from tsgt.cli.output import print_json, print_table
from tsgt.cli.radio.options import Modem, modem_options
from tsgt.config import (
    MAX_STATION_NUMBERS,
    ClassicMasterConfig,
    ModemConfig,
    ScenarioRadioConfig,
    SuperframeMasterConfig,
)
from tsgt.radio import LoRaSettings
from tsgt.radio.from_config import planned_cycle
from tsgt.radio.legality import remedy_text
from tsgt.radio.planning import (
    CHANNELS,
    MIN_POWER_DBM,
    REGIONS,
    ChannelUse,
    CycleEstimate,
    TrafficLoad,
    chip_violation,
    compliant_use,
    path_loss_db,
    preset_power_dbm,
    sensitivity_dbm,
    violations,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    MasterProtocol = ClassicMasterConfig | SuperframeMasterConfig

_CLASSIC = ClassicMasterConfig(kind="classic")
_SUPERFRAME = SuperframeMasterConfig(kind="superframe")
_OF_SUPERFRAME = "start_jitter_ms", "turnaround_ms", "no_phase_lock"

_PAPER_MHZ = 905.0
_VIOLATED = 3
"""Exit code: a legal limit is violated."""

_TABLE_STATIONS = (1, 2, 3, 4, 6, 8, 12, 16)
_MIN_MARGIN_DB = 10.0
"""Reserve for fading, trees and people in the line of sight."""
_COMPLETE = 0.999
"""Share of the measurements from which on delivery counts as complete."""


@dataclass(frozen=True, slots=True)
class _Row:
    """Estimate for one choice of settings and number of stations."""

    settings: LoRaSettings
    stations: int
    margin_db: float
    cycle: CycleEstimate

    def use(self, antenna_gain_dbi: float) -> ChannelUse:
        return ChannelUse(self.settings, antenna_gain_dbi, self.cycle.master_duty, self.cycle.station_duty)

    def json(self) -> dict[str, Any]:
        return {
            "sf": self.settings.spreading_factor,
            "coding_rate": self.settings.coding_rate,
            "stations": self.stations,
            "link_margin_db": self.margin_db,
            **_figures(self.cycle),
        }


@click.command()
@click.option(
    "--protocol",
    type=click.Choice(list(MAX_STATION_NUMBERS)),
    required=True,
    help="The paper's polling protocol, or the TDMA protocol superframe.",
)
@click.option("--stations", type=click.IntRange(1, 16), required=True, help="Number of stations.")
@modem_options
@click.option(
    "--rate-hz", type=FiniteRange(0.01, 100), default=2.5, help="Measurement rate of each instrument."
)
@click.option("--loss", type=FiniteRange(0, 0.9), default=0.0, help="Probability that a packet is lost.")
@click.option("--region", type=click.Choice(list(REGIONS)), help="Region whose legal limits apply.")
@model_option(
    ModemConfig,
    "frequency_mhz",
    help="Carrier frequency.  [default: the channel of the region, with its bandwidth, or 905]",
)
@click.option(
    "--power-dbm",
    type=int,
    help="Transmit power, 2 to 17 or 20.  [default: the most that the region allows, or 2]",
)
@click.option("--distance-m", type=FiniteRange(1, 1e6), default=1000.0, help="Distance for the link margin.")
@model_option(ScenarioRadioConfig, "path_loss_exponent", default=3.0)
@model_option(ModemConfig, "antenna_gain_dbi")
@model_option(SuperframeMasterConfig, "start_jitter_ms")
@model_option(SuperframeMasterConfig, "turnaround_ms")
@click.option("--no-phase-lock", is_flag=True, help="Do not lock the frame phase to the instruments.")
@click.option(
    "--table",
    "with_table",
    is_flag=True,
    help="Compare all spreading factors, coding rates and numbers of stations.",
)
@json_option
def plan_command(
    *,
    protocol: str,
    stations: int,
    modem: Modem,
    rate_hz: float,
    loss: float,
    region: str | None,
    frequency_mhz: float | None,
    power_dbm: int | None,
    distance_m: float,
    path_loss_exponent: float,
    antenna_gain_dbi: float,
    start_jitter_ms: float,
    turnaround_ms: float,
    no_phase_lock: bool,
    with_table: bool,
    as_json: bool,
) -> int:
    """Compute rate, age, range and legality of a channel.

    Rate counts distinct measurements per station that reach the master. Age is the time from the client's reading to
    the arrival at the master; add the latency of the instrument, 80 to 140 ms for a simulated one on a fast line.
    Frequencies, powers and limits are for orientation only: check the law of the country.

    Exit code 3: a limit of the region is violated; settings that comply follow in one line.
    """
    if stations > MAX_STATION_NUMBERS[protocol]:
        raise click.UsageError(
            f"--stations {stations}: {protocol} supports at most {MAX_STATION_NUMBERS[protocol]}"
        )
    settings = _settings(modem, region, frequency_mhz, power_dbm, antenna_gain_dbi)
    spoken: MasterProtocol = _CLASSIC
    if protocol == "classic":
        refuse_given(*_OF_SUPERFRAME, because="with --protocol classic")
    if protocol == "superframe":
        spoken = _SUPERFRAME.model_copy(
            update={
                "start_jitter_ms": start_jitter_ms,
                "turnaround_ms": turnaround_ms,
                "phase_lock": not no_phase_lock,
            }
        )
    received_dbm = (
        settings.power_dbm
        + 2 * antenna_gain_dbi
        - path_loss_db(distance_m, settings.frequency_hz, path_loss_exponent)
    )

    def row(settings: LoRaSettings, stations: int) -> _Row:
        needed_dbm = sensitivity_dbm(settings.spreading_factor, settings.bandwidth_hz)
        load = TrafficLoad(stations=stations, rate_hz=rate_hz, loss=loss)
        return _Row(settings, stations, received_dbm - needed_dbm, planned_cycle(spoken, load, settings))

    planned = row(settings, stations)

    def rows(numbers: Sequence[int]) -> list[_Row]:
        return [
            row(replace(settings, spreading_factor=sf, coding_rate=coding_rate), n)
            for sf in range(7, 13)
            for coding_rate in range(5, 9)
            for n in numbers
        ]

    numbers = sorted({stations, *(n for n in _TABLE_STATIONS if n <= MAX_STATION_NUMBERS[protocol])})
    table = rows(numbers) if with_table else []  # takes many seconds on a station's computer
    complete = planned.cycle.rate_hz >= _COMPLETE * rate_hz
    others = [] if complete else [each for each in table or rows([stations]) if each.stations == stations]
    warnings = _warnings(planned, others, spoken, rate_hz=rate_hz)
    use = planned.use(antenna_gain_dbi)
    if chip := chip_violation(use):
        warnings.append(chip)
    violated = [] if region is None else violations(use, region)
    remedy = None
    if region is not None and violated:
        compliant = compliant_use(use, region, lambda other: row(other, stations).use(antenna_gain_dbi))
        remedy = remedy_text(use, compliant)
    code = _VIOLATED if violated else 0
    if as_json:
        print_json(
            {
                "protocol": protocol,
                "stations": stations,
                "frequency_mhz": settings.frequency_hz / 1e6,
                "bandwidth_khz": settings.bandwidth_hz / 1e3,
                "power_dbm": settings.power_dbm,
                "antenna_gain_dbi": antenna_gain_dbi,
                "eirp_dbm": use.eirp_dbm,
                "erp_dbm": use.erp_dbm,
                **_figures(planned.cycle),
                "link_margin_db": planned.margin_db,
                "received_dbm": received_dbm,
                "warnings": warnings + violated,
                "violations": violated,
                "remedy": remedy,
                **({"table": [each.json() for each in table]} if with_table else {}),
            }
        )
        return code
    _print(planned, use, received_dbm=received_dbm, distance_m=distance_m, rate_hz=rate_hz)
    for warning in warnings:
        click.echo(f"warning      {warning}")
    for sentence in violated:
        click.echo(f"VIOLATION    {sentence}")
    if remedy is not None:
        click.echo(f"remedy       {remedy}")
    if with_table:
        click.echo(
            f"\nRate in Hz and median age in s, by number of stations; link margin at {distance_m:g} m:\n"
        )
        _print_table(table, numbers)
    return code


def _settings(
    modem: Modem,
    region: str | None,
    frequency_mhz: float | None,
    power_dbm: int | None,
    antenna_gain_dbi: float,
) -> LoRaSettings:
    """Return the settings; frequency, bandwidth and power that are not given are those of the region."""
    if region is not None and frequency_mhz is None:
        channel = CHANNELS[region]
        frequency_mhz = channel.frequency_hz / 1e6
        if _is_default("bandwidth_khz"):
            modem = replace(modem, bandwidth_hz=channel.bandwidth_hz)
    frequency_hz = round(1e6 * (frequency_mhz or _PAPER_MHZ))
    if power_dbm is None:
        power_dbm = MIN_POWER_DBM
        if region is not None:
            power_dbm = preset_power_dbm(
                region,
                frequency_hz=frequency_hz,
                bandwidth_hz=modem.bandwidth_hz,
                antenna_gain_dbi=antenna_gain_dbi,
            )
    return LoRaSettings(frequency_hz=frequency_hz, power_dbm=power_dbm, **asdict(modem))


def _is_default(name: str) -> bool:
    source = click.get_current_context().get_parameter_source(name)
    return source is click.core.ParameterSource.DEFAULT


def _figures(cycle: CycleEstimate) -> dict[str, Any]:
    return {
        "cycle_ms": cycle.cycle_ms,
        "rate_hz": cycle.rate_hz,
        "age_ms": {"p50": cycle.age_p50_ms, "p99": cycle.age_p99_ms},
        "duty_cycle": {"master": cycle.master_duty, "station": cycle.station_duty},
    }


def _warnings(planned: _Row, others: Sequence[_Row], spoken: MasterProtocol, *, rate_hz: float) -> list[str]:
    """Return the warnings; ``others``: with other settings, where a remedy is needed."""
    found = []
    if planned.cycle.rate_hz < _COMPLETE * rate_hz:
        enough = [row for row in others if row.cycle.rate_hz >= _COMPLETE * rate_hz]
        remedies = [
            f"SF {row.settings.spreading_factor} with 4/{row.settings.coding_rate}, link margin {row.margin_db:.0f} dB"
            for row in sorted(enough, key=lambda row: -row.margin_db)[:1]
        ]
        if isinstance(spoken, ClassicMasterConfig):
            remedies.append("--protocol superframe")
        remedies.append("fewer stations")
        found.append(
            f"{planned.cycle.rate_hz:.2f} of {rate_hz:g} measurements per second and station are delivered. "
            f"Remedies: {'; '.join(remedies)}"
        )
    if planned.margin_db < _MIN_MARGIN_DB:
        found.append(
            f"the link margin is {planned.margin_db:.0f} dB; {_MIN_MARGIN_DB:.0f} are needed for fading, trees and "
            "people in the line of sight. A higher spreading factor gives 2.5 dB per step, better antennas give more"
        )
    return found


def _print(planned: _Row, use: ChannelUse, *, received_dbm: float, distance_m: float, rate_hz: float) -> None:
    settings, cycle = planned.settings, planned.cycle
    click.echo(
        f"channel      {settings.frequency_hz / 1e6:g} MHz, SF {settings.spreading_factor}, "
        f"{settings.bandwidth_hz / 1e3:g} kHz, 4/{settings.coding_rate}, {settings.power_dbm} dBm"
    )
    click.echo(
        f"radiated     {use.eirp_dbm:.1f} dBm e.i.r.p., {use.erp_dbm:.1f} dBm e.r.p. with an antenna of "
        f"{use.antenna_gain_dbi:g} dBi"
    )
    click.echo(f"cycle        {cycle.cycle_ms:.0f} ms for {planned.stations} stations")
    click.echo(f"rate         {cycle.rate_hz:.2f} of {rate_hz:g} Hz per station")
    click.echo(f"age          median {cycle.age_p50_ms:.0f} ms, p99 {cycle.age_p99_ms:.0f} ms")
    click.echo(
        f"duty cycle   master {100 * cycle.master_duty:.1f} %, each station {100 * cycle.station_duty:.1f} %"
    )
    click.echo(
        f"link margin  {planned.margin_db:.1f} dB at {distance_m:g} m ({received_dbm:.1f} dBm received)"
    )


def _print_table(table: Sequence[_Row], numbers: Sequence[int]) -> None:
    rows = []
    for first in range(0, len(table), len(numbers)):
        row = table[first]
        cells = [
            f"{each.cycle.rate_hz:.2f} {each.cycle.age_p50_ms / 1e3:5.2f}"
            for each in table[first : first + len(numbers)]
        ]
        name = f"SF {row.settings.spreading_factor}, 4/{row.settings.coding_rate}"
        rows.append([name, f"{row.margin_db:.0f} dB", *cells])
    print_table(["", "margin", *(str(n) for n in numbers)], rows)
