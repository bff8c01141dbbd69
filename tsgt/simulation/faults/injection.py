"""How each kind of fault is done to a mission, and undone."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from tsgt.simulation.faults.catalogue import AFTER_BOOT_S, FaultKind
from tsgt.simulation.instrument import LineFault, Lock
from tsgt.simulation.kernel import DriftingClock
from tsgt.simulation.lora.adversary import LONGEST_NOISE_BYTES, ForeignRadio
from tsgt.simulation.mission import FULL, MASTER, READ_ONLY, station_name

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from tsgt.radio import Radio
    from tsgt.simulation.faults.catalogue import Fault
    from tsgt.simulation.mission import Mission

_OUT_OF_REACH_DB = 300.0
_JAMMER_GAIN_DB = -40.0
_JAMMING_BYTES = 200
_PER_S = 3.0
_ANSWERS_PER_S = 60
# What the clocks of both protocols are made for: 0.01 ppm each second, and ten times as much.
_RAMP_PPM_PER_S = {True: 0.1, False: 0.01}
_STEP_S: Final = (-3600.0, 3600.0)
_MASTER_STEP_S: Final = (-30.0, 30.0)
# Lengths of classic's own messages: whoever sends one of these is believed, there is no telling it from a station's.
_CLASSIC_LENGTHS = frozenset({2, 3, 9, 34})
_LINE_FAULTS = tuple(fault for fault in LineFault if fault not in (LineFault.NONE, LineFault.DIGIT))
_TURNS = 40
_LOOKS_AFTER_S: Final = (2.0, 4.0, 6.0)


async def act(mission: Mission, fault: Fault) -> None:
    """Do a fault at its time, and return when it is over."""
    await mission.sleep_until(fault.at_s)
    await _ACTS[fault.kind](mission, fault, np.random.default_rng(fault.seed))


def _name(fault: Fault) -> str:
    return MASTER if fault.station is None else station_name(fault.station)


def _number(fault: Fault) -> int:
    if fault.station is None:
        raise ValueError(f"a fault {fault.kind} is of a station")
    return fault.station


async def see_to_instruments(mission: Mission, at_s: float) -> None:
    """Let people lock all instruments on their prisms, when the faults are over, and look again whether they are."""
    for look_s in (at_s, *(at_s + after_s for after_s in _LOOKS_AFTER_S)):
        await mission.sleep_until(look_s)
        for number, instrument in mission.instruments.items():
            instrument.advance()
            if look_s == at_s or instrument.telescope.lock is not Lock.IN:
                _lock_by_hand(mission, number)


def _lock_by_hand(mission: Mission, number: int) -> None:
    if mission.instruments[number].on:
        mission.instruments[number].lock_by_hand(mission.prisms[number])


# --- The channel ----------------------------------------------------------------------------------------------


async def _loss(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    """Lose each packet with a probability: the way between the two changes from packet to packet."""
    probability, name = rng.uniform(0.2, 1.0), _name(fault)
    while mission.now_s < fault.at_s + fault.seconds:
        lost = rng.random() < probability
        mission.air.link.attenuate(MASTER, name, _OUT_OF_REACH_DB if lost else 0.0)
        await asyncio.sleep(rng.exponential(0.15))
    mission.air.link.attenuate(MASTER, name, 0.0)


async def _jamming(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    async def jam(radio: Radio) -> None:
        while True:
            await radio.transmit(rng.bytes(_JAMMING_BYTES))

    await _beside(mission, fault, jam, gain_db=_JAMMER_GAIN_DB, sync_word=0x12)


async def _collisions(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    async def talk(radio: Radio) -> None:
        while True:
            await asyncio.sleep(rng.exponential(1 / _PER_S))
            length = int(rng.integers(1, LONGEST_NOISE_BYTES + 1))
            if mission.superframe or length not in _CLASSIC_LENGTHS:
                await radio.transmit(rng.bytes(length))

    await _beside(mission, fault, talk)


async def _forgery(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    if mission.superframe:  # classic believes whoever speaks it
        await _beside(mission, fault, ForeignRadio(mission.clock, rng, _PER_S).use)


async def _beside(
    mission: Mission,
    fault: Fault,
    use: Callable[[Radio], Awaitable[None]],
    *,
    gain_db: float = 0.0,
    sync_word: int | None = None,
) -> None:
    """Let somebody use a radio of his own beside the mission's, for as long as the fault lasts."""
    name = f"{fault.kind} at {fault.at_s}"
    with suppress(TimeoutError):
        async with asyncio.timeout(fault.seconds), mission.stranger(name, gain_db, sync_word)() as radio:
            await use(radio)


