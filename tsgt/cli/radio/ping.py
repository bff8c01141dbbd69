"""The command ``radio ping``: a bench test of two radios, real or simulated."""

from __future__ import annotations

import asyncio
import dataclasses
import math
import secrets
from contextlib import aclosing, suppress
from typing import TYPE_CHECKING, Any

import click

from tsgt import service
from tsgt.cli.model_options import model_option
from tsgt.cli.options import FiniteRange, json_option
from tsgt.cli.output import CHECK_FAILED, print_json
from tsgt.cli.radio.options import Modem, modem_options, wiring_options
from tsgt.clock import SystemClock
from tsgt.config import ModemConfig
from tsgt.errors import RadioSettingsError
from tsgt.radio import MAX_PAYLOAD_BYTES, LoRaSettings, airtime_us
from tsgt.radio.ping import (
    MIN_PAYLOAD_BYTES,
    SESSION_IDS,
    Exchange,
    Response,
    ping,
    respond,
    summarise,
    summarise_responses,
)
from tsgt.radio.planning import (
    CHANNELS,
    MIN_POWER_DBM,
    REGIONS,
    Channel,
    ChannelUse,
    duty_cycle_limit,
    power_limit_dbm,
    preset_power_dbm,
    violations,
)
from tsgt.radio.sx127x import RadioStatistics, SX127x, Wiring, open_hal

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from tsgt.clock import Clock
    from tsgt.radio.ping import SignalStrength, Summary

    Session = Callable[[SX127x, Clock], Awaitable[None]]

DEFAULT_COUNT = 100
SIMULATED_FREQUENCY_MHZ = 905.0
_ROUNDING_DB = 1e-9  # of sums of gains
_HOUR_MS = 3_600_000
REPLY_MARGIN_MS = 250
"""Added to the reply's time on air: the timeout of the authors' master."""


def _byte(_context: click.Context, _parameter: click.Parameter, value: str) -> int:
    """Parse a byte, 0x34 or 52."""
    try:
        return bytes([int(value, 0)])[0]
    except ValueError:
        raise click.BadParameter(f"{value} is not a byte such as 0x34.") from None


@click.command()
@click.option("--simulated", is_flag=True, help="Simulate both radios in virtual time, without hardware.")
@click.option("--answer", "answering", is_flag=True, help="Respond to the requests of the other radio.")
@click.option(
    "--count",
    type=click.IntRange(1, 65_536),
    help=f"Number of requests to send or to respond to.  [default: {DEFAULT_COUNT}; with --answer until Ctrl-C]",
)
@click.option(
    "--payload",
    "payload_bytes",
    type=click.IntRange(MIN_PAYLOAD_BYTES, MAX_PAYLOAD_BYTES),
    default=34,
    help="Length of request and reply in bytes.",
)
@click.option(
    "--timeout-ms",
    type=click.IntRange(min=1),
    help=f"Timeout of a reply.  [default: its time on air plus {REPLY_MARGIN_MS} ms]",
)
@modem_options
@model_option(
    ModemConfig,
    "frequency_mhz",
    help=f"Carrier frequency; legal ones depend on the country.  [required; with --simulated {SIMULATED_FREQUENCY_MHZ:g}]",
)
@click.option(
    "--region",
    type=click.Choice(sorted(REGIONS)),
    help="Use the power that the region allows on this channel; reject a channel, power or --count that it does not allow.",
)
@click.option(
    "--power-dbm",
    type=click.IntRange(2, 17),
    help="Transmit power.  [default: that of --region, else 2, which suffices within a building]",
)
@model_option(ModemConfig, "antenna_gain_dbi")
@click.option(
    "--sync-word", callback=_byte, default="0x34", help="Sync word, one byte, the same on both sides."
)
@wiring_options
@click.option(
    "--distance-m",
    type=FiniteRange(1, 1e6),
    default=100.0,
    help="Distance of simulated radios in free space.",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, help="Seed of the simulation.")
