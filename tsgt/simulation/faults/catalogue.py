"""What goes wrong in a simulated mission, drawn from its seed: which faults, when, of whom, for how long.

How often each kind comes is a rate per hour of each target. A swarm of seeds varies the rates widely, and leaves some
kinds out of each run: a fault that only shows without another one is found that way.
"""

from __future__ import annotations

import math
from enum import StrEnum
from typing import TYPE_CHECKING, Final, NamedTuple

from tsgt.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import numpy as np

CALM_S = 40.0
"""Before the end of a run all faults are over for so long: what they broke has to work again by then."""

AFTER_BOOT_S = (5.5, 8.0)
"""When a person locks an instrument that was switched on: it takes five seconds to start."""

SETTLE_S = 5.0
"""Before any fault."""


QUICK_CYCLES = 8
"""Of the first synchronisation of classic: a master that is killed every other minute must not take longer."""


class FaultKind(StrEnum):
    """A kind of fault."""

    LOSS = "loss"
    """Packets between the master and a station are lost, each with a probability."""
    JAMMING = "jamming"
    """Somebody sends long packets, much stronger than everybody else, without a pause."""
    COLLISIONS = "collisions"
    """Another LoRa network on the same channel, with the same settings and the same sync word."""
    FORGERY = "forgery"
    """Somebody plays back what he has heard, whole, cut short or changed."""
    CHIP_RESET = "chip-reset"
    """The radio's supply dips: its registers are as after a reset."""
    CHIP_HANG = "chip-hang"
    """The radio takes no commands any more."""
    BUS = "bus"
    """The SPI bus is dead: every register reads as all zeros or all ones."""
    INTERRUPTS = "interrupts"
    """Interrupts of the radio do not reach the host."""
    UNPLUG = "unplug"
    """Somebody stumbles over the instrument's cable."""
    LINE = "line"
    """Answers of the instrument are cut, spoilt, torn, late, doubled, or missing."""
    STALL = "stall"
    """The instrument is silent, or deaf."""
    POWER = "power"
    """The instrument is switched off and on; a person locks it on its prism again."""
    PRISM_LOSS = "prism-loss"
    """Something stands between the instrument and its prism."""
    WRONG_PRISM = "wrong-prism"
    """The instrument follows another station's prism."""
    DRIFT = "drift"
    """A station's crystal runs fast or slow, and changes as it gets warm."""
    CLOCK_STEP = "clock-step"
    """Somebody sets a station's Unix clock."""
    REBOOT = "reboot"
    """A station's computer is switched off and on: CLOCK_MONOTONIC begins at zero, the Unix clock where it was."""
    MASTER_CLOCK_STEP = "master-clock-step"
    """Somebody sets the master's Unix clock."""
    CLIENT_CRASH = "client-crash"
    """A client is killed, and started again."""
    MASTER_CRASH = "master-crash"
    """The master is killed, and started again."""
    TORN_WRITE = "torn-write"
    """A daemon is killed in the middle of a line that it writes to its disk, and started again."""
    DISK_FULL = "disk-full"
    """There is no room on a disk."""
    DISK_READ_ONLY = "disk-read-only"
    """A disk has turned read-only after an error."""
    SLOW_READER = "slow-reader"
    """A reader of the stream stops reading."""
    VANISHING_READER = "vanishing-reader"
    """A reader of the stream goes away without a word, in the middle of a line."""


class _Habit(NamedTuple):
    """How a kind of fault comes: per hour and target; of whom; how long, from and to, in s."""

    per_hour: float
    of: str
    seconds: tuple[float, float]


