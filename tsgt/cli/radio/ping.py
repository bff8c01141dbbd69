"""The command ``radio ping``: a bench test of two radios, real or simulated."""

from __future__ import annotations

import asyncio
import dataclasses
import secrets
from contextlib import aclosing, suppress
from typing import TYPE_CHECKING

import click

from tsgt import service
from tsgt.cli.options import finite, json_option
from tsgt.cli.output import CHECK_FAILED, print_json
from tsgt.cli.radio.options import Modem, modem_options, wiring_options
from tsgt.clock import SystemClock
from tsgt.radio import MAX_PAYLOAD_BYTES, LoRaSettings, airtime_us
from tsgt.radio.ping import (
    RUNS,
    SHORTEST_PAYLOAD_BYTES,
    Answer,
    Exchange,
    answer,
    ping,
    summarise,
    summarise_answers,
)
from tsgt.radio.planning import LOWEST_DBM, REGIONS, preset_power_dbm
from tsgt.radio.sx127x import RadioStatistics, SX127x, Wiring, open_hal

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from tsgt.clock import Clock
    from tsgt.radio.ping import Strength

    Session = Callable[[SX127x, Clock], Awaitable[None]]

DEFAULT_COUNT = 100
SIMULATED_FREQUENCY_MHZ = 905.0
REPLY_MARGIN_MS = 250
"""How much longer than the reply's time on air a request waits: the time-out of the authors' master."""


def _byte(_context: click.Context, _parameter: click.Parameter, value: str) -> int:
    """Take a byte as people write it, 0x34 or 52."""
    try:
        return bytes([int(value, 0)])[0]
    except ValueError:
        raise click.BadParameter(f"{value} is not a byte such as 0x34.") from None