@json_option
def ping_command(
    *,
    simulated: bool,
    answering: bool,
    count: int | None,
    payload_bytes: int,
    timeout_ms: int | None,
    modem: Modem,
    frequency_mhz: float | None,
    region: str | None,
    power_dbm: int | None,
    antenna_gain_dbi: float,
    sync_word: int,
    wiring: Wiring,
    distance_m: float,
    seed: int,
    as_json: bool,
) -> int:
    """Test the link between two radios.

    Run `tsgt radio ping --answer` on one machine and `tsgt radio ping` on the other, with the same modem options.
    Measures loss, signal strength, round trip (here, from TxDone of the request to RxDone of the reply) and turnaround
    (there, from RxDone of the request to the start of the reply). Ctrl-C ends the test with the summary so far.

    Exit code 3: no reply was received.
    """
    if simulated and answering:
        raise click.UsageError("--simulated runs both sides; omit --answer")
    if frequency_mhz is None:
        if not simulated:
            raise click.UsageError("give --frequency-mhz, a carrier frequency that is legal where you are")
        frequency_mhz = SIMULATED_FREQUENCY_MHZ
    channel = Channel(round(frequency_mhz * 1e6), modem.bandwidth_hz)
    if power_dbm is None:
        power_dbm = (
            MIN_POWER_DBM
            if region is None
            else preset_power_dbm(region, **channel._asdict(), antenna_gain_dbi=antenna_gain_dbi)
        )
    settings = LoRaSettings(
        frequency_hz=channel.frequency_hz,
        **dataclasses.asdict(modem),
        sync_word=sync_word,
        power_dbm=power_dbm,
    )
    if region is not None:
        # A reply is as long as its request, whose length the side that responds does not know.
        longest_bytes = MAX_PAYLOAD_BYTES if answering else payload_bytes
        airtime_ms = airtime_us(longest_bytes, **dataclasses.asdict(modem)) / 1000
        packets = count if answering else count or DEFAULT_COUNT
        duty = 1.0 if packets is None else packets * airtime_ms / _HOUR_MS
        if violations(ChannelUse(settings, antenna_gain_dbi, duty, duty), region):
            _refuse_power(region, channel, power_dbm, antenna_gain_dbi)
            _refuse_duty_cycle(region, channel, packets=packets, airtime_ms=airtime_ms)
    if answering:
        _answer(settings, wiring, count=count, as_json=as_json)
        return 0

    airtime_ms = airtime_us(payload_bytes, **dataclasses.asdict(modem)) / 1000
    exchanges: list[Exchange] = []

    async def session(radio: SX127x, clock: Clock) -> None:
        requests = ping(
            radio,
            clock,
            session=0 if simulated else secrets.randbelow(SESSION_IDS),
            count=count or DEFAULT_COUNT,
            payload_bytes=payload_bytes,
            timeout_ns=round((timeout_ms or airtime_ms + REPLY_MARGIN_MS) * 1e6),
        )
        async with aclosing(requests) as results:
            async for exchange in results:
                exchanges.append(exchange)
                if not as_json:
                    click.echo(_exchange_line(exchange), err=True)

    if simulated:
        statistics = _on_simulation(session, settings, distance_m=distance_m, seed=seed)
    else:
        statistics = _on_hardware(session, settings, wiring)
    summary = summarise(exchanges)
    if as_json:
        print_json({"simulated": simulated, "airtime_ms": airtime_ms, **_summary_json(summary, statistics)})
    else:
        click.echo(
            f"sent         {summary.sent} requests of {payload_bytes} bytes, {airtime_ms:.3f} ms on air"
        )
        _print_summary(summary, statistics)
    return 0 if summary.received else CHECK_FAILED


def _summary_json(summary: Summary, statistics: RadioStatistics) -> dict[str, Any]:
    return {
        "sent": summary.sent,
        "received": summary.received,
        "loss": summary.loss,
        "late": summary.late,
        "unknown_packets": summary.unknown,
        "crc_errors": statistics.crc_errors,
        "lost_edges": statistics.lost_edges,
        "packets_per_s": summary.packets_per_s,
        "here": summary.local and summary.local._asdict(),
        "there": summary.remote and summary.remote._asdict(),
        "round_trip_ms": _times(summary.round_trip_ns),
        "turnaround_ms": _times(summary.turnaround_ns),
    }


