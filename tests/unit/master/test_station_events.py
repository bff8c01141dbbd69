"""The station event detector: one event per change of a station's state."""

from __future__ import annotations

from dataclasses import replace

import pytest
from harness.files.records import SECOND, START, measurement

from tsgt.master.station_events import StationEventDetector
from tsgt.model import Status


def test_station_is_lost_and_recovers() -> None:
    """Five seconds without a response to a request, and then one."""
    detector = StationEventDetector([1, 2], START)
    assert detector.exchange(1, START + SECOND, responded=True) == []
    names = []
    for second in range(2, 12):
        now_ns = START + second * SECOND
        assert detector.exchange(1, now_ns, responded=False) == []
        names += [event.event for event in detector.tick(now_ns, realtime_ns=now_ns)]
    assert names == ["station_lost"]
    (back,) = detector.exchange(1, START + 61 * SECOND, responded=True)
    assert (back.event, back.station) == ("station_recovered", 1)
    assert "after 60 s" in back.message


def test_station_without_requests_is_not_lost() -> None:
    """No requests are sent while others are first synchronised."""
    detector = StationEventDetector([1], START)
    assert detector.tick(START + 60 * SECOND, realtime_ns=START + 60 * SECOND) == []


def test_lost_packet_is_no_lost_station() -> None:
    """There was no packet before because there was no request."""
    detector = StationEventDetector([1], START)
    detector.exchange(1, START + 24 * SECOND, responded=False)
    for second in (25, 40):
        now_ns = START + second * SECOND
        assert detector.tick(now_ns, realtime_ns=now_ns) == []
    detector.exchange(1, START + 40 * SECOND, responded=False)
    (lost,) = detector.tick(START + 41 * SECOND, realtime_ns=START + 41 * SECOND)
    assert lost.event == "station_lost"


def test_refusal_to_track_is_one_event() -> None:
    """So is its end; a station that tracks at once has no event."""
    detector = StationEventDetector([1], START)
    assert detector.tracking_result(1, 4, START, tracks=True) == []
    events = [
        e for tracks in (False, False, True) for e in detector.tracking_result(1, 4, START, tracks=tracks)
    ]
    assert [event.event for event in events] == ["station_not_tracking", "station_tracking"]


def test_change_of_instrument_status_is_an_event() -> None:
    """One per kind of error, and when it measures again; low accuracy is normal in motion."""
    detector = StationEventDetector([1], START)
    statuses = [
        Status.OK,
        Status.LOW_ACCURACY,
        Status.TILT,
        Status.TILT,
        Status.WRONG_DISTANCE,
        Status.OK,
        Status.NO_TARGET,
    ]
    events = [e for s in statuses for e in detector.measurement(replace(measurement(0), status=s), START)]
    assert {event.event for event in events} == {"instrument_status"}
    texts = ["not levelled", "wrong distance", "measures again", "no prism"]
    assert [text in event.message for text, event in zip(texts, events, strict=True)] == [True] * 4


@pytest.mark.parametrize(("steps_s", "count"), [([0.05, 0.09], 0), ([0.05, 0.2], 1), ([-3600.0, -3600.0], 1)])
def test_unix_clock_step_is_one_event(steps_s: list[float], count: int) -> None:
    """A slew of less than 0.1 s is none; each further step is one."""
    detector = StationEventDetector([1], START)
    events = [e for s in steps_s for e in detector.tick(START, realtime_ns=START + round(s * 1e9))]
    assert [event.event for event in events] == ["unix_clock_stepped"] * count


def test_forward_step_has_a_positive_sign() -> None:
    """Forward step has a positive sign."""
    (event,) = StationEventDetector([1], START).tick(START, realtime_ns=START + 2 * SECOND)
    assert "was set by +2.000 s and is now +2.000 s from" in event.message


def test_station_without_new_measurements_is_idle() -> None:
    """It repeats its last measurement: an event after ten seconds, and one with the next new measurement."""
    detector = StationEventDetector([1], START)
    detector.reply(1, START)
    detector.measurement(measurement(0), START)
    names = []
    for second in range(1, 30):
        names += [event.event for event in detector.reply(1, START + second * SECOND)]
    assert names == ["station_idle"]
    events = detector.measurement(measurement(0), START + 31 * SECOND)
    assert [event.event for event in events] == ["station_measuring"]


def test_station_without_polls_is_not_idle() -> None:
    """A first measurement half a minute after the last poll is normal while others are synchronised."""
    detector = StationEventDetector([1], START)
    detector.reply(1, START)
    detector.measurement(measurement(0), START)
    assert detector.reply(1, START + 30 * SECOND) == []
    assert detector.measurement(measurement(0), START + 30 * SECOND) == []


def test_repeated_error_is_not_idle() -> None:
    """The authors' nodes repeat an error without a time; the error has its own event."""
    detector = StationEventDetector([1], START)
    detector.measurement(replace(measurement(0), status=Status.TILT), START)
    assert [e for second in range(60) for e in detector.reply(1, START + second * SECOND)] == []


def test_single_missed_distances_are_no_events() -> None:
    """As in rain; angles without distances for two seconds are one event, and the next distance another."""
    detector = StationEventDetector([1], START)
    rain = [Status.OK, Status.ANGLE_ONLY, Status.ANGLE_ONLY, Status.OK, Status.ANGLE_ONLY, Status.OK]
    near = [Status.ANGLE_ONLY] * 4 + [Status.OK]
    times = []
    for second, status in enumerate(rain + near):
        found = replace(measurement(second), status=status, stamp_ns=START + second * SECOND)
        times += [second for _ in detector.measurement(found, START + second * SECOND)]
    assert times == [8, 10]


def test_late_status_is_no_event() -> None:
    """It is out of date."""
    detector = StationEventDetector([1], START)
    newest = replace(measurement(9), station=1, stamp_ns=START + 9 * SECOND)
    assert detector.measurement(newest, START + 10 * SECOND) == []
    late = replace(newest, sequence=3, stamp_ns=START + 3 * SECOND, status=Status.TILT)
    assert detector.measurement(late, START + 10 * SECOND) == []
    again = replace(late, sequence=0, stamp_ns=START + 11 * SECOND)
    assert [event.event for event in detector.measurement(again, START + 11 * SECOND)] == [
        "instrument_status"
    ]


def test_delay_attack_is_an_event() -> None:
    """Detected by the station, or by the link delay."""
    detector = StationEventDetector([1], START)
    rejected = detector.beacon_time_rejected(1, START, 3)
    assert (rejected.event, rejected.station, rejected.count) == ("beacon_time_rejected", 1, 3)
    anomaly = detector.link_delay_anomaly(1, START)
    assert (anomaly.event, anomaly.station) == ("link_delay_anomaly", 1)


def test_low_battery_is_one_event_until_it_is_changed() -> None:
    """Not one for each per cent around the threshold; what does not report its battery has none."""
    detector = StationEventDetector([1], START)
    percents = (85, 21, 20, 19, 20, 19, None, 29, 19, 30, 29, 12)
    events = [event for percent in percents for event in detector.battery(1, percent, START)]
    assert [(event.event, event.station) for event in events] == [
        ("battery_low", 1),
        ("battery_recovered", 1),
        ("battery_low", 1),
    ]
    assert events[0].message == "station 1 has 19 % left in the battery of its instrument; change it"
