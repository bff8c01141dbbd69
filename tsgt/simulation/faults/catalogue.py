"""Kinds of faults and their rates; draws which faults occur in a mission, when, where and for how long.

Rates are per hour and target. Each seed scales the rates randomly and omits some kinds: a fault that is only visible
without another one is found this way.
"""

from __future__ import annotations

import math
from enum import StrEnum
from typing import TYPE_CHECKING, Final, NamedTuple

from tsgt.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import numpy as np

FAULT_FREE_TAIL_S = 40.0
"""No fault in this time before the end: everything must work again by then."""

RELOCK_DELAY_S = (5.5, 8.0)
"""From power-on of an instrument, which boots for five seconds, to the operator's relock; minimum and maximum."""

FAULT_FREE_START_S = 5.0
"""No fault in this time after the start."""


FAST_SYNC_CYCLES = 8
"""Cycles of the first synchronisation of ``classic``, short because the master is killed every few minutes."""


class FaultKind(StrEnum):
    """A kind of fault."""

    LOSS = "loss"
    """Packets between the master and a station are lost with a random probability."""
    JAMMING = "jamming"
    """A much stronger radio transmits long packets continuously."""
    COLLISIONS = "collisions"
    """Another LoRa network uses the same channel, settings and sync word."""
    FORGERY = "forgery"
    """A replay attacker transmits captured packets, whole, truncated or altered."""
    CHIP_RESET = "chip-reset"
    """A supply dip resets the radio's registers."""
    CHIP_HANG = "chip-hang"
    """The radio accepts no commands."""
    BUS = "bus"
    """The SPI bus is dead: all registers read as zeros or ones."""
    INTERRUPTS = "interrupts"
    """Interrupts of the radio are lost."""
    UNPLUG = "unplug"
    """The instrument's cable is unplugged."""
    LINE = "line"
    """Responses of the instrument are truncated, corrupted, split, delayed, duplicated or lost."""
    STALL = "stall"
    """All responses of the instrument, or all requests, are lost."""
    POWER = "power"
    """The instrument is switched off and on, and relocked by an operator."""
    PRISM_LOSS = "prism-loss"
    """The line of sight to the prism is blocked."""
    WRONG_PRISM = "wrong-prism"
    """The instrument tracks another station's prism."""
    DRIFT = "drift"
    """The drift of a station's clock changes."""
    CLOCK_STEP = "clock-step"
    """A station's Unix clock is stepped."""
    REBOOT = "reboot"
    """A station's computer is powered off and on: CLOCK_MONOTONIC restarts at zero, the Unix clock where it stopped."""
    MASTER_CLOCK_STEP = "master-clock-step"
    """The master's Unix clock is stepped."""
    CLIENT_CRASH = "client-crash"
    """A client is killed and restarted."""
    MASTER_CRASH = "master-crash"
    """The master is killed and restarted."""
    TORN_WRITE = "torn-write"
    """A daemon is killed during a write, and restarted."""
    DISK_FULL = "disk-full"
    """A disk is full."""
    DISK_READ_ONLY = "disk-read-only"
    """A disk is read-only after an error."""
    SLOW_READER = "slow-reader"
    """A stream subscriber stops reading."""
    VANISHING_READER = "vanishing-reader"
    """A stream subscriber aborts its connection."""
    IMU_DROPOUT = "imu-dropout"
    """Samples of the IMU are lost at random, up to half of them."""
    IMU_SILENCE = "imu-silence"
    """The IMU delivers nothing."""
    IMU_STUCK = "imu-stuck"
    """The IMU repeats its last values; its counter and clock run on."""
    IMU_CLOCK_JUMP = "imu-clock-jump"
    """The clock of the IMU jumps, by milliseconds to minutes."""
    IMU_LATE_BURST = "imu-late-burst"
    """Samples of the IMU are held back and arrive in one burst."""
    IMU_SATURATION = "imu-saturation"
    """The motion exceeds the measuring ranges of the IMU."""
    IMU_KNOCK = "imu-knock"
    """The IMU is turned by 1 degree and moved by 20 mm on the robot, and stays so."""

    ODOMETRY_SILENCE = "odometry-silence"
    """The wheel odometry delivers nothing."""
    ODOMETRY_STUCK = "odometry-stuck"
    """The wheel odometry repeats its last values; its counter and clock run on."""
    ODOMETRY_SLIP = "odometry-slip"
    """The wheels spin, slide or are locked: the measured speed is 0 to 2.5 times the true one."""

    SLOW_DISK = "slow-disk"
    """Writes and syncs take 0.2 to 6 s again and again, as on an SD card that tidies up."""
    SUSPEND = "suspend"
    """A station's computer is suspended and resumed: its clocks and programs stand still, the Unix clock runs on."""
    NTP_BOOT_STEP = "ntp-boot-step"
    """A station's computer reboots, and NTP sets its Unix clock, which stood still for the time without power, some seconds later."""
    NTP_SLEW = "ntp-slew"
    """NTP slews a station's clock by 500 ppm, CLOCK_MONOTONIC as well."""
    WRONG_KEY = "wrong-key"
    """A client is started with another key, until the operator has found it."""
    OTHER_SPREADING_FACTOR = "other-spreading-factor"
    """A client's radio is configured with another spreading factor, until the operator has found it."""
    OTHER_PROTOCOL = "other-protocol"
    """A client is configured for the other protocol than the mission's, until the operator has found it."""
    UNKNOWN_STATION = "unknown-station"
    """A client is configured as a station that the master does not know, until the operator has found it."""
    SAME_STATION = "same-station"
    """A client is configured as a station that another client already is, until the operator has found it."""
    PRISM_CONSTANT = "prism-constant"
    """An instrument adds 34.4 mm, the constant of its prism, and the master, too, until the operator has found it."""
    SECOND_MASTER = "second-master"
    """Another master with the same key and stations is switched on beside the robot's."""
    SHIMMER = "shimmer"
    """The air over heated ground shimmers: angles and distances fluctuate, more at a longer range and at noon."""
    RAIN = "rain"
    """Weak returns: distances fail or are noisy, and locks are lost."""
    SECOND_ROBOT = "second-robot"
    """Another robot's prisms come into the field of view, and an instrument may follow one of them."""
    WINDOW = "window"
    """A reflecting surface: an instrument follows the image of its prism, or distances are too long by centimetres to metres."""
    BATTERY_FADING = "battery-fading"
    """An instrument's battery runs down: it measures and responds more slowly, dies, and gets another one from an operator."""
    TRIPOD_SINK = "tripod-sink"
    """A tripod sinks, by 5 mm in an hour up to 5 mm in a minute."""
    TRIPOD_KICK = "tripod-kick"
    """A tripod is displaced by 1 to 50 mm and turned by 0.1 to 5 mrad at once, level or not."""
    TRIPOD_SUN = "tripod-sun"
    """The sun on one leg turns a tripod about the vertical by 10 to 100 microradians per minute."""
    STATION_MOVED = "station-moved"
    """A station is set up elsewhere with another horizontal zero, and calibrated some time later or never."""
    ROBOT_ROLLOVER = "robot-rollover"
    """The robot rolls over by 90 to 180 degrees, lies with its prisms hidden, and is put on its wheels again."""
    CONFIG_EDIT = "config-edit"
    """A daemon's configuration is edited and the daemon restarted; later it is taken back, likewise."""
    MASTER_SUSPEND = "master-suspend"
    """The master's computer is suspended and resumed."""
    LONG_DISK_FULL = "long-disk-full"
    """A disk is full for an hour."""


