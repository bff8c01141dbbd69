"""What may be set of a simulated run besides its scenario, and how people write it."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from tsgt.config import SuperframeMasterConfig
from tsgt.errors import ConfigError
from tsgt.simulation.faults.catalogue import FaultKind  # noqa: TC001
from tsgt.simulation.mission.computer import MASTER

if TYPE_CHECKING:
    from tsgt.config import ClassicMasterConfig

Node = Literal["ours", "authors"]


@dataclass(frozen=True, slots=True)
class Outage:
    """A time in which the master on the robot and some stations do not hear each other: the robot is behind a hill.

    Attributes
    ----------
    stations
        Their numbers.
    start_s, seconds
        From when, and for how long.
    """

    stations: tuple[int, ...]
    start_s: float
    seconds: float

    @property
    def end_s(self) -> float:
        """When it is over."""
        return self.start_s + self.seconds

    def covers(self, time_s: float) -> bool:
        """Whether it lasts at that time."""
        return self.start_s <= time_s < self.end_s

    @classmethod
    def parse(cls, text: str, stations: tuple[int, ...]) -> Outage:
        """Read ``STATIONS:START:SECONDS``; stations are ``all``, or numbers with commas between them.

        Parameters
        ----------
        text
            As written.
        stations
            All that there are.

        Raises
        ------
        ConfigError
            It says something else, or names a station that there is not.
        """
        match = re.fullmatch(r"(all|\d+(?:,\d+)*):(\d+(?:\.\d+)?):(\d+(?:\.\d+)?)", text)
        if match is None:
            raise ConfigError(
                f"outage {text!r}: expected STATIONS:START:SECONDS, such as 2:120:60 or all:120:60"
            )
        numbers = stations if match[1] == "all" else tuple(map(int, match[1].split(",")))
        for number in numbers:
            _check_station(number, stations, f"outage {text!r}")
        return cls(numbers, float(match[2]), float(match[3]))


@dataclass(frozen=True, slots=True)
class Restart:
    """A daemon that ends in the middle of its work, and is started again.

    Attributes
    ----------
    station
        Number of the station; None: the master.
    at_s
        When it ends.
    """

    station: int | None
    at_s: float

    @classmethod
    def parse(cls, text: str, stations: tuple[int, ...]) -> Restart:
        """Read ``STATION:AT``; the station is a number, or ``master``. See :meth:`Outage.parse`."""
        match = re.fullmatch(r"(master|\d+):(\d+(?:\.\d+)?)", text)
        if match is None:
            raise ConfigError(f"restart {text!r}: expected STATION:AT, such as 2:120 or master:120")
        if match[1] == MASTER:
            return cls(None, float(match[2]))
        _check_station(int(match[1]), stations, f"restart {text!r}")
        return cls(int(match[1]), float(match[2]))


def _check_station(number: int, stations: tuple[int, ...], where: str) -> None:
    if number not in stations:
        raise ConfigError(f"{where}: there is no station {number}; there are {', '.join(map(str, stations))}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """What may be set of a run besides its scenario.

    Attributes
    ----------
    duration_s
        How long it measures.
    drift_ppm
        Of the stations' clocks against the master's: plus this for the first, minus this for the second, and so on.
    drift_ramp_ppm_per_min
        By how much that drift grows, and falls again, see :func:`~tsgt.simulation.kernel.clocks.ramped`; signs in turn as well.
    stamp_jitter_us
        One sigma of what every computer's stamp of an interrupt of its radio is off by, in us, besides the chip's own
        3 us.
    seed
        Of everything that is drawn.
    node
        What the stations run: our client, or the authors' node.
    protocol
        What the master speaks, and our clients with it.
    authenticated
        Whether all radios share a key; of the protocol ``superframe``.
    outages, restarts
        What goes wrong.
    foreign_per_s
        How many packets a second somebody else sends on the same channel, on average.
    faults
        Kinds of faults that are drawn from the seed.
    """

    duration_s: float
    drift_ppm: float = 10.0
    drift_ramp_ppm_per_min: float = 0.0
    stamp_jitter_us: float = 0.0
    seed: int = 0
    node: Node = "ours"
    protocol: ClassicMasterConfig | SuperframeMasterConfig = field(
        default_factory=lambda: SuperframeMasterConfig(kind="superframe")
    )
    authenticated: bool = True
    outages: tuple[Outage, ...] = ()
    restarts: tuple[Restart, ...] = ()
    interference_rate_hz: float = 0.0
    faults: frozenset[FaultKind] = frozenset()
