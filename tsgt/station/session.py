"""Mode, prism and sequence numbers of a station's client, whatever the protocol: readings in, records and status out.

Sans-I/O. All times are on the station's Unix timeline, in ns, fixed when the client starts. The caller executes the
master's commands and reports them with :meth:`ClientSession.apply`.
"""

from __future__ import annotations

from collections import deque
from dataclasses import asdict
from typing import TYPE_CHECKING

from tsgt.model import PolarMeasurement
from tsgt.radio import Command, DirectCommand, MeasureCommand, SearchCommand, TrackCommand
from tsgt.recording.journal import TargetRecord
from tsgt.station.status import ClientStatus, LastMeasurement

if TYPE_CHECKING:
    from tsgt.recording.journal import InstrumentRecord
    from tsgt.station.instrument import Condition, Reading
    from tsgt.station.status import LinkStatus, Mode

RATE_WINDOW_NS = 10_000_000_000


class ClientSession:
    """One run of a station's client.

    ``prism``: prism that is tracked from the start. ``first_sequence``: sequence number of the first measurement.
    ``mode``, ``prism``: what the instrument is to do; changed by executed commands.
    """

    def __init__(self, station: int, prism: int, first_sequence: int = 0) -> None:
        self.station = station
        self.prism = prism
        self.mode: Mode = "tracking"
        self._first_sequence = first_sequence
        self._measurements = 0
        self._first_ns: int | None = None
        self._stamps_ns: deque[int] = deque()
        self._last: PolarMeasurement | TargetRecord | None = None

    # --- Measurements -----------------------------------------------------------------------------------------

    def measurement(self, reading: Reading, stamp_ns: int) -> PolarMeasurement:
        """Return the journal's record of a reading of the tracked prism, and count it.

        ``stamp_ns``: the reading's ``at_ns`` on the station's Unix timeline.
        """
        # The raw arrival, so that post-processing can map the instrument's time to this computer's clock again.
        received_ns = reading.at_ns if reading.received_ns is None else reading.received_ns
        measurement = PolarMeasurement(
            station=self.station,
            prism=self.prism if reading.prism is None else reading.prism,
            sequence=self._first_sequence + self._measurements,
            stamp_ns=stamp_ns,
            stamp_sigma_ns=reading.sigma_ns,
            received_ns=stamp_ns + received_ns - reading.at_ns,
            horizontal_angle_rad=reading.horizontal_angle_rad,
            zenith_angle_rad=reading.zenith_angle_rad,
            slope_distance_m=reading.slope_distance_m,
            status=reading.status,
            raw_status=reading.raw_status,
            host_time_ns=stamp_ns,
            instrument_time_ns=reading.instrument_time_ns,
        )
        self._measurements += 1
        self._first_ns = stamp_ns if self._first_ns is None else self._first_ns
        self._stamps_ns.append(stamp_ns)
        self._trim_window(stamp_ns)
        self._last = measurement
        return measurement

    def single_measurement(self, reading: Reading, stamp_ns: int) -> TargetRecord:
        """Return the journal's record of a single measurement; see :meth:`measurement`."""
        self._last = TargetRecord(
            station=self.station,
            stamp_ns=stamp_ns,
            horizontal_angle_rad=reading.horizontal_angle_rad,
            zenith_angle_rad=reading.zenith_angle_rad,
            slope_distance_m=reading.slope_distance_m,
            status=reading.status,
            raw_status=reading.raw_status,
            instrument_time_ns=reading.instrument_time_ns,
        )
        return self._last

    # --- Commands ---------------------------------------------------------------------------------------------

    def is_satisfied(self, command: Command) -> bool:
        """Whether the instrument already does what a command asks for."""
        match command:
            case TrackCommand(prism):
                return self.mode == "tracking" and prism in (None, self.prism)
            case DirectCommand():
                return self.mode == "direct"
            case SearchCommand() | MeasureCommand():
                return False

    def apply(self, command: TrackCommand | SearchCommand | DirectCommand) -> None:
        """Update mode and prism after a command was executed."""
        if isinstance(command, DirectCommand):
            self.mode = "direct"
            return
        self.mode = "tracking"
        if isinstance(command, TrackCommand):
            self.prism = command.prism or self.prism

    # --- Status -----------------------------------------------------------------------------------------------

    def status(
        self,
        now_ns: int,
        link: LinkStatus,
        *,
        instrument: str | None,
        condition: Condition,
        settings: InstrumentRecord | None,
        journal: str,
        journal_ok: bool,
        journal_waiting: int,
        journal_lost: int,
        radio_ok: bool,
    ) -> ClientStatus:
        """Return the client's status; parameters as in :class:`ClientStatus`, times on the station's Unix timeline."""
        self._trim_window(now_ns)
        last = self._last
        link_fields = asdict(link)
        master_received_ns = link_fields.pop("master_received_ns")
        return ClientStatus(
            stamp_ns=now_ns,
            station=self.station,
            instrument=instrument,
            settings=settings,
            mode=self.mode,
            prism=self.prism,
            locked=None if last is None else last.status.has_target,
            last=None
            if last is None
            else LastMeasurement(
                age_s=(now_ns - last.stamp_ns) / 1e9,
                prism=last.prism if isinstance(last, PolarMeasurement) else None,
                horizontal_angle_rad=last.horizontal_angle_rad,
                zenith_angle_rad=last.zenith_angle_rad,
                slope_distance_m=last.slope_distance_m,
                status=last.status,
            ),
            measurements=self._measurements,
            rate_hz=self._rate_hz(now_ns),
            journal=journal,
            journal_ok=journal_ok,
            journal_waiting=journal_waiting,
            journal_lost=journal_lost,
            master_heard_s=None if master_received_ns is None else (now_ns - master_received_ns) / 1e9,
            radio_ok=radio_ok,
            **asdict(condition),
            **link_fields,
        )

    def _rate_hz(self, now_ns: int) -> float:
        if self._first_ns is None:
            return 0.0
        return len(self._stamps_ns) / (min(max(now_ns - self._first_ns, 1_000_000_000), RATE_WINDOW_NS) / 1e9)

    def _trim_window(self, now_ns: int) -> None:
        while self._stamps_ns and self._stamps_ns[0] <= now_ns - RATE_WINDOW_NS:
            self._stamps_ns.popleft()