# Further kinds come last: the draws of the others stay the same. Kinds from SLOW_DISK on have a generator each.


SETUP_MISTAKES: Final = (
    FaultKind.WRONG_KEY,
    FaultKind.OTHER_SPREADING_FACTOR,
    FaultKind.OTHER_PROTOCOL,
    FaultKind.UNKNOWN_STATION,
    FaultKind.SAME_STATION,
    FaultKind.PRISM_CONSTANT,
)
"""What an operator sets up wrongly at a station."""


class _FaultRate(NamedTuple):
    """Rate per hour and target, targets, and minimum and maximum duration in s of a kind of fault."""

    per_hour: float
    targets: str
    duration_s: tuple[float, float]


_M, _S, _B, _I, _O = "master", "stations", "both", "imu", "odometry"
_RATES: Final = {
    FaultKind.LOSS: _FaultRate(40, _S, (0.5, 20)),
    FaultKind.JAMMING: _FaultRate(10, _M, (0.2, 8)),
    FaultKind.COLLISIONS: _FaultRate(20, _M, (2, 40)),
    FaultKind.FORGERY: _FaultRate(20, _M, (2, 40)),
    FaultKind.CHIP_RESET: _FaultRate(15, _B, (0, 0)),
    FaultKind.CHIP_HANG: _FaultRate(10, _B, (0, 0)),
    FaultKind.BUS: _FaultRate(6, _B, (0.05, 8)),
    FaultKind.INTERRUPTS: _FaultRate(40, _B, (0, 0)),
    FaultKind.UNPLUG: _FaultRate(10, _S, (0.05, 15)),
    FaultKind.LINE: _FaultRate(20, _S, (1, 20)),
    FaultKind.STALL: _FaultRate(10, _S, (0.2, 15)),
    FaultKind.POWER: _FaultRate(4, _S, (0.5, 20)),
    FaultKind.PRISM_LOSS: _FaultRate(20, _S, (0.2, 15)),
    FaultKind.WRONG_PRISM: _FaultRate(6, _S, (2, 20)),
    FaultKind.DRIFT: _FaultRate(10, _S, (5, 120)),
    FaultKind.CLOCK_STEP: _FaultRate(10, _S, (0, 0)),
    FaultKind.REBOOT: _FaultRate(4, _S, (1, 20)),
    FaultKind.MASTER_CLOCK_STEP: _FaultRate(10, _M, (0, 0)),
    FaultKind.CLIENT_CRASH: _FaultRate(15, _S, (0.5, 10)),
    FaultKind.MASTER_CRASH: _FaultRate(15, _M, (0.5, 10)),
    FaultKind.TORN_WRITE: _FaultRate(8, _B, (0.5, 5)),
    FaultKind.DISK_FULL: _FaultRate(8, _B, (0.5, 30)),
    FaultKind.DISK_READ_ONLY: _FaultRate(4, _B, (0.5, 30)),
    FaultKind.SLOW_READER: _FaultRate(20, _M, (1, 60)),
    FaultKind.VANISHING_READER: _FaultRate(20, _M, (0, 5)),
    FaultKind.IMU_DROPOUT: _FaultRate(15, _I, (0.5, 30)),
    FaultKind.IMU_SILENCE: _FaultRate(15, _I, (0.05, 30)),
    FaultKind.IMU_STUCK: _FaultRate(8, _I, (0.05, 20)),
    FaultKind.IMU_CLOCK_JUMP: _FaultRate(8, _I, (0, 0)),
    FaultKind.IMU_LATE_BURST: _FaultRate(15, _I, (0.05, 3)),
    FaultKind.IMU_SATURATION: _FaultRate(8, _I, (0.5, 20)),
    FaultKind.IMU_KNOCK: _FaultRate(2, _I, (0, 0)),
    FaultKind.ODOMETRY_SILENCE: _FaultRate(10, _O, (0.1, 30)),
    FaultKind.ODOMETRY_STUCK: _FaultRate(10, _O, (0.1, 30)),
    FaultKind.ODOMETRY_SLIP: _FaultRate(20, _O, (0.3, 20)),
    FaultKind.SLOW_DISK: _FaultRate(8, _B, (2, 40)),
    FaultKind.SUSPEND: _FaultRate(4, _S, (0.05, 30)),
    FaultKind.NTP_BOOT_STEP: _FaultRate(2, _S, (1, 20)),
    FaultKind.NTP_SLEW: _FaultRate(4, _S, (2, 40)),
    **dict.fromkeys(SETUP_MISTAKES, _FaultRate(2, _S, (20, 120))),
    FaultKind.SECOND_MASTER: _FaultRate(4, _M, (5, 60)),
    FaultKind.SHIMMER: _FaultRate(8, _M, (10, 100)),
    FaultKind.RAIN: _FaultRate(8, _M, (10, 100)),
    FaultKind.SECOND_ROBOT: _FaultRate(4, _S, (3, 40)),
    FaultKind.WINDOW: _FaultRate(8, _S, (0.5, 20)),
    FaultKind.BATTERY_FADING: _FaultRate(2, _S, (30, 150)),
    FaultKind.TRIPOD_SINK: _FaultRate(4, _S, (30, 300)),
    FaultKind.TRIPOD_KICK: _FaultRate(2, _S, (5, 40)),
    FaultKind.TRIPOD_SUN: _FaultRate(4, _S, (30, 300)),
    FaultKind.STATION_MOVED: _FaultRate(2, _S, (20, 90)),
    FaultKind.ROBOT_ROLLOVER: _FaultRate(4, _M, (5, 40)),
    FaultKind.CONFIG_EDIT: _FaultRate(2, _B, (20, 120)),
    FaultKind.MASTER_SUSPEND: _FaultRate(6, _M, (0.05, 60)),
    FaultKind.LONG_DISK_FULL: _FaultRate(0.3, _B, (3600, 3600)),
}