_M, _S, _B = "master", "stations", "both"
_HABITS: Final = {
    FaultKind.LOSS: _Habit(40, _S, (0.5, 20)),
    FaultKind.JAMMING: _Habit(10, _M, (0.2, 8)),
    FaultKind.COLLISIONS: _Habit(20, _M, (2, 40)),
    FaultKind.FORGERY: _Habit(20, _M, (2, 40)),
    FaultKind.CHIP_RESET: _Habit(15, _B, (0, 0)),
    FaultKind.CHIP_HANG: _Habit(10, _B, (0, 0)),
    FaultKind.BUS: _Habit(6, _B, (0.05, 8)),
    FaultKind.INTERRUPTS: _Habit(40, _B, (0, 0)),
    FaultKind.UNPLUG: _Habit(10, _S, (0.05, 15)),
    FaultKind.LINE: _Habit(20, _S, (1, 20)),
    FaultKind.STALL: _Habit(10, _S, (0.2, 15)),
    FaultKind.POWER: _Habit(4, _S, (0.5, 20)),
    FaultKind.PRISM_LOSS: _Habit(20, _S, (0.2, 15)),
    FaultKind.WRONG_PRISM: _Habit(6, _S, (2, 20)),
    FaultKind.DRIFT: _Habit(10, _S, (5, 120)),
    FaultKind.CLOCK_STEP: _Habit(10, _S, (0, 0)),
    FaultKind.REBOOT: _Habit(4, _S, (1, 20)),
    FaultKind.MASTER_CLOCK_STEP: _Habit(10, _M, (0, 0)),
    FaultKind.CLIENT_CRASH: _Habit(15, _S, (0.5, 10)),
    FaultKind.MASTER_CRASH: _Habit(15, _M, (0.5, 10)),
    FaultKind.TORN_WRITE: _Habit(8, _B, (0.5, 5)),
    FaultKind.DISK_FULL: _Habit(8, _B, (0.5, 30)),
    FaultKind.DISK_READ_ONLY: _Habit(4, _B, (0.5, 30)),
    FaultKind.SLOW_READER: _Habit(20, _M, (1, 60)),
    FaultKind.VANISHING_READER: _Habit(20, _M, (0, 5)),
}

OFTEN = 3.0
_LEFT_OUT = 0.3
_SPREAD = 8.0


class Fault(NamedTuple):
    """One fault.

    Attributes
    ----------
    at_s
        When it begins, from the start of the run, in s.
    kind
        Which.
    station
        Number of the station that it is of; None: the master, or the channel.
    seconds
        How long it lasts, in s; 0: an instant.
    seed
        Of whatever else is drawn.
    """

    at_s: float
    kind: FaultKind
    station: int | None
    seconds: float
    seed: int


def parse_faults(text: str) -> frozenset[FaultKind]:
    """Read which kinds of faults somebody wants: ``none``, ``all``, or names with commas between them.

    Raises
    ------
    ConfigError
        There is no fault of that name.
    """
    if text in {"none", "all"}:
        return frozenset(FaultKind if text == "all" else ())
    names = text.split(",")
    for name in names:
        if name not in set(FaultKind):
            raise ConfigError(f"--faults {name}: there is no such fault; there are {', '.join(FaultKind)}")
    return frozenset(map(FaultKind, names))


def draw_faults(
    kinds: Iterable[FaultKind], rng: np.random.Generator, *, duration_s: float, stations: Sequence[int]
) -> tuple[Fault, ...]:
    """Draw the faults of a run.

    Each kind's rate is the usual one times a factor between an eighth and eight, the same for the whole run. With more
    than one kind, three in ten of them are left out.

    Parameters
    ----------
    kinds
        Those that may come.
    rng
        Draws.
    duration_s
        Of the run; all are over :data:`CALM_S` before its end.
    stations
        Their numbers.

    Returns
    -------
    tuple[Fault, ...]
        In the order in which they begin.
    """
    ordered = sorted(set(kinds), key=list(FaultKind).index)
    end_s = duration_s - CALM_S
    faults = []
    for kind in ordered:
        factor, left_out = _SPREAD ** rng.uniform(-1, 1), rng.random() < _LEFT_OUT
        habit = _HABITS[kind]
        for station in [*([None] if habit.of in (_M, _B) else []), *(stations if habit.of != _M else [])]:
            count = rng.poisson(max(0.0, OFTEN * habit.per_hour * factor * (end_s - SETTLE_S) / 3600))
            if left_out and len(ordered) > 1:
                continue
            for _ in range(count):
                until_s = end_s - AFTER_BOOT_S[1] if kind == FaultKind.POWER else end_s
                at_s = rng.uniform(SETTLE_S, max(SETTLE_S, until_s))
                shortest, longest = habit.seconds
                # Short ones as often as long ones.
                seconds = shortest and math.exp(rng.uniform(math.log(shortest), math.log(longest)))
                seconds = seconds or (rng.uniform(0, longest) if longest else 0.0)
                faults.append(
                    Fault(
                        float(at_s),
                        kind,
                        station,
                        float(max(0.0, min(seconds, until_s - at_s))),
                        int(rng.integers(2**63)),
                    )
                )
    return tuple(sorted(faults))
