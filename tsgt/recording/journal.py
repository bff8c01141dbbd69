"""What a station's journal holds besides measurements, and reading it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

from tsgt.errors import CorruptLineError, RecordingError
from tsgt.model import PolarMeasurement, Status, check_finite, check_instants
from tsgt.recording.format import HEADER_START, MAX_LINE_BYTES, RecordingHeader, decode_line
from tsgt.recording.reader import read_lines

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@dataclass(frozen=True, slots=True, kw_only=True)
class JournalRecord:
    """The second line of a journal: whose it is.

    Attributes
    ----------
    type
        Always ``journal``.
    station
        Number of the station, from 1.
    unix_at_zero_ns
        What was added to CLOCK_MONOTONIC of the station's computer to get the times in this file, in ns; the same
        from the start of the client to its end.
    boot
        Which start of the computer its CLOCK_MONOTONIC counts from: the kernel's boot id; empty where unknown.
    lineage
        The same, 0 to 65535, in all journals whose sequence numbers go on from one to the next; null where each
        begins at 0, as over the protocol classic.
    run_start
        Sequence number of the first measurement.
    """

    type: Literal["journal"] = "journal"
    station: int
    unix_at_zero_ns: int
    boot: str = ""
    lineage: int | None = None
    run_start: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class InstrumentRecord:
    """What measured, and how it was set: written after each connection and each change, as read back from it.

    Attributes
    ----------
    type
        Always ``instrument``.
    stamp_ns
        From when on, on the station computer's clock, in ns.
    make
        Maker of the instrument.
    model
        Model, as the instrument says; empty where unknown.
    serial_number
        Its number; empty where unknown.
    firmware
        Version of its firmware; empty where unknown.
    prism_type
        Reflector that it is set to, in the words of the configuration; empty where unknown.
    prism_constant_m
        What the instrument itself adds to a distance for it, in m, in its maker's convention; null where unknown. The
        distances in this file have it, so the master must add only what is still missing.
    atmospheric_ppm
        Scale correction of the distance that the instrument itself applies, in 1e-6; null where unknown.
    temperature_c
        Of the air that this stands for, in degrees Celsius; null where unknown.
    pressure_hpa
        Of the same air, in hPa; null where unknown.
    distance_mode
        How it measures distances, in the words of the driver; empty where unknown.
    latency_ns
        What has been taken off the stamps for the time from the measurement to the fastest answer, in ns.
    angle_delay_ns
        By how much the angles are newer than the distance, in ns; positive: newer. Not corrected in this file.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    type: Literal["instrument"] = "instrument"
    stamp_ns: int = 0
    make: str
    model: str = ""
    serial_number: str = ""
    firmware: str = ""
    prism_type: str = ""
    prism_constant_m: float | None = None
    atmospheric_ppm: float | None = None
    temperature_c: float | None = None
    pressure_hpa: float | None = None
    distance_mode: str = ""
    latency_ns: int = 0
    angle_delay_ns: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceptionRecord:
    """When the station received one of the master's beacons, and when the master had sent it.

    Attributes
    ----------
    type
        Always ``reception``.
    stamp_ns
        The end of its reception (RxDone) in ns, on the station computer's clock.
    stamp_sigma_ns
        One sigma of that.
    session
        Number of the master's session, 48 bits.
    counter
        Number of the frame in it.
    sent_us
        When it had left (TxDone), in us from the start of the session by the master's clock.
    """

    type: Literal["reception"] = "reception"
    stamp_ns: int
    stamp_sigma_ns: int
    session: int
    counter: int
    sent_us: int