_SWITCHED_ON: Final = frozenset({FaultKind.POWER, FaultKind.BATTERY_FADING})
RATE_FACTOR = 3.0
_OMIT_PROBABILITY = 0.3
_RATE_SPREAD = 8.0


class Fault(NamedTuple):
    """A fault."""

    at_s: float  # start in s from the start of the mission
    kind: FaultKind
    station: int | None  # None: the master, its IMU or wheel odometry, or the channel
    duration_s: float  # 0: instantaneous
    seed: int  # seed of further draws


IMU_FAULTS: Final = frozenset(kind for kind, rate in _RATES.items() if rate.targets == _I)
"""Kinds of faults that only a robot with an IMU has."""

ODOMETRY_FAULTS: Final = frozenset(kind for kind, rate in _RATES.items() if rate.targets == _O)
"""Kinds of faults that only a robot with wheel odometry has."""


FIELD_DAY_FAULTS: Final = frozenset(
    {
        FaultKind.NTP_SLEW,
        *SETUP_MISTAKES,
        FaultKind.SECOND_MASTER,
        FaultKind.SECOND_ROBOT,
        FaultKind.WINDOW,
        FaultKind.TRIPOD_SINK,
        FaultKind.TRIPOD_KICK,
        FaultKind.TRIPOD_SUN,
        FaultKind.STATION_MOVED,
        FaultKind.ROBOT_ROLLOVER,
        FaultKind.MASTER_SUSPEND,
        FaultKind.LONG_DISK_FULL,
    }
)
"""Kinds that are injected by name only: what they violate is bounded, or they need a mission of their own."""


