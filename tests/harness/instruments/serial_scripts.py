"""Two hundred fault injection scripts for the link between a client and its instrument, and their invariants.

A script runs the real driver and its supervisor with a simulated Leica in virtual time, injects a fault into line or
instrument, and ends it at a known time. Every reported distance must be one that the instrument has offered, once, with the
time of its measurement; and the first one after the fault must come within the limit of the kind of fault.
``python benchmarks/run.py serial_faults`` runs all of them.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from tsgt.config import LeicaInstrumentConfig, ScenarioConfig
from tsgt.simulation.instrument import LineFault, SimulatedLine, SimulatedTotalStation
from tsgt.simulation.instrument.geocom import ForcedResponse
from tsgt.simulation.kernel import DriftingClock, VirtualClock, VirtualTimeline, run_virtual
from tsgt.simulation.world import scenario_world
from tsgt.station.geocom import ReturnCode, Rpc
from tsgt.station.instrument_supervisor import InstrumentSupervisor
from tsgt.station.leica import LeicaInstrument
from tsgt.station.session import ClientSession

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable

    from tsgt.config import TcpAddress
    from tsgt.simulation.instrument import ReportedDistance
    from tsgt.station import Reading
    from tsgt.station.serial import OpenPort

SETTLE_S: Final = 10.0
"""Duration before the fault: connecting takes two seconds."""

AFTER_S: Final = 20.0
"""Duration after the end of the fault."""

STAMP_LIMIT_NS: Final = 25_000_000
"""Bound on the error of a timestamp: replies take 20 to 60 ms, of which 20 are subtracted."""

DRIFT_PPM: Final = 15.0
LATENCY_MS: Final = 20.0
_ROUNDING: Final = 1e-9


@dataclass(slots=True)
class Bench:
    """The instrument, its cable, and a script's random numbers."""

    station: SimulatedTotalStation
    line: SimulatedLine
    rng: np.random.Generator


@dataclass(frozen=True, slots=True)
class Script:
    """A fault injection.

    Attributes
    ----------
    limit_s
        Bound on the time from the end of the fault to the next distance.
    act
        Injects the fault, and returns at its end.
    """

    kind: str
    seed: int
    limit_s: float
    act: Callable[[Bench], Awaitable[None]]
    checksum: bool = False


@dataclass(slots=True)
class ScriptResult:
    """The result of a script.

    Attributes
    ----------
    offered, reported
        Number of distances offered by the instrument, and reported by the client.
    violations
        Distances that were never offered, or reported twice, and wrong timestamps.
    recovery_s
        Time from the end of the fault to the next distance; infinite if there was none.
    """

    offered: int = 0
    reported: int = 0
    violations: list[str] = field(default_factory=list)
    recovery_s: float = float("inf")


def run_script(script: Script) -> ScriptResult:
    """Run a script in virtual time."""
    timeline = VirtualTimeline()
    return run_virtual(partial(_run, script, timeline), timeline)


async def _run(script: Script, timeline: VirtualTimeline) -> ScriptResult:
    world_rng, station_rng, script_rng = np.random.default_rng(script.seed).spawn(3)
    station = make_station(timeline, world_rng, station_rng)
    clock = DriftingClock(VirtualClock(0), drift_ppm=DRIFT_PPM)
    line = SimulatedLine(station, timeline, clock, name="cable")
    return await run_act(
        driver_config(Path("cable"), checksum=script.checksum, latency_ms=LATENCY_MS),
        station,
        line.open,
        clock,
        act=partial(script.act, Bench(station, line, script_rng)),
        limit_s=script.limit_s,
    )


def make_station(
    timeline: VirtualTimeline, world_rng: np.random.Generator, station_rng: np.random.Generator
) -> SimulatedTotalStation:
    """Return an instrument that tracks a robot."""
    scenario = ScenarioConfig()
    world = scenario_world(scenario, 200.0, world_rng)
    return SimulatedTotalStation(scenario.stations[0], scenario, world, timeline, station_rng)


def driver_config(port: Path | TcpAddress, **settings: Any) -> LeicaInstrumentConfig:
    """Return a configuration with the prism constant 0."""
    return LeicaInstrumentConfig(
        kind="leica", port=port, prism_type="user", prism_constant_mm=0.0, **settings
    )