@dataclass(frozen=True, slots=True, kw_only=True)
class AcknowledgedRecord:
    """How far the master's recording has got; written now and then.

    Attributes
    ----------
    type
        Always ``acknowledged``.
    stamp_ns
        When, on the station computer's clock, in ns.
    oldest
        Every measurement with a lower sequence number has been acknowledged, or was given up.
    """

    type: Literal["acknowledged"] = "acknowledged"
    stamp_ns: int
    oldest: int


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetRecord:
    """A single measurement of a target that a person had aimed at.

    Attributes
    ----------
    type
        Always ``target``.
    station
        Number of the station that measured, from 1.
    stamp_ns
        The station computer's stamp in ns, on its own clock.
    horizontal_angle_rad
        Horizontal circle, clockwise from the circle's zero, in rad; 0 where the instrument gave none.
    zenith_angle_rad
        Angle from straight up in rad; 0 where the instrument gave none.
    slope_distance_m
        Slope distance in m as the instrument gave it; null where it gave none.
    status
        The instrument's verdict, as in ``measurement``.
    raw_status
        The number that the instrument itself gave for it.
    instrument_time_ns
        The instrument's own stamp in ns, on the instrument's clock; null where it has none.
    """

    __pydantic_config__: ClassVar[dict[str, bool]] = {"allow_inf_nan": False}

    type: Literal["target"] = "target"
    station: int
    stamp_ns: int
    horizontal_angle_rad: float
    zenith_angle_rad: float
    slope_distance_m: float | None
    status: Status
    raw_status: int
    instrument_time_ns: int | None

    def __post_init__(self) -> None:
        """Refuse what cannot be a measurement."""
        check_instants(self.stamp_ns)
        check_finite(self.horizontal_angle_rad, self.zenith_angle_rad, self.slope_distance_m or 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Journal:
    """What a station measured in one run of its client.

    Attributes
    ----------
    head
        Whose it is.
    created_ns
        When it was begun, on the station's own clock.
    measurements
        All of them, in the order in which they were read; times are on the station's own clock.
    targets
        Single measurements of targets, likewise.
    receptions
        Of the master's beacons, likewise.
    """

    head: JournalRecord
    created_ns: int
    measurements: list[PolarMeasurement]
    targets: list[TargetRecord]
    receptions: list[ReceptionRecord]

    @property
    def station(self) -> int:
        """Number of the station."""
        return self.head.station


def is_only_begun(path: Path) -> bool:
    """Tell whether a program has ended between making a journal and its first lines: it is empty, or ends in its head.

    Raises
    ------
    RecordingError
        The file cannot be read.
    """
    try:
        with path.open("rb") as file:
            first, second = (file.readline(MAX_LINE_BYTES) for _ in range(2))
    except OSError as error:
        raise RecordingError(f"cannot be read ({error.strerror})", path=path) from error
    return (HEADER_START.startswith(first) or first.startswith(HEADER_START)) and not second.endswith(b"\n")


def load_journal(
    path: Path,
    *,
    keep_going: bool = False,
    on_problem: Callable[[RecordingError], None] | None = None,
) -> Journal:
    """Read a journal.

    Parameters
    ----------
    path
        The journal; its last line may be torn.
    keep_going
        Skip lines that cannot be read instead of raising.
    on_problem
        Told of every line that is skipped: a torn last line always, others with ``keep_going``.

    Raises
    ------
    RecordingError
        The file cannot be read, or is no journal.
    CorruptLineError
        A line is not what a client can have written.
    """
    head: JournalRecord | None = None
    created_ns = 0
    measurements: list[PolarMeasurement] = []
    targets: list[TargetRecord] = []
    receptions: list[ReceptionRecord] = []
    for line in read_lines(path, keep_going=keep_going, on_problem=on_problem):
        try:
            match line.type:
                case "recording":
                    created_ns = created_ns or decode_line(RecordingHeader, line, path).created_ns
                case "journal":
                    record = decode_line(JournalRecord, line, path)
                    if head is not None and head != record:
                        raise CorruptLineError("begins a second journal", path=path, line=line.number)
                    head = record
                case "measurement":
                    measurements.append(decode_line(PolarMeasurement, line, path))
                case "target":
                    targets.append(decode_line(TargetRecord, line, path))
                case "reception":
                    receptions.append(decode_line(ReceptionRecord, line, path))
        except CorruptLineError as problem:
            if not keep_going or line.type == "journal":
                raise
            if on_problem is not None:
                on_problem(problem)
    if head is None:
        raise RecordingError("is no journal of a station; give a file that tsgt-client wrote", path=path)
    return Journal(
        head=head,
        created_ns=created_ns,
        measurements=measurements,
        targets=targets,
        receptions=receptions,
    )
