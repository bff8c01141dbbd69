"""Two hundred fault injection scripts for an instrument behind TCP over a Wi-Fi, and their invariants.

As :mod:`harness.instruments.serial_scripts`, for the network. Every timestamp has to be within three of its stated sigmas, whatever the
delays, and sigmas above 10 ms are none that may be used.
``python benchmarks/run.py network_faults`` runs all of them.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
from harness.instruments.network_line import PeerKind, SimulatedNetwork
from harness.instruments.serial_scripts import (
    DRIFT_PPM,
    LATENCY_MS,
    ScriptResult,
    driver_config,
    make_station,
    run_act,
)

from tsgt.config import TcpAddress
from tsgt.simulation.kernel import DriftingClock, VirtualClock, VirtualTimeline, run_virtual

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from harness.instruments.network_line import NetworkFaults

    from tsgt.simulation.instrument import SimulatedTotalStation
    from tsgt.station import Reading

AFTER_S: Final = 40.0
"""Duration after the end of the fault."""

MAX_SIGMAS: Final = 3.0
MAX_SIGMA_NS: Final = 10_000_000
_FAULT_S: Final = 15.0


@dataclass(slots=True)
class NetworkBench:
    """The instrument, its network, and a script's random numbers."""

    station: SimulatedTotalStation
    network: SimulatedNetwork
    timeline: VirtualTimeline
    rng: np.random.Generator

    def stall(self, seconds: float) -> None:
        """Let nothing arrive for a duration."""
        self.network.faults.stalled_until_ns = self.timeline.now_ns() + round(seconds * 1e9)


@dataclass(frozen=True, slots=True)
class NetworkScript:
    """A fault injection.

    Attributes
    ----------
    limit_s
        Bound on the time from the end of the fault to the next distance.
    latency_known
        Whether the instrument's own delay is configured.
    """

    kind: str
    seed: int
    limit_s: float
    act: Callable[[NetworkBench], Awaitable[None]]
    latency_known: bool = False


def run_network_script(script: NetworkScript) -> ScriptResult:
    """Run a script in virtual time."""
    timeline = VirtualTimeline()
    return run_virtual(partial(_run, script, timeline), timeline)


async def _run(script: NetworkScript, timeline: VirtualTimeline) -> ScriptResult:
    world_rng, station_rng, script_rng, network_rng = np.random.default_rng(script.seed).spawn(4)
    station = make_station(timeline, world_rng, station_rng)
    clock = DriftingClock(VirtualClock(0), drift_ppm=DRIFT_PPM)
    network = SimulatedNetwork(station, timeline, clock, network_rng)
    latency_ms = LATENCY_MS if script.latency_known else None
    return await run_act(
        driver_config(TcpAddress("simulated", 1212), latency_ms=latency_ms),
        station,
        network.open,
        clock,
        act=partial(script.act, NetworkBench(station, network, timeline, script_rng)),
        limit_s=script.limit_s,
        after_s=AFTER_S,
        stamp_limit_ns=_stamp_limit_ns,
    )


def _stamp_limit_ns(reading: Reading) -> float:
    return MAX_SIGMAS * reading.sigma_ns if reading.sigma_ns <= MAX_SIGMA_NS else 0.0


# --- The scripts ----------------------------------------------------------------------------------------------


def all_network_scripts() -> list[NetworkScript]:
    """Return the two hundred scripts, grouped by kind; the same in every run."""
    kinds: list[tuple[int, str, float, Callable[[NetworkBench], Awaitable[None]]]] = [
        (8, "jitter of 5 ms", 5.0, partial(_delay, jitter_ms=5.0)),
        (8, "jitter of 30 ms", 5.0, partial(_delay, jitter_ms=30.0)),
        (12, "bursts, every tenth packet", 5.0, partial(_delay, burst_share=0.1)),
        (8, "bursts, every second packet", 8.0, partial(_delay, burst_share=0.5)),
        (8, "requests slower than responses", 5.0, partial(_delay, request_ms=40.0)),
        (8, "responses slower than requests", 5.0, partial(_delay, response_ms=40.0)),
        (8, "segments", 5.0, partial(_delay, pieces=8, jitter_ms=5.0)),
        (20, "stalls of up to 6 s", 12.0, _stall),
        (8, "stalls of up to a minute", 25.0, _stall_long),
        (20, "connection lost", 8.0, _drop),
        (8, "connection lost again and again", 8.0, _drop_often),
        (16, "half-open connection", 25.0, _half_open),
        (8, "refused", 8.0, partial(_other_peer, PeerKind.REFUSED)),
        (8, "no answer", 14.0, partial(_other_peer, PeerKind.UNREACHABLE)),
        (8, "another client, silent", 16.0, partial(_other_peer, PeerKind.SILENT)),
        (8, "another client, closed at once", 8.0, partial(_other_peer, PeerKind.CLOSING)),
        (8, "another server", 16.0, partial(_other_peer, PeerKind.FOREIGN)),
        (12, "switched off and on, locked by hand", 8.0, _switch_off),
        (16, "all of these", 25.0, _everything),
    ]
    scripts: list[NetworkScript] = []
    for count, kind, limit_s, act in kinds:
        scripts += [
            NetworkScript(kind, 1000 + len(scripts) + i, limit_s, act, latency_known=i % 2 == 1)
            for i in range(count)
        ]
    return scripts


