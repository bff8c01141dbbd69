"""Injection and removal of each kind of fault."""

from __future__ import annotations

import asyncio
import errno
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from tsgt.simulation.faults.catalogue import RELOCK_DELAY_S, FaultKind
from tsgt.simulation.faults.computers import COMPUTER_INJECTORS
from tsgt.simulation.faults.operations import OPERATION_INJECTORS
from tsgt.simulation.faults.optics import OPTICS_INJECTORS
from tsgt.simulation.faults.setup_mistakes import MISTAKE_INJECTORS
from tsgt.simulation.faults.targets import target_computer, target_station
from tsgt.simulation.faults.tripods import TRIPOD_INJECTORS
from tsgt.simulation.instrument import LineFault, Lock
from tsgt.simulation.kernel import DriftingClock
from tsgt.simulation.lora.adversary import MAX_NOISE_BYTES, ReplayAttacker
from tsgt.simulation.mission import MASTER

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from tsgt.radio import Radio
    from tsgt.simulation.faults.catalogue import Fault
    from tsgt.simulation.mission import Mission

_OUTAGE_DB = 300.0
_JAMMER_GAIN_DB = -40.0
_JAMMING_BYTES = 200
_INTERFERENCE_RATE_HZ = 3.0
_SCRIPTED_RESPONSES = 60
# Design limits of the clock filters, by whether the protocol is superframe.
_RAMP_PPM_PER_S = {True: 0.1, False: 0.01}
_STEP_S: Final = (-3600.0, 3600.0)
_MASTER_STEP_S: Final = (-30.0, 30.0)
# Lengths of classic's messages, which cannot be distinguished from a station's.
_CLASSIC_LENGTHS = frozenset({2, 3, 9, 34})
_LINE_FAULTS = tuple(fault for fault in LineFault if fault not in (LineFault.NONE, LineFault.WRONG_DIGIT))
_MAX_LOOP_ROUNDS = 40
_RESUMED_S = 1.0  # Steps in which a resume is waited for
_RELOCK_CHECKS_S: Final = (2.0, 4.0, 6.0)


async def inject_fault(mission: Mission, fault: Fault) -> None:
    """Wait for a fault's start, inject it, and return when it is over."""
    await mission.sleep_until(fault.at_s)
    await _INJECTORS[fault.kind](mission, fault, np.random.default_rng(fault.seed))


async def relock_instruments(mission: Mission, at_s: float) -> None:
    """Relock all instruments on their prisms at a time, and check repeatedly that they are locked."""
    for check_s in (at_s, *(at_s + after_s for after_s in _RELOCK_CHECKS_S)):
        await mission.sleep_until(check_s)
        for number, instrument in mission.instruments.items():
            instrument.advance()
            if check_s == at_s or instrument.telescope.lock is not Lock.IN:
                _lock_manually(mission, number)


def _lock_manually(mission: Mission, number: int) -> None:
    if mission.instruments[number].on:
        mission.instruments[number].lock_manually(mission.prisms[number])


# --- Channel ---------------------------------------------------------------------------------------------------


