"""The detector: what happens to stations becomes an event once."""

from __future__ import annotations

from dataclasses import replace

import pytest
from harness.records import SECOND, START, measurement

from tsgt.master.station_events import StationEventDetector
from tsgt.model import Status


def test_a_station_is_lost_once_and_back_once() -> None:
    """Five seconds without an answer to a request, and then one."""
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


def test_a_station_that_is_not_asked_is_not_lost() -> None:
    """While the others are synchronised for the first time, nobody asks it."""
    detector = StationEventDetector([1], START)
    assert detector.tick(START + 60 * SECOND, realtime_ns=START + 60 * SECOND) == []


def test_one_lost_packet_is_no_lost_station() -> None:
    """It had not been heard for long because it had not been asked."""
    detector = StationEventDetector([1], START)
    detector.exchange(1, START + 24 * SECOND, responded=False)
    for second in (25, 40):
        now_ns = START + second * SECOND
        assert detector.tick(now_ns, realtime_ns=now_ns) == []
    detector.exchange(1, START + 40 * SECOND, responded=False)
    (lost,) = detector.tick(START + 41 * SECOND, realtime_ns=START + 41 * SECOND)
    assert lost.event == "station_lost"


def test_refusing_to_track_is_told_once() -> None:
    """And so is the end of it; one that tracks at once is not worth a word."""
    detector = StationEventDetector([1], START)
    assert detector.tracking_result(1, 4, START, tracks=True) == []
    events = [
        e for tracks in (False, False, True) for e in detector.tracking_result(1, 4, START, tracks=tracks)
    ]
    assert [event.event for event in events] == ["station_not_tracking", "station_tracking"]


def test_a_change_of_what_the_instrument_says_is_told() -> None:
    """Each kind of error once, and that it measures again; low accuracy is normal in motion."""
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


@pytest.mark.parametrize(("steps_s", "told"), [([0.05, 0.09], 0), ([0.05, 0.2], 1), ([-3600.0, -3600.0], 1)])
def test_a_step_of_the_unix_clock_is_told_once(steps_s: list[float], told: int) -> None:
    """What slews by less than 0.1 s is not told; each further step is."""
    detector = StationEventDetector([1], START)
    events = [e for s in steps_s for e in detector.tick(START, realtime_ns=START + round(s * 1e9))]
    assert [event.event for event in events] == ["unix_clock_stepped"] * told


def test_a_unix_clock_that_was_set_forward_is_ahead_of_the_stream() -> None:
    """Signs in words and numbers: plus is forward."""
    (event,) = StationEventDetector([1], START).tick(START, realtime_ns=START + 2 * SECOND)
    assert "was set by +2.000 s and is now +2.000 s from" in event.message


def test_a_station_whose_instrument_is_gone_is_told_of_once() -> None:
    """It goes on answering with its last measurement: after ten seconds that is an event, and so is the next new one."""
    detector = StationEventDetector([1], START)
    detector.reply(1, START)
    detector.measurement(measurement(0), START)
    names = []
    for second in range(1, 30):
        names += [event.event for event in detector.reply(1, START + second * SECOND)]
    assert names == ["station_idle"]
    events = detector.measurement(measurement(0), START + 31 * SECOND)
    assert [event.event for event in events] == ["station_measuring"]


def test_a_station_that_is_not_polled_is_not_idle() -> None:
    """A first measurement half a minute after the last poll, as when others are synchronised, is nothing special."""
    detector = StationEventDetector([1], START)
    detector.reply(1, START)
    detector.measurement(measurement(0), START)
    assert detector.reply(1, START + 30 * SECOND) == []
    assert detector.measurement(measurement(0), START + 30 * SECOND) == []


def test_an_error_that_is_repeated_is_not_idleness() -> None:
    """The authors' nodes repeat an error without a time: the error itself has been told."""
    detector = StationEventDetector([1], START)
    detector.measurement(replace(measurement(0), status=Status.TILT), START)
    assert [e for second in range(60) for e in detector.reply(1, START + second * SECOND)] == []


def test_a_status_that_comes_late_is_no_news() -> None:
    """It tells how the instrument did, not how it does."""
    detector = StationEventDetector([1], START)
    newest = replace(measurement(9), station=1, stamp_ns=START + 9 * SECOND)
    assert detector.measurement(newest, START + 10 * SECOND) == []
    late = replace(newest, sequence=3, stamp_ns=START + 3 * SECOND, status=Status.TILT)
    assert detector.measurement(late, START + 10 * SECOND) == []
    again = replace(late, sequence=0, stamp_ns=START + 11 * SECOND)
    assert [event.event for event in detector.measurement(again, START + 11 * SECOND)] == [
        "instrument_status"
    ]


def test_packets_that_were_held_back_are_told() -> None:
    """By the station that was to be deceived, or by the time that a packet took."""
    detector = StationEventDetector([1], START)
    rejected = detector.beacon_time_rejected(1, START, 3)
    assert (rejected.event, rejected.station, rejected.count) == ("beacon_time_rejected", 1, 3)
    anomaly = detector.link_delay_anomaly(1, START)
    assert (anomaly.event, anomaly.station) == ("link_delay_anomaly", 1)
