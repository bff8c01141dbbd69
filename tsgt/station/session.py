"""What a station's client knows and decides, whatever the protocol: readings in, records and status out.

All instants are on the station's Unix timeline, in ns, fixed when the client starts. The instrument is not touched
here: orders of the master are carried out by the caller, and reported back.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from tsgt.model import PolarMeasurement, Status
from tsgt.radio import DirectOrder, MeasureOrder, Order, SearchOrder, TrackOrder
from tsgt.recording.journal import TargetRecord
from tsgt.station.status import ClientStatus, LastMeasurement

if TYPE_CHECKING:
    from tsgt.recording.journal import InstrumentRecord
    from tsgt.station.instrument import Condition, Reading
    from tsgt.station.status import LinkStatus, Mode

RATE_WINDOW_NS = 10_000_000_000


class Session:
    """One station's client, from its start to its end.

    Parameters
    ----------
    station
        Number of the station.
    prism
        Number of the prism that it tracks from the start.
    run_start
        Sequence number of the first measurement.

    Attributes
    ----------
    station, prism, mode
        What it is, and what its instrument is to do; changed by orders that have been carried out.
    """

    def __init__(self, station: int, prism: int, run_start: int = 0) -> None:
        self.station = station
        self.prism = prism
        self.mode: Mode = "tracking"
        self._run_start = run_start
        self._measurements = 0
        self._first_ns: int | None = None
        self._stamps_ns: deque[int] = deque()
        self._last: PolarMeasurement | TargetRecord | None = None

    # --- Instrument -------------------------------------------------------------------------------------------

    def measured(self, reading: Reading, stamp_ns: int) -> PolarMeasurement:
        """Return what stands in the journal of a reading of the tracked prism.

        Parameters
        ----------
        reading
            As the instrument gave it, whatever its status.
        stamp_ns
            Its ``at_ns`` on the station's Unix timeline.
        """
        # Raw, so that the desk can put the instrument's time on this computer's clock anew.
        received_ns = reading.at_ns if reading.received_ns is None else reading.received_ns
        measurement = PolarMeasurement(
            station=self.station,
            prism=self.prism if reading.prism is None else reading.prism,
            sequence=self._run_start + self._measurements,
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
        self._forget_before(stamp_ns - RATE_WINDOW_NS)
        self._last = measurement
        return measurement

    def shot(self, reading: Reading, stamp_ns: int) -> TargetRecord:
        """Return what stands in the journal of a single measurement; see :meth:`measured`."""
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

    # --- Orders -----------------------------------------------------------------------------------------------

    def is_done_already(self, order: Order) -> bool:
        """Whether the instrument does what an order asks for, so that it need not be disturbed."""
        match order:
            case TrackOrder(prism):
                return self.mode == "tracking" and prism in (None, self.prism)
            case DirectOrder():
                return self.mode == "direct"
            case SearchOrder() | MeasureOrder():
                return False

    def executed(self, order: TrackOrder | SearchOrder | DirectOrder) -> None:
        """Take it that an order has been carried out."""
        if isinstance(order, DirectOrder):
            self.mode = "direct"
            return
        self.mode = "tracking"
        if isinstance(order, TrackOrder):
            self.prism = order.prism or self.prism

    # --- People -----------------------------------------------------------------------------------------------

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
        """Say how it goes.

        Parameters
        ----------
        now_ns
            On the station's Unix timeline.
        link
            How it goes over the radio; its ``heard_ns`` on the same timeline.
        condition
            Of the instrument.
        instrument, settings, journal, journal_ok, journal_waiting, journal_lost, radio_ok
            Fields of :class:`ClientStatus`.
        """
        self._forget_before(now_ns - RATE_WINDOW_NS)
        last = self._last
        return ClientStatus(
            stamp_ns=now_ns,
            station=self.station,
            instrument=instrument,
            activity=condition.activity,
            problem=condition.problem,
            battery_percent=condition.battery_percent,
            settings=settings,
            mode=self.mode,
            prism=self.prism,
            locked=None if last is None else last.status not in (Status.NO_TARGET, Status.ERROR),
            last=None
            if last is None
            else LastMeasurement(
                age_s=_seconds(now_ns - last.stamp_ns),
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
            master_heard_s=None if link.heard_ns is None else _seconds(now_ns - link.heard_ns),
            rssi_dbm=link.rssi_dbm,
            snr_db=link.snr_db,
            unknown_packets=link.unknown_packets,
            radio_ok=radio_ok,
            protocol=link.protocol,
            authenticated=link.authenticated,
            joined=link.joined,
            queued=link.queued,
            late=link.late,
            doubted=link.doubted,
            refused=link.refused,
            clock_bound_ns=link.clock_bound_ns,
        )

    def _rate_hz(self, now_ns: int) -> float:
        if self._first_ns is None:
            return 0.0
        return len(self._stamps_ns) / _seconds(
            min(max(now_ns - self._first_ns, 1_000_000_000), RATE_WINDOW_NS)
        )

    def _forget_before(self, oldest_ns: int) -> None:
        while self._stamps_ns and self._stamps_ns[0] <= oldest_ns:
            self._stamps_ns.popleft()


def _seconds(duration_ns: int) -> float:
    return duration_ns / 1e9