def _print_summary(summary: Summary, statistics: RadioStatistics) -> None:
    loss = "" if summary.loss is None else f", {summary.loss:.1%} lost"
    rate = "" if summary.packets_per_s is None else f", {summary.packets_per_s:.2f} packets/s both ways"
    click.echo(f"received     {summary.received} replies{loss}{rate}")
    click.echo(
        f"rejected     {summary.late} late replies, {summary.unknown} unknown packets, "
        f"{statistics.crc_errors} with a wrong CRC, {statistics.lost_edges} edges lost"
    )
    click.echo(f"replies      {_strength_text(summary.local)}")
    click.echo(f"requests     {_strength_text(summary.remote)}, at the other side")
    click.echo(f"round trip   {_times_text(summary.round_trip_ns)}, TxDone to RxDone")
    click.echo(f"turnaround   {_times_text(summary.turnaround_ns)}, RxDone to start of the reply, there")


def _refuse_power(region: str, channel: Channel, power_dbm: int, antenna_gain_dbi: float) -> None:
    """Raise RadioSettingsError for a power that the region does not allow for this use."""
    limit_dbm = power_limit_dbm(region, **channel._asdict(), antenna_gain_dbi=antenna_gain_dbi)
    excess_db = power_dbm - limit_dbm
    if excess_db <= _ROUNDING_DB:
        return
    legal = CHANNELS[region]
    remedy = f"a legal channel: --frequency-mhz {legal.frequency_hz / 1e6:g} --bandwidth-khz {legal.bandwidth_hz / 1e3:g}"
    if channel == legal:
        gain_dbi = math.floor(10 * (antenna_gain_dbi - excess_db) + _ROUNDING_DB) / 10
        remedy = f"with an attenuator of {math.ceil(10 * excess_db - _ROUNDING_DB) / 10:.1f} dB: --antenna-gain-dbi {gain_dbi:g}"
    always = "" if duty_cycle_limit(region, **channel._asdict()) else " at any duty cycle"
    raise RadioSettingsError(
        f"{region} allows{always} {limit_dbm:.1f} dBm into an antenna of {antenna_gain_dbi:g} dBi at "
        f"{channel.frequency_hz / 1e6:g} MHz and {channel.bandwidth_hz / 1e3:g} kHz, and {power_dbm} dBm would be "
        f"transmitted; {remedy}"
    )


def _refuse_duty_cycle(region: str, channel: Channel, *, packets: int | None, airtime_ms: float) -> None:
    """Raise RadioSettingsError if so many packets (None: without end) take longer than the region allows in an hour."""
    duty_cycle = duty_cycle_limit(region, **channel._asdict())
    if duty_cycle is None:
        return
    most = int(duty_cycle * _HOUR_MS / airtime_ms)
    if packets is None or packets > most:
        legal = CHANNELS[region]
        raise RadioSettingsError(
            f"{region} allows a radio to transmit for {100 * duty_cycle:g} % of any hour at {channel.frequency_hz / 1e6:g} MHz, "
            f"and a packet takes {airtime_ms:.0f} ms: --count {most} at most, in all tests of an hour; without "
            f"this limit: --frequency-mhz {legal.frequency_hz / 1e6:g} --bandwidth-khz {legal.bandwidth_hz / 1e3:g}"
        )