def parse_faults(text: str) -> frozenset[FaultKind]:
    """Parse kinds of faults: ``none``, ``all`` (without :data:`FIELD_DAY_FAULTS`), or comma-separated names.

    Raises
    ------
    ConfigError
        Unknown name.
    """
    if text in {"none", "all"}:
        return frozenset(FaultKind) - FIELD_DAY_FAULTS if text == "all" else frozenset()
    names = text.split(",")
    for name in names:
        if name not in set(FaultKind):
            raise ConfigError(f"--faults {name}: there is no such fault; there are {', '.join(FaultKind)}")
    return frozenset(map(FaultKind, names))


def log_uniform(rng: np.random.Generator, span: tuple[float, float]) -> float:
    """Draw between two positive values, uniformly in the logarithm."""
    low, high = span
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def draw_faults(
    kinds: Iterable[FaultKind],
    rng: np.random.Generator,
    *,
    duration_s: float,
    stations: Sequence[int],
    imu: bool = False,
    odometry: bool = False,
) -> tuple[Fault, ...]:
    """Draw the faults of a mission, sorted by start; without an IMU none of :data:`IMU_FAULTS`, and likewise without wheel odometry.

    The rate of each kind is scaled by a random factor between 1/8 and 8. With more than one kind, each is omitted with a
    probability of 0.3. All faults end :data:`FAULT_FREE_TAIL_S` before ``duration_s``.
    """
    impossible = (frozenset() if imu else IMU_FAULTS) | (frozenset() if odometry else ODOMETRY_FAULTS)
    ordered = sorted(set(kinds) - impossible, key=list(FaultKind).index)
    end_s = duration_s - FAULT_FREE_TAIL_S
    faults = []
    own = list(FaultKind)[list(FaultKind).index(FaultKind.SLOW_DISK) :]
    generators = dict(zip(own, rng.spawn(len(own)), strict=True))
    common = rng
    for kind in ordered:
        rng = generators.get(kind, common)
        factor, omitted = _RATE_SPREAD ** rng.uniform(-1, 1), rng.random() < _OMIT_PROBABILITY
        rate = _RATES[kind]
        for station in [
            *([None] if rate.targets in (_M, _B, _I, _O) else []),
            *(stations if rate.targets in (_S, _B) else []),
        ]:
            count = rng.poisson(
                max(0.0, RATE_FACTOR * rate.per_hour * factor * (end_s - FAULT_FREE_START_S) / 3600)
            )
            if omitted and len(ordered) > 1:
                continue
            for _ in range(count):
                until_s = end_s - RELOCK_DELAY_S[1] if kind in _SWITCHED_ON else end_s
                at_s = rng.uniform(FAULT_FREE_START_S, max(FAULT_FREE_START_S, until_s))
                shortest, longest = rate.duration_s
                # Log-uniform durations.
                duration_s = shortest and log_uniform(rng, rate.duration_s)
                duration_s = duration_s or (rng.uniform(0, longest) if longest else 0.0)
                faults.append(
                    Fault(
                        float(at_s),
                        kind,
                        station,
                        float(max(0.0, min(duration_s, until_s - at_s))),
                        int(rng.integers(2**63)),
                    )
                )
    return tuple(sorted(faults))