# --- The radios -----------------------------------------------------------------------------------------------


async def _chip_reset(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    del rng
    if (hardware := mission.computers[_name(fault)].hardware) is not None:
        hardware.chip.reset_itself()


async def _chip_hang(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    del rng
    if (hardware := mission.computers[_name(fault)].hardware) is not None:
        hardware.chip.hang()


async def _bus(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    """Cut the bus; a radio that is opened meanwhile has none either."""
    level = bool(rng.random() < 0.5)
    ends_s = fault.at_s + fault.seconds
    while mission.now_s < ends_s:
        if (hardware := mission.computers[_name(fault)].hardware) is not None:
            hardware.chip.lose_bus(level)
        await asyncio.sleep(0.05)
    if (hardware := mission.computers[_name(fault)].hardware) is not None:
        hardware.chip.restore_bus()


async def _interrupts(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    hardware = mission.computers[_name(fault)].hardware
    if hardware is None:
        return
    if rng.random() < 0.3:
        hardware.chip.lose_tx_done(int(rng.integers(1, 4)))
    else:
        hardware.hal.lose_edges(int(rng.integers(1, 6)), counted=bool(rng.random() < 0.5))


# --- The instruments ------------------------------------------------------------------------------------------


async def _unplug(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    number = _number(fault)
    mission.lines[number].plugged = False
    await asyncio.sleep(fault.seconds)
    mission.lines[number].plugged = True
    if rng.random() < 0.5:  # a loose contact
        await asyncio.sleep(rng.uniform(0.01, 0.5))
        mission.lines[number].plugged = False
        await asyncio.sleep(rng.uniform(0.01, 0.5))
        mission.lines[number].plugged = True


async def _line(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    share = rng.choice([0.02, 0.1, 0.4])
    while mission.now_s < fault.at_s + fault.seconds:
        script = mission.lines[_number(fault)].faults.script
        script.clear()
        for _ in range(_ANSWERS_PER_S):
            hit = rng.random() < share
            script.append(_LINE_FAULTS[rng.integers(len(_LINE_FAULTS))] if hit else LineFault.NONE)
        await asyncio.sleep(min(1.0, max(0.01, fault.at_s + fault.seconds - mission.now_s)))
    mission.lines[_number(fault)].faults.script.clear()


async def _stall(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    which = "mute" if rng.random() < 0.5 else "deaf"
    setattr(mission.lines[_number(fault)].faults, which, True)
    await asyncio.sleep(fault.seconds)
    # The computer, and with it this end of the cable, may be another one by now.
    setattr(mission.lines[_number(fault)].faults, which, False)


async def _power(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    instrument = mission.instruments[_number(fault)]
    instrument.switch_off()
    await asyncio.sleep(fault.seconds)
    instrument.switch_on()
    await asyncio.sleep(rng.uniform(*AFTER_BOOT_S))
    _lock_by_hand(mission, _number(fault))


async def _prism_loss(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    del rng
    instrument = mission.instruments[_number(fault)]
    instrument.blocked = True
    await asyncio.sleep(fault.seconds)
    instrument.blocked = False


async def _wrong_prism(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    number = _number(fault)
    others = [prism for prism in mission.prisms.values() if prism != mission.prisms[number]]
    if not others or not mission.instruments[number].on:
        return
    mission.instruments[number].lock_by_hand(int(rng.choice(others)))
    await asyncio.sleep(fault.seconds)
    _lock_by_hand(mission, number)


# --- The computers --------------------------------------------------------------------------------------------


async def _drift(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    """Let a crystal run faster and faster, or slower, for a time."""
    clock = mission.computers[_name(fault)].clock
    ppm_per_s = rng.uniform(-1, 1) * _RAMP_PPM_PER_S[mission.superframe]
    if not isinstance(clock, DriftingClock) or fault.station in mission.warming:
        return
    mission.warming.add(_number(fault))
    for _ in range(round(fault.seconds)):
        clock.warm(ppm_per_s)
        await asyncio.sleep(1.0)
    mission.warming.discard(_number(fault))


async def _clock_step(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    mission.computers[_name(fault)].clock.step(_step_ns(rng, _STEP_S))


async def _master_clock_step(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    del fault
    mission.clock.step(_step_ns(rng, _MASTER_STEP_S))


def _step_ns(rng: np.random.Generator, span_s: tuple[float, float]) -> int:
    """Draw a step: of seconds and more as often as of milliseconds."""
    return round(rng.uniform(*span_s) * 1e9 * 10 ** rng.uniform(-6, 0))


async def _reboot(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    del rng
    await mission.reboot(_number(fault), fault.at_s, fault.seconds)


async def _crash(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    """Kill a daemon right after something has happened: a packet on the air, or nothing in particular."""
    if rng.random() < 0.7:
        airtime_ns = mission.air.airtime_ns
        for _ in range(2000):
            if mission.air.airtime_ns != airtime_ns:
                break
            await asyncio.sleep(0.001)
        await asyncio.sleep(rng.choice([0.0, 0.05, 0.09]))
    for _ in range(int(rng.integers(_TURNS))):
        await asyncio.sleep(0)
    await mission.crash(_name(fault), away_s=fault.seconds)


async def _torn_write(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    torn = asyncio.Event()
    loop = asyncio.get_running_loop()
    if (writes := mission.computers[_name(fault)].writes) is None:
        return
    writes.tear(rng.random(), partial(loop.call_soon_threadsafe, torn.set))
    with suppress(TimeoutError):
        async with asyncio.timeout(10):
            await torn.wait()
    await mission.crash(_name(fault), away_s=fault.seconds)


async def _disk(error: int, mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    del rng
    disk = mission.computers[_name(fault)].disk
    disk.refuse(error, round(fault.at_s * 1e9), round((fault.at_s + fault.seconds) * 1e9))
    await asyncio.sleep(fault.seconds)
    disk.refuses = None


# --- Readers of the stream ------------------------------------------------------------------------------------


async def _slow_reader(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    """Connect and do not read; then read it all."""
    with suppress(OSError):  # the master is away
        reader, writer = await asyncio.open_unix_connection(mission.stream_socket())
        await asyncio.sleep(fault.seconds)
        with suppress(TimeoutError):
            async with asyncio.timeout(1.0):
                while rng.random() < 0.999 and await reader.read(65_536):
                    pass
        writer.close()


async def _vanishing_reader(mission: Mission, fault: Fault, rng: np.random.Generator) -> None:
    """Connect, send something that nobody asked for, and go away as a killed program does."""
    with suppress(OSError):
        _, writer = await asyncio.open_unix_connection(mission.stream_socket())
        writer.write(rng.bytes(int(rng.integers(200))))
        await asyncio.sleep(fault.seconds)
        writer.transport.abort()


_ACTS: Final[Mapping[FaultKind, Callable[[Mission, Fault, np.random.Generator], Awaitable[None]]]] = {
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
    FaultKind.DISK_FULL: partial(_disk, FULL),
    FaultKind.DISK_READ_ONLY: partial(_disk, READ_ONLY),
    FaultKind.SLOW_READER: _slow_reader,
    FaultKind.VANISHING_READER: _vanishing_reader,
}