async def run_act(
    config: LeicaInstrumentConfig,
    station: SimulatedTotalStation,
    open_port: OpenPort,
    clock: DriftingClock,
    *,
    act: Callable[[], Awaitable[None]],
    limit_s: float,
    after_s: float = AFTER_S,
    stamp_limit_ns: Callable[[Reading], float] = lambda _: STAMP_LIMIT_NS,
) -> ScriptResult:
    """Run driver and supervisor through a fault; ``stamp_limit_ns``: bound on the error of a reading's timestamp."""
    readings: list[tuple[int, Reading]] = []
    supervisor = InstrumentSupervisor(
        LeicaInstrument(config, open_port, clock),
        ClientSession(1, 1),
        clock,
        on_reading=lambda reading: readings.append((_now_ns(), reading)),
        on_record=_ignore,
        on_result=_ignore,
    )
    running = asyncio.create_task(supervisor.run())
    try:
        await asyncio.sleep(SETTLE_S)
        await act()
        ended_ns = _now_ns()
        await asyncio.sleep(after_s)
    finally:
        running.cancel()
        await asyncio.wait([running])
    outcome = ScriptResult(offered=len(station.reported_distances))
    usable = [reading for _, reading in readings if reading.status.usable]
    _check(outcome, usable, station, clock, stamp_limit_ns)
    usable_ns = [at_ns for at_ns, reading in readings if reading.status.usable and at_ns >= ended_ns]
    if usable_ns:
        outcome.recovery_s = (usable_ns[0] - ended_ns) / 1e9
    if outcome.recovery_s > limit_s:
        outcome.violations.append(f"no distance for {outcome.recovery_s:.1f} s after the end of the fault")
    return outcome


def _now_ns() -> int:
    return round(asyncio.get_running_loop().time() * 1e9)


def _ignore(_: object) -> None:
    """Ignore a callback."""