async def _loss(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    """Lose packets with a random probability, with a new draw every 150 ms on average."""
    probability, name = rng.uniform(0.2, 1.0), target_computer(fault)
    while mission.now_s < fault.at_s + fault.duration_s:
        lost = rng.random() < probability
        mission.air.link.set_attenuation(MASTER, name, _OUTAGE_DB if lost else 0.0)
        await asyncio.sleep(rng.exponential(0.15))
    mission.air.link.set_attenuation(MASTER, name, 0.0)


async def _jamming(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    async def jam(radio: Radio) -> None:
        while True:
            await radio.transmit(rng.bytes(_JAMMING_BYTES))

    await _use_interferer(mission, fault, jam, gain_db=_JAMMER_GAIN_DB, sync_word=0x12)


async def _collisions(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    async def interfere(radio: Radio) -> None:
        while True:
            await asyncio.sleep(rng.exponential(1 / _INTERFERENCE_RATE_HZ))
            length = int(rng.integers(1, MAX_NOISE_BYTES + 1))
            if mission.superframe or length not in _CLASSIC_LENGTHS:
                await radio.transmit(rng.bytes(length))

    await _use_interferer(mission, fault, interfere)


async def _forgery(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    if mission.superframe:  # classic has no authentication
        await _use_interferer(
            mission, fault, ReplayAttacker(mission.clock, rng, _INTERFERENCE_RATE_HZ).attack
        )


async def _use_interferer(
    mission: Mission,
    fault: Fault,
    use: Callable[[Radio], Awaitable[None]],
    *,
    gain_db: float = 0.0,
    sync_word: int | None = None,
) -> None:
    """Use an additional radio for the duration of the fault."""
    name = f"{fault.kind} at {fault.at_s}"
    with suppress(TimeoutError):
        async with (
            asyncio.timeout(fault.duration_s),
            mission.interferer_radio(name, gain_db, sync_word)() as radio,
        ):
            await use(radio)


# --- Radios ----------------------------------------------------------------------------------------------------


async def _chip_reset(mission: Mission, fault: Fault, _rng: np.random.Generator) -> None:
    if (hardware := mission.computers[target_computer(fault)].hardware) is not None:
        hardware.chip.power_on_reset()


async def _chip_hang(mission: Mission, fault: Fault, _rng: np.random.Generator) -> None:
    if (hardware := mission.computers[target_computer(fault)].hardware) is not None:
        hardware.chip.hang()


async def _bus(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    """Disconnect the bus, also of a radio that is opened meanwhile."""
    level = bool(rng.random() < 0.5)
    ends_s = fault.at_s + fault.duration_s
    while mission.now_s < ends_s:
        if (hardware := mission.computers[target_computer(fault)].hardware) is not None:
            hardware.chip.disconnect_bus(level)
        await asyncio.sleep(0.05)
    if (hardware := mission.computers[target_computer(fault)].hardware) is not None:
        hardware.chip.reconnect_bus()


async def _interrupts(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    hardware = mission.computers[target_computer(fault)].hardware
    if hardware is None:
        return
    if rng.random() < 0.3:
        hardware.chip.drop_tx_done(int(rng.integers(1, 4)))
    else:
        hardware.hal.drop_edges(int(rng.integers(1, 6)), counted=bool(rng.random() < 0.5))


# --- Instruments -----------------------------------------------------------------------------------------------


async def _unplug(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    number = target_station(fault)
    mission.lines[number].plugged = False
    await asyncio.sleep(fault.duration_s)
    mission.lines[number].plugged = True
    if rng.random() < 0.5:  # a loose contact
        await asyncio.sleep(rng.uniform(0.01, 0.5))
        mission.lines[number].plugged = False
        await asyncio.sleep(rng.uniform(0.01, 0.5))
        mission.lines[number].plugged = True


async def _line(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    share = rng.choice([0.02, 0.1, 0.4])
    while mission.now_s < fault.at_s + fault.duration_s:
        script = mission.lines[target_station(fault)].faults.script
        script.clear()
        for _ in range(_SCRIPTED_RESPONSES):
            hit = rng.random() < share
            script.append(_LINE_FAULTS[rng.integers(len(_LINE_FAULTS))] if hit else LineFault.NONE)
        await asyncio.sleep(min(1.0, max(0.01, fault.at_s + fault.duration_s - mission.now_s)))
    mission.lines[target_station(fault)].faults.script.clear()


async def _stall(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    which = "drop_responses" if rng.random() < 0.5 else "drop_requests"
    setattr(mission.lines[target_station(fault)].faults, which, True)
    await asyncio.sleep(fault.duration_s)
    # A reboot may have replaced the line.
    setattr(mission.lines[target_station(fault)].faults, which, False)


async def _power(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    instrument = mission.instruments[target_station(fault)]
    instrument.switch_off()
    await asyncio.sleep(fault.duration_s)
    instrument.switch_on()
    await asyncio.sleep(rng.uniform(*RELOCK_DELAY_S))
    _lock_manually(mission, target_station(fault))


async def _prism_loss(mission: Mission, fault: Fault, _rng: np.random.Generator) -> None:
    instrument = mission.instruments[target_station(fault)]
    instrument.blocked = True
    await asyncio.sleep(fault.duration_s)
    instrument.blocked = False


async def _wrong_prism(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    number = target_station(fault)
    others = [prism for prism in mission.prisms.values() if prism != mission.prisms[number]]
    if not others or not mission.instruments[number].on:
        return
    mission.instruments[number].lock_manually(int(rng.choice(others)))
    await asyncio.sleep(fault.duration_s)
    _lock_manually(mission, number)


# --- Computers -------------------------------------------------------------------------------------------------


async def _drift(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    """Change the drift of a clock at a constant rate."""
    clock = mission.computers[target_computer(fault)].clock
    ppm_per_s = rng.uniform(-1, 1) * _RAMP_PPM_PER_S[mission.superframe]
    if not isinstance(clock, DriftingClock) or fault.station in mission.drifting:
        return
    mission.drifting.add(target_station(fault))
    for _ in range(round(fault.duration_s)):
        clock.change_drift(ppm_per_s)
        await asyncio.sleep(1.0)
    mission.drifting.discard(target_station(fault))


async def _clock_step(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    mission.computers[target_computer(fault)].clock.step(_step_ns(rng, _STEP_S))


async def _master_clock_step(mission: Mission, _fault: Fault, rng: np.random.Generator) -> None:
    mission.clock.step(_step_ns(rng, _MASTER_STEP_S))


def _step_ns(rng: np.random.Generator, span_s: tuple[float, float]) -> int:
    """Draw a clock step, log-uniformly scaled from milliseconds to hours."""
    return round(rng.uniform(*span_s) * 1e9 * 10 ** rng.uniform(-6, 0))


async def _reboot(mission: Mission, fault: Fault, _rng: np.random.Generator) -> None:
    await mission.reboot(target_station(fault), fault.at_s, fault.duration_s)


async def _crash(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    """Kill a daemon just after a transmission, or at an arbitrary time."""
    if rng.random() < 0.7:
        airtime_ns = mission.air.airtime_ns
        for _ in range(2000):
            if mission.air.airtime_ns != airtime_ns:
                break
            await asyncio.sleep(0.001)
        await asyncio.sleep(rng.choice([0.0, 0.05, 0.09]))
    for _ in range(int(rng.integers(_MAX_LOOP_ROUNDS))):
        await asyncio.sleep(0)
    await mission.crash(target_computer(fault), down_s=fault.duration_s)


async def _torn_write(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    torn = asyncio.Event()
    loop = asyncio.get_running_loop()
    computer = mission.computers[target_computer(fault)]
    if (writes := computer.disk_writer) is None:
        return
    writes.tear_next_write(rng.random(), partial(loop.call_soon_threadsafe, torn.set))
    with suppress(TimeoutError):
        async with asyncio.timeout(10):
            await torn.wait()
    while computer.is_suspended:  # noqa: ASYNC110 (waits in virtual time)
        await asyncio.sleep(_RESUMED_S)
    await mission.crash(computer.name, down_s=fault.duration_s)


async def _disk(error: int, mission: Mission, fault: Fault, _rng: np.random.Generator) -> None:
    disk = mission.computers[target_computer(fault)].disk
    disk.fail_writes(error, round(fault.at_s * 1e9), round((fault.at_s + fault.duration_s) * 1e9))
    await asyncio.sleep(fault.duration_s)
    disk.write_error = None


# --- Stream subscribers ---------------------------------------------------------------------------------------


async def _slow_reader(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    """Connect without reading, then read everything."""
    with suppress(OSError):  # the master is down
        reader, writer = await asyncio.open_unix_connection(mission.stream_socket())
        await asyncio.sleep(fault.duration_s)
        with suppress(TimeoutError):
            async with asyncio.timeout(1.0):
                while rng.random() < 0.999 and await reader.read(65_536):
                    pass
        writer.close()


async def _vanishing_reader(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    """Connect, send unexpected bytes, and abort the connection."""
    with suppress(OSError):
        _, writer = await asyncio.open_unix_connection(mission.stream_socket())
        writer.write(rng.bytes(int(rng.integers(200))))
        await asyncio.sleep(fault.duration_s)
        writer.transport.abort()


_INJECTORS: Final[Mapping[FaultKind, Callable[[Mission, Fault, np.random.Generator], Awaitable[None]]]] = {
    FaultKind.LOSS: _loss,
    FaultKind.JAMMING: _jamming,
    FaultKind.COLLISIONS: _collisions,
    FaultKind.FORGERY: _forgery,
    FaultKind.CHIP_RESET: _chip_reset,
    FaultKind.CHIP_HANG: _chip_hang,
    FaultKind.BUS: _bus,
    FaultKind.INTERRUPTS: _interrupts,
    FaultKind.UNPLUG: _unplug,
    FaultKind.LINE: _line,
    FaultKind.STALL: _stall,
    FaultKind.POWER: _power,
    FaultKind.PRISM_LOSS: _prism_loss,
    FaultKind.WRONG_PRISM: _wrong_prism,
    FaultKind.DRIFT: _drift,
    FaultKind.CLOCK_STEP: _clock_step,
    FaultKind.REBOOT: _reboot,
    FaultKind.MASTER_CLOCK_STEP: _master_clock_step,
    FaultKind.CLIENT_CRASH: _crash,
    FaultKind.MASTER_CRASH: _crash,
    FaultKind.TORN_WRITE: _torn_write,
    FaultKind.DISK_FULL: partial(_disk, errno.ENOSPC),
    FaultKind.DISK_READ_ONLY: partial(_disk, errno.EROFS),
    FaultKind.SLOW_READER: _slow_reader,
    FaultKind.VANISHING_READER: _vanishing_reader,
    **COMPUTER_INJECTORS,
    **MISTAKE_INJECTORS,
    **OPTICS_INJECTORS,
    **TRIPOD_INJECTORS,
    **OPERATION_INJECTORS,
}
