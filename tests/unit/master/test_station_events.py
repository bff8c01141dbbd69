"""The alerts: what happens to stations becomes an event once."""

from __future__ import annotations

from dataclasses import replace

import pytest
from harness.records import SECOND, START, measurement

from tsgt.master.station_events import Alerts
from tsgt.model import Status


def test_a_station_is_lost_once_and_back_once() -> None:
    """Five seconds without an answer to a request, and then one."""
    alerts = Alerts([1, 2], START)
    assert alerts.asked(1, START + SECOND, answered=True) == []
    names = []
    for second in range(2, 12):
        now_ns = START + second * SECOND
        assert alerts.asked(1, now_ns, answered=False) == []
        names += [event.event for event in alerts.tick(now_ns, unix_ns=now_ns)]
    assert names == ["station_lost"]
    (back,) = alerts.asked(1, START + 61 * SECOND, answered=True)
    assert (back.event, back.station) == ("station_recovered", 1)
    assert "after 60 s" in back.message


def test_a_station_that_is_not_asked_is_not_lost() -> None:
    """While the others are synchronised for the first time, nobody asks it."""
    alerts = Alerts([1], START)
    assert alerts.tick(START + 60 * SECOND, unix_ns=START + 60 * SECOND) == []


def test_one_lost_packet_is_no_lost_station() -> None:
    """It had not been heard for long because it had not been asked."""
    alerts = Alerts([1], START)
    alerts.asked(1, START + 24 * SECOND, answered=False)
    for second in (25, 40):
        now_ns = START + second * SECOND
        assert alerts.tick(now_ns, unix_ns=now_ns) == []
    alerts.asked(1, START + 40 * SECOND, answered=False)
    (lost,) = alerts.tick(START + 41 * SECOND, unix_ns=START + 41 * SECOND)
    assert lost.event == "station_lost"


def test_refusing_to_track_is_told_once() -> None:
    """And so is the end of it; one that tracks at once is not worth a word."""
    alerts = Alerts([1], START)
    assert alerts.ordered(1, 4, START, tracks=True) == []
    events = [e for tracks in (False, False, True) for e in alerts.ordered(1, 4, START, tracks=tracks)]
    assert [event.event for event in events] == ["station_not_tracking", "station_tracking"]


def test_a_change_of_what_the_instrument_says_is_told() -> None:
    """Each kind of error once, and that it measures again; low accuracy is normal in motion."""
    alerts = Alerts([1], START)
    statuses = [
        Status.OK,
        Status.LOW_ACCURACY,
        Status.TILT,
        Status.TILT,
        Status.WRONG_DISTANCE,
        Status.OK,
        Status.NO_TARGET,
    ]
    events = [e for s in statuses for e in alerts.measurement(replace(measurement(0), status=s), START)]
    assert {event.event for event in events} == {"instrument_status"}
    texts = ["not levelled", "wrong distance", "measures again", "no prism"]
    assert [text in event.message for text, event in zip(texts, events, strict=True)] == [True] * 4


@pytest.mark.parametrize(("steps_s", "told"), [([0.05, 0.09], 0), ([0.05, 0.2], 1), ([-3600.0, -3600.0], 1)])
def test_a_step_of_the_unix_clock_is_told_once(steps_s: list[float], told: int) -> None:
    """What slews by less than 0.1 s is not told; each further step is."""
    alerts = Alerts([1], START)
    events = [e for s in steps_s for e in alerts.tick(START, unix_ns=START + round(s * 1e9))]
    assert [event.event for event in events] == ["unix_clock_stepped"] * told


def test_a_unix_clock_that_was_set_forward_is_ahead_of_the_stream() -> None:
    """Signs in words and numbers: plus is forward."""
    (event,) = Alerts([1], START).tick(START, unix_ns=START + 2 * SECOND)
    assert "was set by +2.000 s and is now +2.000 s from" in event.message


def test_a_station_whose_instrument_is_gone_is_told_of_once() -> None:
    """It goes on answering with its last measurement: after ten seconds that is an event, and so is the next new one."""
    alerts = Alerts([1], START)
    alerts.polled(1, START)
    alerts.measurement(measurement(0), START)
    names = []
    for second in range(1, 30):
        names += [event.event for event in alerts.polled(1, START + second * SECOND)]
    assert names == ["station_idle"]
    events = alerts.measurement(measurement(0), START + 31 * SECOND)
    assert [event.event for event in events] == ["station_measuring"]


def test_a_station_that_is_not_polled_is_not_idle() -> None:
    """A first measurement half a minute after the last poll, as when others are synchronised, is nothing special."""
    alerts = Alerts([1], START)
    alerts.polled(1, START)
    alerts.measurement(measurement(0), START)
    assert alerts.polled(1, START + 30 * SECOND) == []
    assert alerts.measurement(measurement(0), START + 30 * SECOND) == []


def test_an_error_that_is_repeated_is_not_idleness() -> None:
    """The authors' nodes repeat an error without a time: the error itself has been told."""
    alerts = Alerts([1], START)
    alerts.measurement(replace(measurement(0), status=Status.TILT), START)
    assert [e for second in range(60) for e in alerts.polled(1, START + second * SECOND)] == []


def test_a_status_that_comes_late_is_no_news() -> None:
    """It tells how the instrument did, not how it does."""
    alerts = Alerts([1], START)
    newest = replace(measurement(9), station=1, stamp_ns=START + 9 * SECOND)
    assert alerts.measurement(newest, START + 10 * SECOND) == []
    late = replace(newest, sequence=3, stamp_ns=START + 3 * SECOND, status=Status.TILT)
    assert alerts.measurement(late, START + 10 * SECOND) == []
    again = replace(late, sequence=0, stamp_ns=START + 11 * SECOND)
    assert [event.event for event in alerts.measurement(again, START + 11 * SECOND)] == ["instrument_status"]


def test_packets_that_were_held_back_are_told() -> None:
    """By the station that was to be deceived, or by the time that a packet took."""
    alerts = Alerts([1], START)
    (doubted,) = alerts.beacon_time_rejected(1, START, 3)
    assert (doubted.event, doubted.station, doubted.count) == ("beacon_time_rejected", 1, 3)
    (link,) = alerts.link_delay_anomaly(1, START)
    assert (link.event, link.station) == ("link_delay_anomaly", 1)