@click.command()
@click.option("--simulated", is_flag=True, help="Two simulated radios in virtual time, no hardware.")
@click.option("--answer", "answering", is_flag=True, help="Answer the requests of the other radio.")
@click.option(
    "--count",
    type=click.IntRange(1, 65_536),
    help=f"Requests to send, or to answer.  [default: {DEFAULT_COUNT}; with --answer until Ctrl-C]",
)
@click.option(
    "--payload",
    "payload_bytes",
    type=click.IntRange(SHORTEST_PAYLOAD_BYTES, MAX_PAYLOAD_BYTES),
    default=34,
    show_default=True,
    help="Length of request and reply in bytes.",
)
@click.option(
    "--timeout-ms",
    type=click.IntRange(min=1),
    help=f"How long to wait for a reply.  [default: its time on air and {REPLY_MARGIN_MS} ms]",
)
@modem_options
@click.option(
    "--frequency-mhz",
    type=click.FloatRange(137, 1020),
    callback=finite,
    help="Carrier; which one is free depends on the country.  "
    f"[required; with --simulated {SIMULATED_FREQUENCY_MHZ:g}]",
)
@click.option(
    "--region",
    type=click.Choice(sorted(REGIONS)),
    help="Take the power that the region allows on this channel, and refuse a channel outside its bands.",
)
@click.option(
    "--power-dbm",
    type=click.IntRange(2, 17),
    help="Power.  [default: that of --region; without one 2, which is plenty within a building]",
)
@click.option(
    "--sync-word",
    callback=_byte,
    default="0x34",
    show_default=True,
    help="A byte, the same on both sides.",
)
@wiring_options
@click.option(
    "--distance-m",
    type=click.FloatRange(1, 1e6),
    default=100.0,
    show_default=True,
    help="How far apart they are, if simulated; free space.",
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Another seed, another simulation.",
)
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
    sync_word: int,
    wiring: Wiring,
    distance_m: float,
    seed: int,
    as_json: bool,
) -> int:
    """Test two radios: loss, strength of the signal, round trip, turn-round.

    On one machine `tsgt radio ping --answer`, on the other `tsgt radio ping`, with the same modem options. Ctrl-C ends
    it with the summary so far. Exit code 3: no reply at all.

    The turn-round is measured by the answering side, from RxDone of a request to the start of the reply; the round
    trip by this side, from TxDone of the request to RxDone of the reply.
    """
    if simulated and answering:
        raise click.UsageError("--simulated runs both sides; leave out --answer")
    if frequency_mhz is None:
        if not simulated:
            raise click.UsageError("give --frequency-mhz, a carrier that you may use where you are")
        frequency_mhz = SIMULATED_FREQUENCY_MHZ
    frequency_hz = round(frequency_mhz * 1e6)
    preset_dbm = LOWEST_DBM
    if region is not None:
        preset_dbm = preset_power_dbm(region, frequency_hz=frequency_hz, bandwidth_hz=modem.bandwidth_hz)
    settings = LoRaSettings(
        frequency_hz=frequency_hz,
        **dataclasses.asdict(modem),
        sync_word=sync_word,
        power_dbm=preset_dbm if power_dbm is None else power_dbm,
    )
    if answering:
        _answer(settings, wiring, count=count, as_json=as_json)
        return 0

    airtime_ms = _airtime_ms(payload_bytes, modem)
    exchanges: list[Exchange] = []

    async def session(radio: SX127x, clock: Clock) -> None:
        requests = ping(
            radio,
            clock,
            run=0 if simulated else secrets.randbelow(RUNS),
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
        print_json(
            {
                "simulated": simulated,
                "airtime_ms": airtime_ms,
                "sent": summary.sent,
                "received": summary.received,
                "loss": summary.loss,
                "late": summary.late,
                "foreign": summary.foreign,
                "crc_errors": statistics.crc_errors,
                "lost_edges": statistics.lost_edges,
                "packets_per_s": summary.packets_per_s,
                "here": _strength(summary.here),
                "there": _strength(summary.there),
                "round_trip_ms": _times(summary.round_trip_ns),
                "turnaround_ms": _times(summary.turn_round_ns),
            }
        )
    else:
        loss = "" if summary.loss is None else f", {summary.loss:.1%} lost"
        rate = "" if summary.packets_per_s is None else f", {summary.packets_per_s:.2f} packets/s both ways"
        click.echo(
            f"sent         {summary.sent} requests of {payload_bytes} bytes, {airtime_ms:.3f} ms on air"
        )
        click.echo(f"received     {summary.received} replies{loss}{rate}")
        click.echo(
            f"besides      {summary.late} late replies, {summary.foreign} packets of others, "
            f"{statistics.crc_errors} with a wrong CRC, {statistics.lost_edges} edges lost"
        )
        click.echo(f"replies      {_strength_text(summary.here)}")
        click.echo(f"requests     {_strength_text(summary.there)}, at the other side")
        click.echo(f"round trip   {_times_text(summary.round_trip_ns)}, TxDone to RxDone")
        click.echo(f"turn-round   {_times_text(summary.turn_round_ns)}, RxDone to start of the reply, there")
    return 0 if summary.received else CHECK_FAILED


def _answer(settings: LoRaSettings, wiring: Wiring, *, count: int | None, as_json: bool) -> None:
    """Answer on real hardware until enough has been answered or Ctrl-C."""
    answers: list[Answer] = []

    async def session(radio: SX127x, _clock: Clock) -> None:
        answered = 0
        async with aclosing(answer(radio)) as results:
            async for result in results:
                answers.append(result)
                if not as_json:
                    click.echo(_answer_line(result), err=True)
                answered += result.turn_round_ns is not None
                if answered == count:
                    return

    statistics = _on_hardware(session, settings, wiring)
    summary = summarise_answers(answers)
    if as_json:
        print_json(
            {
                "answered": summary.answered,
                "repeated": summary.repeated,
                "foreign": summary.foreign,
                "crc_errors": statistics.crc_errors,
                "lost_edges": statistics.lost_edges,
                "here": _strength(summary.heard),
                "turnaround_ms": _times(summary.turn_round_ns),
            }
        )
    else:
        click.echo(f"answered     {summary.answered} requests")
        click.echo(
            f"besides      {summary.repeated} repeated requests, {summary.foreign} packets of others, "
            f"{statistics.crc_errors} with a wrong CRC, {statistics.lost_edges} edges lost"
        )
        click.echo(f"requests     {_strength_text(summary.heard)}")
        click.echo(f"turn-round   {_times_text(summary.turn_round_ns)}, RxDone to start of the reply")


def _on_hardware(session: Session, settings: LoRaSettings, wiring: Wiring) -> RadioStatistics:
    """Run a session on the radio of this machine, to its end or to Ctrl-C."""

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
    """Run a session with a simulated radio, another one answering."""
    # Only here, so that a station's small computer does not load numpy to ping.
    import numpy as np

    from tsgt.simulation.kernel import (
        VirtualClock,
        VirtualTimeline,
        run_virtual,
    )
    from tsgt.simulation.lora import (
        Air,
        LinkModel,
        LogDistanceLoss,
        simulated_radio,
    )

    timeline, clock, rng = VirtualTimeline(), VirtualClock(0), np.random.default_rng(seed)
    places = {"here": (0.0, 0.0, 0.0), "there": (distance_m, 0.0, 0.0)}
    air = Air(timeline, rng, LinkModel(path_loss=LogDistanceLoss(positions_m=places)))

    async def run() -> RadioStatistics:
        here, there = (simulated_radio(air, name, timeline, clock, rng) for name in places)
        await here.start(settings)
        await there.start(settings)
        answering = asyncio.create_task(_drain(answer(there)))
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


async def _drain(answers: AsyncIterator[Answer]) -> None:
    async for _ in answers:
        pass


def _airtime_ms(payload_bytes: int, modem: Modem) -> float:
    return airtime_us(payload_bytes, **dataclasses.asdict(modem)) / 1000


def _exchange_line(exchange: Exchange) -> str:
    if exchange.reply is None or exchange.round_trip_ns is None:
        return f"{exchange.number:5d}  no reply"
    here, there = _strength_text(exchange.reply.here), _strength_text(exchange.reply.there)
    return f"{exchange.number:5d}  {exchange.round_trip_ns / 1e6:.3f} ms  here {here}  there {there}"


def _answer_line(result: Answer) -> str:
    if result.number is None:
        return f"    -  a packet of somebody else, {_strength_text(result.heard)}"
    if result.turn_round_ns is None:
        return f"{result.number:5d}  came again, {_strength_text(result.heard)}"
    return f"{result.number:5d}  answered after {result.turn_round_ns / 1e6:.3f} ms, {_strength_text(result.heard)}"


def _strength(strength: Strength | None) -> dict[str, float] | None:
    return None if strength is None else strength._asdict()


def _strength_text(strength: Strength | None) -> str:
    return "-" if strength is None else f"{strength.rssi_dbm:.1f} dBm, SNR {strength.snr_db:.1f} dB"


def _times(median_and_max_ns: tuple[int, int] | None) -> dict[str, float] | None:
    if median_and_max_ns is None:
        return None
    return {"median": median_and_max_ns[0] / 1e6, "max": median_and_max_ns[1] / 1e6}


def _times_text(median_and_max_ns: tuple[int, int] | None) -> str:
    if median_and_max_ns is None:
        return "-"
    return f"median {median_and_max_ns[0] / 1e6:.3f} ms, longest {median_and_max_ns[1] / 1e6:.3f} ms"
