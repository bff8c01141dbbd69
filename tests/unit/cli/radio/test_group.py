"""``tsgt radio airtime`` and ``ping``."""

from __future__ import annotations

import asyncio
from contextlib import aclosing
from functools import partial
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import pytest

from tsgt.cli.radio import ping as ping_command
from tsgt.radio import LoRaSettings
from tsgt.radio.ping import ping, respond
from tsgt.radio.sx127x import Wiring
from tsgt.simulation.kernel import VirtualClock, VirtualTimeline, run_virtual
from tsgt.simulation.lora import Air, LinkModel, SimulatedHal, SX1276Chip, simulated_radio

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Coroutine

    from harness.files.cli import Tsgt

    from tsgt.radio import Radio
    from tsgt.radio.ping import Exchange

T = TypeVar("T")

QUICK = ("radio", "ping", "--simulated", "--sf", 7, "--bandwidth-khz", 500)


def test_airtime_of_the_paper(tsgt: Tsgt) -> None:
    """The paper's modem sends 34 bytes in 139.776 ms, at 366.2 bytes per second."""
    outcome = tsgt(
        *(
            "radio",
            "airtime",
            "--sf",
            9,
            "--bandwidth-khz",
            250,
            "--coding-rate",
            6,
            "--payload",
            34,
            "--json",
        )
    )
    assert outcome.code == 0
    assert outcome.json() == {
        "airtime_ms": 139.776,
        "symbols": 68.25,
        "payload_symbols": 56,
        "low_data_rate": False,
        "bit_rate_Bps": 366.2109375,
    }


def test_airtime_as_text(tsgt: Tsgt) -> None:
    """Without --json the output is text."""
    outcome = tsgt("radio", "airtime", "--sf", 12, "--bandwidth-khz", "125", "--payload", 2, "--preamble", 6)
    assert outcome.out.splitlines() == [
        "time on air  794.624 ms",
        "symbols      24.25, of which 14 for header, payload and CRC",
        "bit rate     30.5 B/s, low data rate optimisation on",
    ]


@pytest.mark.parametrize(
    "wrong",
    [
        ("--sf", 6),
        ("--bandwidth-khz", 200),
        ("--bandwidth-khz", "nan"),
        ("--coding-rate", 4),
        ("--preamble", 5),
        ("--payload", 0),
        ("--payload", 256),
    ],
)
def test_airtime_rejects_invalid_settings(tsgt: Tsgt, wrong: tuple[str, object]) -> None:
    """A value out of range is a usage error that names its option."""
    outcome = tsgt("radio", "airtime", "--payload", 34, *wrong)
    assert outcome.code == 2
    assert wrong[0] in outcome.err


def test_ping_on_simulated_radios(tsgt: Tsgt) -> None:
    """All requests are replied to, and the summary has all figures."""
    outcome = tsgt(*QUICK, "--count", 20, "--distance-m", 1000, "--json")
    assert outcome.code == 0
    summary = outcome.json()
    assert (summary["sent"], summary["received"], summary["loss"]) == (20, 20, 0.0)
    assert (summary["late"], summary["unknown_packets"], summary["crc_errors"], summary["lost_edges"]) == (
        0,
        0,
        0,
        0,
    )
    # 2 dBm less 91.6 dB of free space over 1 km at 905 MHz
    assert summary["here"]["rssi_dbm"] == pytest.approx(-89.6, abs=1.5)
    assert summary["there"]["rssi_dbm"] == pytest.approx(-89.6, abs=1.5)
    # The reply's time on air, twice RxDone's 0.74 symbols of 0.256 ms, and what the chip needs to start
    assert summary["round_trip_ms"]["median"] == pytest.approx(summary["airtime_ms"] + 0.6, abs=0.3)
    assert summary["turnaround_ms"]["max"] < 1
    assert summary["packets_per_s"] == pytest.approx(1000 / summary["airtime_ms"], rel=0.1)


def test_ping_out_of_range_fails(tsgt: Tsgt) -> None:
    """Without any reply the exit code is 3."""
    outcome = tsgt(*QUICK, "--count", 3, "--distance-m", 1e6, "--json")
    assert outcome.code == 3
    summary = outcome.json()
    assert (summary["received"], summary["loss"], summary["round_trip_ms"]) == (0, 1.0, None)


def test_ping_without_reply_as_text(tsgt: Tsgt) -> None:
    """The text says that no reply was received."""
    outcome = tsgt(*QUICK, "--count", 2, "--distance-m", 1e6)
    assert outcome.code == 3
    assert "received     0 replies, 100.0% lost" in outcome.out
    assert outcome.err.count("no reply") == 2


def test_ping_shows_each_reply_and_a_summary(tsgt: Tsgt) -> None:
    """Progress goes to stderr, the summary to stdout."""
    outcome = tsgt(*QUICK, "--count", 3, "--payload", 20)
    assert [line.split()[0] for line in outcome.err.splitlines()] == ["0", "1", "2"]
    assert "sent         3 requests of 20 bytes, 15.936 ms on air" in outcome.out
    assert "round trip   median 16." in outcome.out


