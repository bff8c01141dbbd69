"""Records of a station's journal besides measurements, and reading a journal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from tsgt.errors import CorruptLineError, RecordingError
from tsgt.model import FiniteNumbers, PolarMeasurement, Status, check_finite, check_instants
from tsgt.recording.format import HEADER_START, MAX_LINE_BYTES, RecordingHeader, decode_line
from tsgt.recording.reader import read_lines

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@dataclass(frozen=True, slots=True, kw_only=True)
class JournalRecord:
    """The second line of a journal: its station and the origin of its times and sequence numbers."""

    type: Literal["journal"] = "journal"
    station: int
    """Number of the station, from 1."""
    unix_at_zero_ns: int
    """Offset from CLOCK_MONOTONIC of the station's computer to the times in this file, in ns; constant from the start
    of the client to its end."""
    boot: str = ""
    """The kernel's boot id, which identifies the origin of CLOCK_MONOTONIC; empty where unknown."""
    stream_id: int | None = None
    """The same, 0 to 65535, in all journals whose sequence numbers continue from one to the next; null where each
    begins at 0, as with the protocol classic."""
    first_sequence: int = 0
    """Sequence number of the first measurement."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InstrumentRecord(FiniteNumbers):
    """The instrument and its settings as read back from it, after each connection and each change."""

    type: Literal["instrument"] = "instrument"
    stamp_ns: int = 0
    """Start of validity, on the station computer's clock, in ns."""
    make: str
    """Maker of the instrument."""
    model: str = ""
    """Model, as the instrument reports it; empty where unknown."""
    serial_number: str = ""
    """Serial number; empty where unknown."""
    firmware: str = ""
    """Firmware version; empty where unknown."""
    prism_type: str = ""
    """Reflector that it is set to, in the words of the configuration; empty where unknown."""
    prism_constant_m: float | None = None
    """What the instrument itself adds to a distance, in m, in its maker's convention; null where unknown. The distances
    in this file include it, so the master must add only the remainder."""
    atmospheric_ppm: float | None = None
    """Scale correction of the distance that the instrument itself applies, in 1e-6; null where unknown."""
    temperature_c: float | None = None
    """Air temperature of this correction, in degrees Celsius; null where unknown."""
    pressure_hpa: float | None = None
    """Air pressure of this correction, in hPa; null where unknown."""
    distance_mode: str = ""
    """EDM mode, in the words of the driver; empty where unknown."""
    latency_ns: int = 0
    """Already subtracted from the stamps: from the measurement to the fastest response, in ns."""
    angle_delay_ns: int = 0
    """By how much the angles are newer than the distance, in ns; positive: newer. Not corrected in this file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceptionRecord:
    """The reception of one of the master's beacons, with its transmission time."""

    type: Literal["reception"] = "reception"
    stamp_ns: int
    """End of its reception (RxDone) in ns, on the station computer's clock."""
    stamp_sigma_ns: int
    """One sigma of that."""
    session: int
    """Number of the master's session, 48 bits."""
    counter: int
    """Number of the frame in the session."""
    sent_us: int
    """End of its transmission (TxDone), in us from the start of the session by the master's clock."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AcknowledgedRecord:
    """How far the master has acknowledged; written at most every 5 s."""

    type: Literal["acknowledged"] = "acknowledged"
    stamp_ns: int
    """When, on the station computer's clock, in ns."""
    oldest: int
    """Every measurement with a lower sequence number has been acknowledged or discarded."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetRecord(FiniteNumbers):
    """A single measurement of a target that the operator had aimed at."""

    type: Literal["target"] = "target"
    station: int
    """Number of the station that measured, from 1."""
    stamp_ns: int
    """The station computer's stamp in ns, on its own clock."""
    horizontal_angle_rad: float
    """Horizontal circle, clockwise from the circle's zero, in rad; 0 where the instrument gave none."""
    zenith_angle_rad: float
    """Angle from the zenith in rad; 0 where the instrument gave none."""
    slope_distance_m: float | None
    """Slope distance in m as the instrument gave it; null where it gave none."""
    status: Status
    """The instrument's status, as in ``measurement``."""
    raw_status: int
    """The instrument's own status number."""
    instrument_time_ns: int | None
    """The instrument's own stamp in ns, on the instrument's clock; null where it has none."""

    def __post_init__(self) -> None:
        """Reject impossible times and numbers."""
        check_instants(self.stamp_ns)
        check_finite(self.horizontal_angle_rad, self.zenith_angle_rad, self.slope_distance_m or 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Journal:
    """The measurements of one run of a station's client; times are on the station's own clock."""

    head: JournalRecord
    created_ns: int
    """Start of the client."""
    measurements: list[PolarMeasurement]
    """In the order in which they were read."""
    targets: list[TargetRecord]
    receptions: list[ReceptionRecord]

    @property
    def station(self) -> int:
        """Number of the station."""
        return self.head.station


def is_unfinished_journal(path: Path) -> bool:
    """Return whether the client ended before the first lines were complete; a power cut leaves zero bytes in their place.

    Raises RecordingError if unreadable.
    """
    try:
        with path.open("rb") as file:
            first, second = (file.readline(MAX_LINE_BYTES) for _ in range(2))
    except OSError as error:
        raise RecordingError(f"cannot be read ({error.strerror})", path=path) from error
    first = first.rstrip(b"\0")
    return (HEADER_START.startswith(first) or first.startswith(HEADER_START)) and not second.endswith(b"\n")


def load_journal(
    path: Path,
    *,
    keep_going: bool = False,
    on_problem: Callable[[RecordingError], None] | None = None,
) -> Journal:
    """Read a journal.

    Raises RecordingError if the file cannot be read, or is not a journal. Raises CorruptLineError if a line cannot have
    been written by a client.

    Parameters
    ----------
    path
        Its last line may be torn.
    keep_going
        Skip lines that cannot be read instead of raising.
    on_problem
        Called for each skipped line: a torn last line always, others with ``keep_going``.
    """
    head: JournalRecord | None = None
    created_ns = 0
    records: dict[str, list[Any]] = {"measurement": [], "target": [], "reception": []}
    types = {"measurement": PolarMeasurement, "target": TargetRecord, "reception": ReceptionRecord}
    for line in read_lines(path, keep_going=keep_going, on_problem=on_problem):
        try:
            if line.type == "recording":
                created_ns = created_ns or decode_line(RecordingHeader, line, path).created_ns
            elif line.type == "journal":
                record = decode_line(JournalRecord, line, path)
                if head is not None and head != record:
                    raise CorruptLineError("begins a second journal", path=path, line=line.number)
                head = record
            elif line.type in types:
                records[line.type].append(decode_line(types[line.type], line, path))
        except CorruptLineError as problem:
            if not keep_going or line.type == "journal":
                raise
            if on_problem is not None:
                on_problem(problem)
    if head is None:
        raise RecordingError("is not a station's journal; give a file that tsgt-client wrote", path=path)
    measurements, targets, receptions = records.values()
    return Journal(
        head=head,
        created_ns=created_ns,
        measurements=measurements,
        targets=targets,
        receptions=receptions,
    )
