"""What a station's client knows and decides: readings and packets in, records and answers out.

All instants are on the station's Unix timeline, in ns, fixed when the client starts. The instrument is not touched
here: an order of the master comes out of :meth:`Session.received`, is carried out by the caller, and reported back.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tsgt.model import PolarMeasurement, Status
from tsgt.radio.classic import ClassicStation, DirectOrder, MeasureOrder, Order, TrackOrder
from tsgt.radio.classic_messages import MeasurementMessage, decode_command, raw_status
from tsgt.recording.journal import TargetRecord
from tsgt.station.status import ClientStatus, LastMeasurement

if TYPE_CHECKING:
    from tsgt.station.instrument import Reading
    from tsgt.station.status import Mode

RATE_WINDOW_NS = 10_000_000_000


@dataclass(frozen=True, slots=True)
class _Heard:
    at_ns: int
    rssi_dbm: float
    snr_db: float


class Session:
    """One station's client, from its start to its end.

    Parameters
    ----------
    station
        Number of the station.
    prism
        Number of the prism that it tracks from the start.

    Attributes
    ----------
    station, prism, mode
        What it is, and what its instrument is to do; changed by orders that have been carried out.
    """

    def __init__(self, station: int, prism: int) -> None:
        self.station = station
        self.prism = prism
        self.mode: Mode = "tracking"
        self._protocol = ClassicStation(station)
        self._measurements = 0
        self._first_ns: int | None = None
        self._stamps_ns: deque[int] = deque()
        self._last: PolarMeasurement | TargetRecord | None = None
        self._heard: _Heard | None = None

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
        measurement = PolarMeasurement(
            station=self.station,
            prism=self.prism if reading.prism is None else reading.prism,
            sequence=self._measurements,
            stamp_ns=stamp_ns,
            received_ns=stamp_ns,
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

    def offer(self, measurement: PolarMeasurement) -> None:
        """Answer the master with this one from now on; the caller has journalled it.

        One that the disk held up until the station did something else is not offered any more.
        """
        if self.mode == "tracking" and measurement.prism == self.prism:
            self._protocol.measured(_message(measurement))

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

    # --- Radio ------------------------------------------------------------------------------------------------

    def received(self, payload: bytes, at_ns: int, *, rssi_dbm: float, snr_db: float) -> bytes | Order | None:
        """Take a packet; return the answer, or an order to be carried out, or None where there is neither.

        Parameters
        ----------
        payload
            Whatever the radio has heard.
        at_ns
            Its RxDone.
        rssi_dbm, snr_db
            Its strength.
        """
        command = decode_command(payload)
        if command is not None and command.station == self.station:
            self._heard = _Heard(at_ns, rssi_dbm, snr_db)
        return self._protocol.received(payload, at_ns)

    def is_done_already(self, order: Order) -> bool:
        """Whether the instrument does what an order asks for, so that it need not be disturbed."""
        match order:
            case TrackOrder(prism):
                return self.mode == "tracking" and prism in (None, self.prism)
            case DirectOrder():
                return self.mode == "direct"
            case MeasureOrder():
                return False

    def executed(self, order: TrackOrder | DirectOrder, *, ok: bool) -> bytes:
        """Report what became of an order; return the answer. After a failure everything is as it was."""
        if ok and isinstance(order, TrackOrder):
            self.mode = "tracking"
            self.prism = order.prism or self.prism
        elif ok:
            self.mode = "direct"
        return self._protocol.executed(order, ok=ok)

    def shot_answer(self, target: TargetRecord) -> bytes:
        """Return the answer that carries a single measurement; the caller has journalled it."""
        return self._protocol.shot(_message(target))

    def shot_failed(self, at_ns: int) -> bytes:
        """Return the answer to an order for a single measurement that the instrument could not make."""
        return self._protocol.shot(
            MeasurementMessage(
                station=self.station,
                status=raw_status(Status.ERROR),
                zenith_angle_rad=0.0,
                horizontal_angle_rad=0.0,
                slope_distance_m=0.0,
                time_ns=at_ns,
            )
        )

    # --- People -----------------------------------------------------------------------------------------------

    def status(
        self,
        now_ns: int,
        *,
        instrument: str | None,
        journal: str,
        journal_ok: bool,
        journal_waiting: int,
        radio_ok: bool,
    ) -> ClientStatus:
        """Say how it goes; the parameters are fields of :class:`ClientStatus`."""
        self._forget_before(now_ns - RATE_WINDOW_NS)
        heard, last = self._heard, self._last
        return ClientStatus(
            stamp_ns=now_ns,
            station=self.station,
            instrument=instrument,
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
            master_heard_s=None if heard is None else _seconds(now_ns - heard.at_ns),
            rssi_dbm=None if heard is None else heard.rssi_dbm,
            snr_db=None if heard is None else heard.snr_db,
            radio_ok=radio_ok,
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


def _message(measurement: PolarMeasurement | TargetRecord) -> MeasurementMessage:
    """Raw values, as the authors' nodes send them: no prism constant, 0 for a distance that is missing."""
    return MeasurementMessage(
        station=measurement.station,
        status=raw_status(measurement.status),
        zenith_angle_rad=measurement.zenith_angle_rad,
        horizontal_angle_rad=measurement.horizontal_angle_rad,
        slope_distance_m=measurement.slope_distance_m or 0.0,
        time_ns=measurement.stamp_ns,
    )


def _seconds(duration_ns: int) -> float:
    return duration_ns / 1e9