def test_simulated_ping_is_deterministic(tsgt: Tsgt) -> None:
    """The same seed gives the same figures, another seed others."""
    marginal = (*QUICK, "--count", 40, "--distance-m", 28_000, "--json")
    same, again, other = (tsgt(*marginal, "--seed", seed).out for seed in (1, 1, 2))
    assert same == again
    assert same != other


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--simulated", "--answer"), "--answer"),
        ((), "--frequency-mhz"),
        (("--answer",), "--frequency-mhz"),
        (("--simulated", "--power-dbm", 20), "--power-dbm"),
        (("--simulated", "--payload", 12), "--payload"),
        (("--simulated", "--frequency-mhz", "nan"), "--frequency-mhz"),
        (("--simulated", "--backend", "wiringpi"), "--backend"),
        (("--simulated", "--spi-hz", 10_000_001), "--spi-hz"),
        (("--simulated", "--distance-m", "nan"), "--distance-m"),
        (("--simulated", "--sync-word", "0x100"), "--sync-word"),
        (("--simulated", "--sync-word", "lora"), "--sync-word"),
    ],
)
def test_ping_usage_errors_name_the_option(tsgt: Tsgt, arguments: tuple[str, ...], complaint: str) -> None:
    """A usage error names the option to change."""
    outcome = tsgt("radio", "ping", *arguments)
    assert outcome.code == 2
    assert complaint in outcome.err


@pytest.mark.parametrize("backend", ["gpiod", "rpi-gpio"])
@pytest.mark.parametrize("answer", [[], ["--answer"]])
def test_missing_radio_is_one_line(tsgt: Tsgt, backend: str, answer: list[str]) -> None:
    """On a machine without SPI the error says what is missing; exit code 1."""
    outcome = tsgt("radio", "ping", *answer, "--frequency-mhz", 905, "--backend", backend, "--spi-bus", 97)
    assert outcome.code == 1
    assert outcome.err.startswith("error: ")
    assert outcome.err.count("\n") == 1


def test_ping_on_hardware(tsgt: Tsgt, bench: Bench) -> None:
    """The command pings the other machine, which runs the answering side."""
    bench.peer_does(lambda radio: _drain(respond(radio)))
    outcome = tsgt(
        "radio", "ping", "--frequency-mhz", 905, "--count", 5, "--nss-pin", -1, "--sync-word", "52", "--json"
    )
    assert outcome.code == 0
    assert (outcome.json()["simulated"], outcome.json()["received"]) == (False, 5)
    assert bench.wiring == Wiring(reset_pin=17, dio0_pin=4, nss_pin=None)


def test_answering_on_hardware(tsgt: Tsgt, bench: Bench) -> None:
    """With --answer the command replies to the given number of requests and prints a summary."""
    bench.peer_does(lambda radio: _drain(_requests(radio)))
    outcome = tsgt("radio", "ping", "--answer", "--frequency-mhz", 905, "--count", 3, "--json")
    assert outcome.code == 0
    summary = outcome.json()
    assert (summary["answered"], summary["repeated"], summary["unknown_packets"]) == (3, 0, 1)
    assert summary["turnaround_ms"]["median"] < 1


def test_answering_shows_each_request_and_a_summary(tsgt: Tsgt, bench: Bench) -> None:
    """Progress goes to stderr, the summary to stdout."""
    bench.peer_does(lambda radio: _drain(_requests(radio)))
    outcome = tsgt("radio", "ping", "--answer", "--frequency-mhz", 905, "--count", 2)
    assert [line.split()[0] for line in outcome.err.splitlines()] == ["-", "0", "1"]
    assert outcome.out.startswith("answered     2 requests\n")


class Bench:
    """Our machine's radio on a simulated chip in virtual time, and another radio controlled by the test."""

    def __init__(self) -> None:
        self.wiring: Wiring | None = None
        self._timeline = VirtualTimeline()
        self._clock = VirtualClock(0)
        self._rng = np.random.default_rng(0)
        self._air = Air(self._timeline, self._rng, LinkModel())
        self._peer: Callable[[Radio], Coroutine[None, None, None]]

    def peer_does(self, role: Callable[[Radio], Coroutine[None, None, None]]) -> None:
        """Set what the other radio does meanwhile."""
        self._peer = role

    def open_hal(self, wiring: Wiring) -> SimulatedHal:
        """Replace the hardware."""
        self.wiring = wiring
        return SimulatedHal(SX1276Chip(self._timeline, partial(self._air.join, name="here"), self._rng))

    def run(self, main: Callable[[], Coroutine[None, None, T]]) -> T:
        """Run both sides in virtual time."""

        async def both() -> T:
            peer = simulated_radio(self._air, "there", self._timeline, self._clock, self._rng)
            await peer.start(
                LoRaSettings(
                    frequency_hz=905_000_000, spreading_factor=9, bandwidth_hz=250_000, coding_rate=6
                )
            )
            role = asyncio.create_task(self._peer(peer))
            result = await main()
            role.cancel()
            await asyncio.wait([role])
            await peer.close()
            return result

        return run_virtual(both, self._timeline)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    """Run the command on simulated hardware."""
    made = Bench()
    monkeypatch.setattr(ping_command, "open_hal", made.open_hal)
    monkeypatch.setattr(ping_command, "SystemClock", lambda: VirtualClock(0))
    monkeypatch.setattr(ping_command, "service", made)
    return made


