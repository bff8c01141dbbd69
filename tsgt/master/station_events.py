"""Detects changes of a station's state that are worth an event on the stream. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tsgt.model import NO_MEASUREMENT, NewestMeasurement, Status
from tsgt.recording import LOW_BATTERY_PERCENT, EventRecord

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tsgt.model import Measurement

LOSS_TIMEOUT_NS = 5_000_000_000
"""A station that has not responded to requests for this long is lost. While others are synchronised none are sent."""

IDLE_TIMEOUT_NS = 10_000_000_000
"""A station that sends no new measurement for this long is idle; no instrument pauses for longer."""

CHARGED_BATTERY_PERCENT = LOW_BATTERY_PERCENT + 10
"""A low battery is low until it has this again: changed, or charged."""

NO_DISTANCE_NS = 2_000_000_000
"""An instrument that measures angles without distances for this long has an event: in rain single distances fail."""

CLOCK_STEP_THRESHOLD_NS = 100_000_000
"""A change of the offset between the machine's Unix clock and the master's timeline that counts as a step."""

_MEANING = {
    Status.OK: "measures",
    Status.LOW_ACCURACY: "measures",
    Status.ANGLE_ONLY: "measures angles without distances; the prism may be nearer than 1 m, or the return is weak",
    Status.NO_TARGET: "has no prism, or reports another error",
    Status.TILT: "is not levelled",
    Status.WRONG_DISTANCE: "reports a wrong distance; it may be on the wrong prism",
    Status.ERROR: "reports an error",
}


@dataclass(slots=True)
class _Station:
    """State of one station."""

    received_ns: int
    unanswered_since_ns: int | None = None
    """First request without a response; None while the station responds."""
    unanswered: int = 0
    lost: bool = False
    refused: bool = False
    nothing_new_since_ns: int | None = None
    """First reply without a new measurement; None while there are new ones."""
    idle: bool = False
    battery_low: bool = False
    meaning: str = _MEANING[Status.OK]
    no_distance_since_ns: int | None = None
    """Stamp of the first measurement of angles without a distance; None after any other."""
    newest: NewestMeasurement = NO_MEASUREMENT


class StationEventDetector:
    """Turns changes of the stations' states into events; instants are on the master's Unix clock in ns."""

    def __init__(self, stations: Iterable[int], now_ns: int) -> None:
        self._stations = {station: _Station(now_ns) for station in stations}
        self._clock_difference_ns = 0

    def exchange(self, station: int, now_ns: int, *, responded: bool) -> list[EventRecord]:
        """Take the outcome of a request or slot; return the event of a station that recovered."""
        found = self._stations[station]
        if not responded:
            if found.unanswered_since_ns is None:
                found.unanswered_since_ns = now_ns
            found.unanswered += 1
            return []
        found.unanswered_since_ns, found.unanswered = None, 0
        silent_s = (now_ns - found.received_ns) / 1e9
        found.received_ns = now_ns
        if not found.lost:
            return []
        found.lost = False
        return [_event(now_ns, "station_recovered", f"responds again after {silent_s:.0f} s", station)]

    def tracking_result(self, station: int, prism: int, now_ns: int, *, tracks: bool) -> list[EventRecord]:
        """Take whether a station tracks its prism; return the event of a change."""
        found = self._stations[station]
        if tracks != found.refused:
            return []
        found.refused = not tracks
        if tracks:
            return [_event(now_ns, "station_tracking", f"now tracks prism {prism}", station)]
        text = f"does not track prism {prism}; check its instrument. The command is repeated"
        return [_event(now_ns, "station_not_tracking", text, station)]

    def battery(self, station: int, percent: int | None, now_ns: int) -> list[EventRecord]:
        """Take the charge of an instrument's battery; return the event of one that is low, or no longer so."""
        found = self._stations[station]
        threshold = CHARGED_BATTERY_PERCENT if found.battery_low else LOW_BATTERY_PERCENT
        if percent is None or (percent < threshold) == found.battery_low:
            return []
        found.battery_low = not found.battery_low
        if found.battery_low:
            text = f"has {percent} % left in the battery of its instrument; change it"
            return [_event(now_ns, "battery_low", text, station)]
        return [_event(now_ns, "battery_recovered", f"has {percent} % in its battery again", station)]

    def clock_stepped(self, station: int, now_ns: int) -> EventRecord:
        """Return the event of a station's clock that was stepped or reset."""
        text = "has a new clock: restarted, or set; its measurements are converted with the new offset"
        return _event(now_ns, "station_clock_stepped", text, station)

    def beacon_time_rejected(self, station: int, now_ns: int, count: int) -> EventRecord:
        """Return the event of beacons that a station received at impossible times."""
        text = (
            f"rejected {count} beacons received at impossible times; "
            "someone may be delaying and replaying packets"
        )
        return _event(now_ns, "beacon_time_rejected", text, station, count)

    def link_delay_anomaly(self, station: int, now_ns: int) -> EventRecord:
        """Return the event of an impossible link delay."""
        text = (
            "measured an impossible link delay; someone may be delaying and replaying packets, or a radio has bad "
            "timestamps. The exchange is not used"
        )
        return _event(now_ns, "link_delay_anomaly", text, station)

    def reply(self, station: int, now_ns: int) -> list[EventRecord]:
        """Take a reply, before the measurements that it may carry; return the event of a station that went idle.

        A station that repeats an error without a time does not become idle: the error has its own event.
        """
        found = self._stations[station]
        if found.nothing_new_since_ns is None:
            found.nothing_new_since_ns = now_ns
        idle_ns = now_ns - found.nothing_new_since_ns
        if found.idle or idle_ns <= IDLE_TIMEOUT_NS or found.meaning != _MEANING[Status.OK]:
            return []
        found.idle = True
        text = f"responds, but has measured nothing for {idle_ns / 1e9:.0f} s; check its instrument"
        return [_event(now_ns, "station_idle", text, station)]

    def measurement(self, measurement: Measurement, now_ns: int) -> list[EventRecord]:
        """Take a measurement; return the events of an instrument that measures again or has a new status."""
        found = self._stations.get(measurement.station)
        if found is None:
            return []
        events = []
        late = found.newest.is_newer_than(measurement)
        found.nothing_new_since_ns = None
        if found.idle:
            found.idle = False
            events.append(_event(now_ns, "station_measuring", "measures again", measurement.station))
        if late:  # its status is out of date
            return events
        found.newest = NewestMeasurement.of(measurement)
        meaning = _MEANING[measurement.status]
        if measurement.status is not Status.ANGLE_ONLY:
            found.no_distance_since_ns = None
        elif found.no_distance_since_ns is None:
            found.no_distance_since_ns = measurement.stamp_ns
        since_ns = found.no_distance_since_ns
        if since_ns is not None and measurement.stamp_ns - since_ns < NO_DISTANCE_NS:
            return events
        if meaning != found.meaning:
            found.meaning = meaning
            again = " again" if measurement.status.usable else ""
            events.append(_event(now_ns, "instrument_status", f"{meaning}{again}", measurement.station))
        return events

    def tick(self, now_ns: int, *, realtime_ns: int) -> list[EventRecord]:
        """Return the events that time alone brings.

        ``now_ns``: the present on the timeline that was fixed at the start. ``realtime_ns``: the present on the
        machine's Unix clock.
        """
        events = []
        for number, station in self._stations.items():
            since_ns = station.unanswered_since_ns
            timed_out = since_ns is not None and now_ns - since_ns > LOSS_TIMEOUT_NS
            if timed_out and station.unanswered > 1 and not station.lost:
                station.lost = True
                text = (
                    f"has not responded for {(now_ns - station.received_ns) / 1e9:.0f} s; run `tsgt status` on its "
                    "computer to see whether it receives this master, and on the others to see that none has its number"
                )
                events.append(_event(now_ns, "station_lost", text, number))
        difference_ns = realtime_ns - now_ns
        step_ns = difference_ns - self._clock_difference_ns
        if abs(step_ns) > CLOCK_STEP_THRESHOLD_NS:
            text = (
                f"the Unix clock of this computer was set by {step_ns / 1e9:+.3f} s and is now "
                f"{difference_ns / 1e9:+.3f} s from the time of this stream, which is not affected"
            )
            events.append(EventRecord(stamp_ns=now_ns, event="unix_clock_stepped", message=text))
            self._clock_difference_ns = difference_ns
        return events


def _event(now_ns: int, event: str, text: str, station: int, count: int | None = None) -> EventRecord:
    message = f"station {station} {text}"
    return EventRecord(stamp_ns=now_ns, event=event, message=message, station=station, count=count)
