"""What the client asks of a total station, and the records that pass between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from tsgt.model import check_finite, check_instants

if TYPE_CHECKING:
    from tsgt.model import Status
    from tsgt.radio import Direction
    from tsgt.recording.journal import InstrumentRecord


@dataclass(frozen=True, slots=True, kw_only=True)
class Atmosphere:
    """The air between instrument and prism.

    Attributes
    ----------
    temperature_c
        In degrees Celsius, in the shade.
    pressure_hpa
        In hPa as a barometer beside the instrument shows it: not reduced to sea level.
    """

    temperature_c: float
    pressure_hpa: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """How an instrument does, for people.

    Attributes
    ----------
    activity
        What it is doing: ``tracking``, ``looking for the prism around its last direction``, ...
    problem
        What a person should see to: not level, battery low, licence missing, point the telescope at the prism; empty
        when there is nothing.
    battery_percent
        Charge of its battery; None where it does not say.
    """

    activity: str = ""
    problem: str = ""
    battery_percent: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """One measurement as the instrument gave it.

    Attributes
    ----------
    at_ns
        When it was taken, as well as the host can tell, on CLOCK_MONOTONIC of the station's computer.
    prism
        Number of the prism that was tracked; None for a single measurement of a target.
    horizontal_angle_rad, zenith_angle_rad
        As in :class:`~tsgt.model.PolarMeasurement`; 0 where the instrument gave none.
    slope_distance_m
        As in :class:`~tsgt.model.PolarMeasurement`; None where the instrument gave none.
    status, raw_status
        The verdict, in the common vocabulary and as the instrument's own number.
    instrument_time_ns
        The instrument's own stamp, None where it has none.
    received_ns
        When its first byte reached the host, on the same clock as ``at_ns``; None where no line tells.
    sigma_ns
        One standard error of ``at_ns``, as far as the instrument's times tell; 0 where nothing does.
    """

    at_ns: int
    prism: int | None
    horizontal_angle_rad: float
    zenith_angle_rad: float
    slope_distance_m: float | None
    status: Status
    raw_status: int = 0
    instrument_time_ns: int | None = None
    received_ns: int | None = None
    sigma_ns: int = 0

    def __post_init__(self) -> None:
        """Refuse what no instrument can have measured."""
        check_instants(self.at_ns, self.received_ns or 0)
        check_finite(self.horizontal_angle_rad, self.zenith_angle_rad, self.slope_distance_m or 0.0)


class Instrument(Protocol):
    """A robotic total station. One owner, one call at a time; :meth:`read` alone may be cancelled at any time.

    Every method raises :class:`~tsgt.errors.InstrumentError` when the instrument is gone or does not answer. After that
    :meth:`connect` is tried again, as often as need be. :class:`~tsgt.errors.InstrumentRefusedError` says instead that
    it answers and will not do this; it goes on with what it did before.
    """

    async def connect(self) -> str:
        """Find and identify the instrument; return its name and number for people. Nothing is tracked yet."""
        ...

    async def track(self, prism: int, towards: Direction | None = None) -> None:
        """Track a prism and measure it continuously, as fast as the instrument can.

        It returns as soon as the instrument is set up; that the prism is not found yet is what readings say.

        Parameters
        ----------
        prism
            Its number.
        towards
            Where it is believed to be; None: where the telescope points, or where it was last.
        """
        ...

    async def read(self) -> Reading:
        """Return the next measurement while tracking. None is given twice; one without a target has its status."""
        ...

    async def direct(self) -> None:
        """Stop tracking and get ready for single measurements of targets that a person aims at."""
        ...

    async def measure(self) -> Reading:
        """Measure the target that the instrument points at, once; only after :meth:`direct`."""
        ...

    async def check(self) -> None:
        """See whether the instrument is still there; called every few seconds after :meth:`direct`."""
        ...

    async def set_atmosphere(self, atmosphere: Atmosphere) -> None:
        """Let the instrument correct distances for this air from now on; also while tracking, between two readings."""
        ...

    @property
    def condition(self) -> Condition:
        """How it does at the moment."""
        ...

    @property
    def record(self) -> InstrumentRecord | None:
        """What is known of it and of its settings, for the journal; None before :meth:`connect`. Changes with them."""
        ...

    async def close(self) -> None:
        """Let go of the instrument; it may be connected again. It stays on, and keeps its lock."""
        ...