def _answer(settings: LoRaSettings, wiring: Wiring, *, count: int | None, as_json: bool) -> None:
    """Respond on real hardware until the count is reached or Ctrl-C."""
    answers: list[Response] = []

    async def session(radio: SX127x, _clock: Clock) -> None:
        answered = 0
        async with aclosing(respond(radio)) as results:
            async for result in results:
                answers.append(result)
                if not as_json:
                    click.echo(_response_line(result), err=True)
                answered += result.turnaround_ns is not None
                if answered == count:
                    return

    statistics = _on_hardware(session, settings, wiring)
    summary = summarise_responses(answers)
    if as_json:
        print_json(
            {
                "answered": summary.replied,
                "repeated": summary.repeated,
                "unknown_packets": summary.unknown,
                "crc_errors": statistics.crc_errors,
                "lost_edges": statistics.lost_edges,
                "here": summary.signal and summary.signal._asdict(),
                "turnaround_ms": _times(summary.turnaround_ns),
            }
        )
    else:
        click.echo(f"answered     {summary.replied} requests")
        click.echo(
            f"rejected     {summary.repeated} repeated requests, {summary.unknown} unknown packets, "
            f"{statistics.crc_errors} with a wrong CRC, {statistics.lost_edges} edges lost"
        )
        click.echo(f"requests     {_strength_text(summary.signal)}")
        click.echo(f"turnaround   {_times_text(summary.turnaround_ns)}, RxDone to start of the reply")


def _on_hardware(session: Session, settings: LoRaSettings, wiring: Wiring) -> RadioStatistics:
    """Run a session on the radio of this machine until its end or Ctrl-C."""

    async def run() -> RadioStatistics:
        clock = SystemClock()
        radio = SX127x(open_hal(wiring), clock)
        try:
            await radio.start(settings)
            with suppress(asyncio.CancelledError):
                await session(radio, clock)
        finally:
            await radio.close()
        return radio.statistics

    return service.run(run)


def _on_simulation(
    session: Session, settings: LoRaSettings, *, distance_m: float, seed: int
) -> RadioStatistics:
    """Run a session with a simulated radio; another one responds."""
    # Imported here, so that the small computer of a station does not load numpy.
    import numpy as np

    from tsgt.simulation.kernel import VirtualClock, VirtualTimeline, run_virtual
    from tsgt.simulation.lora import Air, LinkModel, LogDistanceLoss, simulated_radio

    timeline, clock, rng = VirtualTimeline(), VirtualClock(0), np.random.default_rng(seed)
    places = {"here": (0.0, 0.0, 0.0), "there": (distance_m, 0.0, 0.0)}
    air = Air(timeline, rng, LinkModel(path_loss=LogDistanceLoss(positions_m=places)))

    async def run() -> RadioStatistics:
        here, there = (simulated_radio(air, name, timeline, clock, rng) for name in places)
        await here.start(settings)
        await there.start(settings)
        answering = asyncio.create_task(_drain(respond(there)))
        try:
            with suppress(asyncio.CancelledError):
                await session(here, clock)
        finally:
            answering.cancel()
            await asyncio.wait([answering])
            await here.close()
            await there.close()
        return here.statistics

    return run_virtual(run, timeline)


async def _drain(answers: AsyncIterator[Response]) -> None:
    async for _ in answers:
        pass


def _exchange_line(exchange: Exchange) -> str:
    if exchange.reply is None or exchange.round_trip_ns is None:
        return f"{exchange.number:5d}  no reply"
    here, there = _strength_text(exchange.reply.local), _strength_text(exchange.reply.remote)
    return f"{exchange.number:5d}  {exchange.round_trip_ns / 1e6:.3f} ms  here {here}  there {there}"


def _response_line(result: Response) -> str:
    if result.number is None:
        return f"    -  unknown packet, {_strength_text(result.signal)}"
    if result.turnaround_ns is None:
        return f"{result.number:5d}  repeated, {_strength_text(result.signal)}"
    return f"{result.number:5d}  replied after {result.turnaround_ns / 1e6:.3f} ms, {_strength_text(result.signal)}"


def _strength_text(strength: SignalStrength | None) -> str:
    return "-" if strength is None else f"{strength.rssi_dbm:.1f} dBm, SNR {strength.snr_db:.1f} dB"


def _times(median_and_max_ns: tuple[int, int] | None) -> dict[str, float] | None:
    if median_and_max_ns is None:
        return None
    return {"median": median_and_max_ns[0] / 1e6, "max": median_and_max_ns[1] / 1e6}


def _times_text(median_and_max_ns: tuple[int, int] | None) -> str:
    if median_and_max_ns is None:
        return "-"
    return f"median {median_and_max_ns[0] / 1e6:.3f} ms, max {median_and_max_ns[1] / 1e6:.3f} ms"