async def _delay(bench: NetworkBench, **delays: float) -> None:
    """Change the delays for 15 s."""
    before = {name: getattr(bench.network.faults, name) for name in delays}
    _set(bench.network.faults, delays)
    await asyncio.sleep(_FAULT_S)
    _set(bench.network.faults, before)


def _set(faults: NetworkFaults, values: dict[str, float]) -> None:
    for name, value in values.items():
        setattr(faults, name, value)


async def _stall(bench: NetworkBench) -> None:
    for _ in range(5):
        stall_s = bench.rng.uniform(0.5, 6.0)
        bench.stall(stall_s)
        await asyncio.sleep(stall_s + bench.rng.uniform(0.0, 3.0))


async def _stall_long(bench: NetworkBench) -> None:
    stall_s = bench.rng.uniform(6.0, 60.0)
    bench.stall(stall_s)
    await asyncio.sleep(stall_s)


async def _drop(bench: NetworkBench) -> None:
    for _ in range(3):
        bench.network.drop()
        await asyncio.sleep(bench.rng.uniform(0.0, 8.0))


async def _drop_often(bench: NetworkBench) -> None:
    for _ in range(20):
        bench.network.drop()
        await asyncio.sleep(bench.rng.uniform(0.0, 1.5))


async def _half_open(bench: NetworkBench) -> None:
    bench.network.faults.half_open = True
    await asyncio.sleep(bench.rng.uniform(0.2, 30.0))
    # The old connection stays dead.
    bench.network.faults.half_open = False
    bench.network.drop()


async def _other_peer(peer: PeerKind, bench: NetworkBench) -> None:
    bench.network.faults.peer = peer
    bench.network.drop()
    await asyncio.sleep(bench.rng.uniform(1.0, 30.0))
    bench.network.faults.peer = PeerKind.INSTRUMENT


async def _switch_off(bench: NetworkBench) -> None:
    bench.station.switch_off()
    bench.network.drop()
    bench.network.faults.peer = PeerKind.UNREACHABLE
    await asyncio.sleep(bench.rng.uniform(0.5, 30.0))
    bench.station.switch_on()
    await asyncio.sleep(bench.rng.uniform(5.5, 8.0))
    bench.network.faults.peer = PeerKind.INSTRUMENT
    bench.station.lock_manually(1)


async def _everything(bench: NetworkBench) -> None:
    rng, faults = bench.rng, bench.network.faults
    for _ in range(15):
        faults.jitter_ms, faults.burst_share = rng.uniform(0.5, 30.0), rng.choice([0.0, 0.1, 0.3])
        faults.pieces = int(rng.integers(1, 9))
        match rng.integers(8):
            case 0:
                bench.network.drop()
            case 1:
                bench.stall(rng.uniform(0.2, 4.0))
            case 2:
                faults.peer = PeerKind(rng.choice([each.value for each in PeerKind]))
            case 3:
                faults.request_ms, faults.response_ms = rng.uniform(1.0, 30.0, 2)
            case _:
                faults.peer = PeerKind.INSTRUMENT
        await asyncio.sleep(rng.uniform(0.2, 3.0))
    faults.jitter_ms, faults.burst_share, faults.pieces = 1.0, 0.0, 1
    faults.request_ms = faults.response_ms = 2.0
    faults.peer = PeerKind.INSTRUMENT
    bench.network.drop()