async def _requests(radio: Radio) -> AsyncIterator[Exchange]:
    """Send an unknown packet, then requests without end."""
    await asyncio.sleep(1)
    await radio.transmit(b"t1")
    async with aclosing(
        ping(radio, VirtualClock(0), session=1, count=100, payload_bytes=20, timeout_ns=500_000_000)
    ) as exchanges:
        async for exchange in exchanges:
            yield exchange


async def _drain(results: AsyncIterator[object]) -> None:
    async for _ in results:
        pass


def test_channel_outside_the_region_is_rejected(tsgt: Tsgt) -> None:
    """With --region the command does not transmit outside the region's bands."""
    done = tsgt("radio", "ping", "--simulated", "--frequency-mhz", 905, "--region", "EU868")
    assert done.code == 1
    assert "905 MHz with 250 kHz is not within a band of EU868" in done.err


def test_power_above_the_limit_of_the_region_is_rejected(tsgt: Tsgt) -> None:
    """With --region the command does not transmit more than is legal, even if the radio cannot do with less."""
    done = tsgt("radio", "ping", "--simulated", "--frequency-mhz", 905, "--region", "CA915")
    assert done.code == 1
    assert "CA915 allows" in done.err
    assert "2 dBm would be transmitted" in done.err


LIMITED = ("radio", "ping", "--simulated", "--region", "EU868", "--bandwidth-khz", 125, "--sf", 9)


@pytest.mark.parametrize(
    ("frequency_mhz", "duty_cycle"),
    [(864, 0.001), (868.3, 0.01), (869.0, 0.001), (869.525, 0.1), (865.0, 0.001)],
)
def test_duty_cycle_of_the_band_limits_the_count(tsgt: Tsgt, frequency_mhz: float, duty_cycle: float) -> None:
    """With --region no radio transmits for longer than its band allows in an hour; the stricter of adjoining bands counts."""
    airtime_ms = tsgt("radio", "airtime", *LIMITED[5:], "--payload", 34, "--json").json()["airtime_ms"]
    most = int(duty_cycle * 3_600_000 / airtime_ms)
    channel = (*LIMITED, "--frequency-mhz", frequency_mhz)
    done = tsgt(*channel, "--count", most + 1)
    assert done.code == 1
    assert f"--count {most}" in done.err
    if most < 100:
        assert tsgt(*channel).code == 1
        assert tsgt(*channel, "--count", most).code == 0


@pytest.mark.parametrize("count", [(), ("--count", 1000)])
def test_side_that_responds_obeys_the_duty_cycle(tsgt: Tsgt, count: tuple[object, ...]) -> None:
    """It transmits as long as the other side; without --count for ever, and with the longest reply."""
    done = tsgt("radio", "ping", "--answer", "--region", "EU868", "--frequency-mhz", 868.3, *count)
    assert done.code == 1
    assert "1 % of any hour" in done.err
    assert "--count 48" in done.err


def test_band_without_a_duty_cycle_allows_any_count(tsgt: Tsgt) -> None:
    """At the power of the region."""
    options = ("--simulated", "--region", "EU868", "--frequency-mhz", 869.85, "--sf", 12, "--count", 300)
    assert tsgt("radio", "ping", *options).code == 0


def test_attenuator_makes_a_channel_legal(tsgt: Tsgt) -> None:
    """Where the least power of the radio is too much, an error says so, and the channel is not recommended again."""
    options = ("radio", "ping", "--answer", "--region", "EU433", "--frequency-mhz", 433.92)
    done = tsgt(*options)
    assert done.code == 1
    assert "EU433 allows at any duty cycle 0.0 dBm" in done.err
    assert "an attenuator of 2.0 dB: --antenna-gain-dbi 0.1" in done.err


@pytest.mark.parametrize(
    "channel",
    [("EU433", 433.92, 10), ("EU868", 869.85, 14)],
)
def test_few_packets_may_have_the_power_of_a_limited_duty_cycle(
    tsgt: Tsgt, channel: tuple[str, float, int]
) -> None:
    """They stay below its limit; many do not."""
    region, frequency_mhz, power_dbm = channel
    options = (
        "radio",
        "ping",
        "--simulated",
        "--region",
        region,
        "--frequency-mhz",
        frequency_mhz,
        "--power-dbm",
        power_dbm,
    )
    assert tsgt(*options, "--count", 2).code == 0
    assert tsgt(*options, "--count", 5000).code == 1
