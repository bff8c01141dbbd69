"""The instrument protocol that every total station driver implements, and its data types."""

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
    """Air temperature (degrees Celsius, in the shade) and pressure (hPa at the instrument, not reduced to sea level)."""

    temperature_c: float
    pressure_hpa: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """An instrument's state, for the operator.

    Attributes
    ----------
    activity
        Current activity: ``tracking``, ``searching around its last direction``, ...
    problem
        Action required of the operator: level the instrument, change the battery, point the telescope; empty for none.
    battery_percent
        None where the instrument does not report it.
    """

    activity: str = ""
    problem: str = ""
    battery_percent: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """One measurement as the instrument reported it; angles and distance as in :class:`~tsgt.model.PolarMeasurement`.

    Attributes
    ----------
    at_ns
        Estimated time of the measurement, on CLOCK_MONOTONIC of the station's computer.
    prism
        None for a single measurement of a target.
    horizontal_angle_rad, zenith_angle_rad
        0 where the instrument reported none.
    slope_distance_m
        None where the instrument reported none.
    raw_status
        The instrument's own status code.
    instrument_time_ns
        Timestamp of the instrument's clock; None without one.
    received_ns
        Arrival of the first byte at the host, on the clock of ``at_ns``; None where unknown.
    sigma_ns
        Standard error of ``at_ns`` from the instrument clock's fit; 0 where there is no estimate.
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
        """Reject values that no instrument can have measured."""
        check_instants(self.at_ns, self.received_ns or 0)
        check_finite(self.horizontal_angle_rad, self.zenith_angle_rad, self.slope_distance_m or 0.0)


class Instrument(Protocol):
    """A robotic total station with one owner. Calls do not overlap; only :meth:`read` may be cancelled at any time.

    Every method raises :class:`~tsgt.errors.InstrumentError` when the instrument is lost or does not respond; the owner
    then calls :meth:`connect` again. :class:`~tsgt.errors.InstrumentRefusedError` means that the instrument responds but
    does not carry out the command; it continues what it did before.
    """

    async def connect(self) -> str:
        """Find and identify the instrument; return its name and serial number. It does not track yet."""

    async def track(self, prism: int, towards: Direction | None = None) -> None:
        """Track a prism and measure it continuously at the instrument's highest rate.

        Returns when the instrument is set up; readings report whether it has found the prism. ``towards``: expected
        direction of the prism; None: where the telescope points, or the prism's last direction.
        """

    async def read(self) -> Reading:
        """Return the next reading while tracking, each exactly once; one without a target has that status."""

    async def direct(self) -> None:
        """Enter direct mode: stop tracking and prepare for single measurements of targets that the operator aims at."""

    async def measure(self) -> Reading:
        """Measure the target in the line of sight once; only in direct mode."""

    async def check(self) -> None:
        """Check that the instrument still responds; called every few seconds in direct mode."""

    async def set_atmosphere(self, atmosphere: Atmosphere) -> None:
        """Set the atmospheric correction of distances, also while tracking, between two readings."""

    @property
    def condition(self) -> Condition:
        """Current state, for the operator."""

    @property
    def record(self) -> InstrumentRecord | None:
        """Identity and settings for the journal, updated when they change; None before :meth:`connect`."""

    async def close(self) -> None:
        """Disconnect; :meth:`connect` may follow. The instrument stays on and keeps its lock."""

    def host_clock_restarted(self) -> None:
        """Drop all times of the host's clock that outlive :meth:`close`: readings, a fit of the instrument's clock.

        Called while disconnected: the computer was suspended, so that they do not compare with later times.
        """
