"""What happens to stations, and is worth an event on the stream. Pure: instants and findings in, events out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tsgt.model import Status
from tsgt.recording import EventRecord

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tsgt.model import Measurement

LOST_AFTER_NS = 5_000_000_000
"""A station that has been asked for this long without an answer is lost. Nobody asks it while others are synchronised."""

IDLE_AFTER_NS = 10_000_000_000
"""A station that answers without anything new for this long has lost its instrument; no instrument pauses so long."""

CLOCK_STEP_NS = 100_000_000
"""The machine's Unix clock has been stepped when it has left the master's timeline by this much more than before."""

_MEANING = {
    Status.OK: "measures",
    Status.LOW_ACCURACY: "measures",
    Status.ANGLE_ONLY: "measures angles without a distance; the prism may be nearer than 1 m",
    Status.NO_TARGET: "has no prism, or reports another error",
    Status.TILT: "is not levelled",
    Status.WRONG_DISTANCE: "reports a wrong distance; it may be on the wrong prism",
    Status.ERROR: "reports an error",
}


@dataclass(slots=True)
class _Station:
    """What is known of one station."""

    heard_ns: int
    missed_ns: int | None = None
    """Since when it has been asked without an answer; None while it answers."""
    misses: int = 0
    lost: bool = False
    refused: bool = False
    nothing_new_ns: int | None = None
    """Since when its answers hold no new measurement; None while they do."""
    idle: bool = False
    meaning: str = _MEANING[Status.OK]
    newest: tuple[int, int] = (-1, 0)
    """Sequence number and stamp of the newest measurement."""


class Alerts:
    """Turns findings into events, once per change.

    Parameters
    ----------
    stations
        Numbers of the stations.
    now_ns
        The present on the master's Unix clock in ns, like all instants here.
    """

    def __init__(self, stations: Iterable[int], now_ns: int) -> None:
        self._stations = {station: _Station(now_ns) for station in stations}
        self._unix_ahead_ns = 0

    def asked(self, station: int, now_ns: int, *, answered: bool) -> list[EventRecord]:
        """Take note of a turn of a station; tell when it is back."""
        found = self._stations[station]
        if not answered:
            found.missed_ns = now_ns if found.missed_ns is None else found.missed_ns
            found.misses += 1
            return []
        found.missed_ns, found.misses = None, 0
        silent_s = (now_ns - found.heard_ns) / 1e9
        found.heard_ns = now_ns
        if not found.lost:
            return []
        found.lost = False
        return [_event(now_ns, "station_recovered", f"answers again after {silent_s:.0f} s", station)]

    def ordered(self, station: int, prism: int, now_ns: int, *, tracks: bool) -> list[EventRecord]:
        """Take note of whether a station says that it tracks its prism."""
        found = self._stations[station]
        if tracks != found.refused:
            return []
        found.refused = not tracks
        if tracks:
            return [_event(now_ns, "station_tracking", f"now tracks prism {prism}", station)]
        text = f"does not track prism {prism}; look at its instrument. It is told again"
        return [_event(now_ns, "station_not_tracking", text, station)]

    def stepped(self, station: int, now_ns: int) -> list[EventRecord]:
        """Tell that a station's clock was found to be another one."""
        text = "has another clock than before: restarted, or set; its measurements are put on the new one"
        return [_event(now_ns, "station_clock_stepped", text, station)]

    def beacon_time_rejected(self, station: int, now_ns: int, count: int) -> list[EventRecord]:
        """Tell that a station received beacons at a time at which they cannot have been sent."""
        text = (
            f"station {station} received {count} beacons at a time at which they cannot have been sent; somebody may be "
            "holding back packets and sending them later. They are not used"
        )
        return [
            EventRecord(
                stamp_ns=now_ns, event="beacon_time_rejected", message=text, station=station, count=count
            )
        ]

    def link_delay_anomaly(self, station: int, now_ns: int) -> list[EventRecord]:
        """Tell that the time between a station and the master came out as it cannot be."""
        text = (
            "and the master disagree on how long a packet takes; somebody may be holding back packets and sending them "
            "later, or a radio stamps badly. This exchange is not used"
        )
        return [_event(now_ns, "link_delay_anomaly", text, station)]

    def polled(self, station: int, now_ns: int) -> list[EventRecord]:
        """Take note of an answer, before the measurement that it may hold; tell when none comes any more.

        A node that repeats an error without a time has been told of already.
        """
        found = self._stations[station]
        found.nothing_new_ns = now_ns if found.nothing_new_ns is None else found.nothing_new_ns
        idle_ns = now_ns - found.nothing_new_ns
        if found.idle or idle_ns <= IDLE_AFTER_NS or found.meaning != _MEANING[Status.OK]:
            return []
        found.idle = True
        text = f"answers, but has measured nothing for {idle_ns / 1e9:.0f} s; look at its instrument"
        return [_event(now_ns, "station_idle", text, station)]

    def measurement(self, measurement: Measurement, now_ns: int) -> list[EventRecord]:
        """Tell when an instrument measures again, and when it reports an error, another one, or none any more."""
        found = self._stations.get(measurement.station)
        if found is None:
            return []
        events = []
        late = measurement.sequence < found.newest[0] and measurement.stamp_ns < found.newest[1]
        found.nothing_new_ns = None
        if found.idle:
            found.idle = False
            events.append(_event(now_ns, "station_measuring", "measures again", measurement.station))
        if late:  # it tells how the instrument did, not how it does
            return events
        found.newest = (measurement.sequence, measurement.stamp_ns)
        meaning = _MEANING[measurement.status]
        if meaning != found.meaning:
            found.meaning = meaning
            again = " again" if measurement.status.usable else ""
            events.append(_event(now_ns, "instrument_status", f"{meaning}{again}", measurement.station))
        return events

    def tick(self, now_ns: int, *, unix_ns: int) -> list[EventRecord]:
        """Tell what time alone brings.

        Parameters
        ----------
        now_ns
            The present on the timeline that was fixed at the start.
        unix_ns
            The present as the machine's Unix clock shows it.
        """
        events = []
        for number, station in self._stations.items():
            missed_ns = station.missed_ns
            late = missed_ns is not None and now_ns - missed_ns > LOST_AFTER_NS
            if late and station.misses > 1 and not station.lost:
                station.lost = True
                text = (
                    f"not heard for {(now_ns - station.heard_ns) / 1e9:.0f} s; `tsgt status` on its computer tells "
                    "whether it hears this master"
                )
                events.append(_event(now_ns, "station_lost", text, number))
        ahead_ns = unix_ns - now_ns
        if abs(ahead_ns - self._unix_ahead_ns) > CLOCK_STEP_NS:
            text = (
                f"the Unix clock of this computer was set by {(ahead_ns - self._unix_ahead_ns) / 1e9:+.3f} s and is "
                f"now {ahead_ns / 1e9:+.3f} s from the time of this stream, which goes on as it was"
            )
            events.append(EventRecord(stamp_ns=now_ns, event="unix_clock_stepped", message=text))
            self._unix_ahead_ns = ahead_ns
        return events


def _event(now_ns: int, event: str, text: str, station: int) -> EventRecord:
    return EventRecord(stamp_ns=now_ns, event=event, message=f"station {station} {text}", station=station)