def _check(
    outcome: ScriptResult,
    usable: Iterable[Reading],
    station: SimulatedTotalStation,
    clock: DriftingClock,
    stamp_limit_ns: Callable[[Reading], float],
) -> None:
    """Compare reported with offered distances."""
    seen: set[ReportedDistance] = set()
    offered: dict[int, list[ReportedDistance]] = {}
    for each in station.reported_distances:
        offered.setdefault(each.instrument_ms, []).append(each)
    for reading in usable:
        outcome.reported += 1
        if reading.instrument_time_ns is None or reading.slope_distance_m is None:
            outcome.violations.append(f"usable without time or distance: {reading}")
            continue
        candidates = offered.get(reading.instrument_time_ns // 1_000_000, [])
        truth = next((each for each in candidates if _same(each, reading)), None)
        if truth is None:
            outcome.violations.append(f"never offered: {reading}")
            continue
        if truth in seen:
            outcome.violations.append(f"reported twice: {reading}")
        seen.add(truth)
        late_ns = clock.true_ns(reading.at_ns) - truth.true_ns
        if abs(late_ns) > stamp_limit_ns(reading):
            outcome.violations.append(f"timestamped {late_ns / 1e6:.1f} ms after the measurement: {reading}")


def _same(offered: ReportedDistance, reading: Reading) -> bool:
    pairs = (
        (offered.horizontal_angle_rad, reading.horizontal_angle_rad),
        (offered.zenith_angle_rad, reading.zenith_angle_rad),
        (offered.distance_m, reading.slope_distance_m),
    )
    return all(value is not None and abs(given - value) < _ROUNDING for given, value in pairs)


# --- The scripts ----------------------------------------------------------------------------------------------


def all_scripts() -> list[Script]:
    """Return the two hundred scripts, grouped by kind; the same in every run."""
    kinds: list[tuple[int, str, float, Callable[[Bench], Awaitable[None]], bool]] = [
        *((8, f"replies {fault}", 3.0, partial(_spoil, (fault,), 0.1), False) for fault in _LINE_FAULTS),
        (16, "all of these", 3.0, partial(_spoil, _LINE_FAULTS, 0.05), False),
        (16, "all of these, with checksums", 3.0, partial(_spoil, _LINE_FAULTS, 0.05), True),
        (8, "replies with other digits, with checksums", 3.0, _change_digits, True),
        *((4, f"codes of {name}", 3.0, partial(_force, codes), False) for name, codes in _families().items()),
        (12, "no replies", 5.0, partial(_silence, "drop_responses"), False),
        (8, "nothing reaches the instrument", 5.0, partial(_silence, "drop_requests"), False),
        (20, "unplugged", 3.0, _unplug, False),
        (12, "switched off and on, locked by hand", 3.0, _switch_off, False),
        (4, "another speed", 12.0, _change_baud, False),
    ]
    scripts: list[Script] = []
    for count, kind, limit_s, act, checksum in kinds:
        scripts += [Script(kind, len(scripts) + i, limit_s, act, checksum) for i in range(count)]
    return scripts


_LINE_FAULTS: Final = tuple(
    fault for fault in LineFault if fault not in (LineFault.NONE, LineFault.WRONG_DIGIT)
)

_FAMILY_NAMES: Final = {
    0: "TPS",
    1: "ANG",
    2: "ATA",
    3: "EDM",
    4: "GMF",
    5: "TMC",
    7: "MOT",
    9: "BMM",
    12: "COM",
    34: "AUT",
    36: "BAP",
    49: "KDM",
    51: "FTR",
}


def _families() -> dict[str, list[ReturnCode]]:
    families: dict[str, list[ReturnCode]] = {}
    for code in sorted(set(ReturnCode) - {ReturnCode.OK}):
        families.setdefault(_FAMILY_NAMES.get(code >> 8, str(code >> 8)), []).append(code)
    return families


async def _spoil(faults: tuple[LineFault, ...], share: float, bench: Bench) -> None:
    """Inject faults into a share of all replies for 15 s."""
    script = bench.line.faults.script
    for _ in range(15):
        for _ in range(60):
            hit = bench.rng.random() < share
            script.append(faults[bench.rng.integers(len(faults))] if hit else LineFault.NONE)
        await asyncio.sleep(1.0)
        script.clear()
    # Delayed replies are still on their way.
    await asyncio.sleep(bench.line.faults.delay_s)


async def _change_digits(bench: Bench) -> None:
    """Change a digit in one of ten replies for 15 s."""
    bench.line.faults.script.clear()
    for _ in range(15):
        bench.line.faults.script.extend(
            LineFault.WRONG_DIGIT if bench.rng.random() < 0.1 else LineFault.NONE for _ in range(60)
        )
        await asyncio.sleep(1.0)
        bench.line.faults.script.clear()


async def _force(codes: list[ReturnCode], bench: Bench) -> None:
    """Force return codes of a family now and then for 15 s."""
    for _ in range(15):
        code = codes[bench.rng.integers(len(codes))]
        com = code >> 8 == ReturnCode.COM_TIMEDOUT >> 8
        for rpc in (Rpc.TMC_GET_FULL_MEAS, Rpc.MOT_READ_LOCK_STATUS, None):
            if bench.rng.random() < 0.5:
                times = int(bench.rng.integers(1, 4))
                forced = ForcedResponse(
                    code=0 if com else code, com_code=code if com else 0, rpc=rpc, times=times
                )
                bench.station.server.forced.append(forced)
        await asyncio.sleep(1.0)
    bench.station.server.forced.clear()


async def _silence(which: str, bench: Bench) -> None:
    setattr(bench.line.faults, which, True)
    await asyncio.sleep(bench.rng.uniform(0.2, 30.0))
    setattr(bench.line.faults, which, False)


async def _unplug(bench: Bench) -> None:
    for _ in range(3):
        bench.line.plugged = False
        await asyncio.sleep(bench.rng.uniform(0.05, 20.0))
        bench.line.plugged = True
        if bench.rng.random() < 0.5:  # a loose contact
            await asyncio.sleep(bench.rng.uniform(0.05, 2.0))


async def _switch_off(bench: Bench) -> None:
    bench.station.switch_off()
    await asyncio.sleep(bench.rng.uniform(0.5, 30.0))
    bench.station.switch_on()
    await asyncio.sleep(bench.rng.uniform(5.5, 8.0))
    bench.station.lock_manually(1)


async def _change_baud(bench: Bench) -> None:
    bench.station.baud = int(bench.rng.choice([9600, 19_200, 38_400, 57_600]))
