"""The statistics of the status records."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tsgt.master.link_events import LinkStatus, SuperframeState
from tsgt.master.statistics import Statistics
from tsgt.model import PolarMeasurement, Status
from tsgt.radio.superframe import InstrumentCondition
from tsgt.timesync.two_way import ClockEstimate

SECOND = 1_000_000_000

MEASUREMENT = PolarMeasurement(
    station=2,
    prism=2,
    sequence=0,
    stamp_ns=10 * SECOND,
    received_ns=10 * SECOND + 100_000_000,
    horizontal_angle_rad=1.0,
    zenith_angle_rad=1.5,
    slope_distance_m=20.0,
    host_time_ns=0,
)


def test_status_before_the_first_measurement() -> None:
    """A silent station is reported with nulls."""
    status = Statistics([1, 2]).status(SECOND)
    assert [(s.id, s.measurements, s.usable, s.age_s, s.status) for s in status.stations] == [
        (1, 0, 0, None, None),
        (2, 0, 0, None, None),
    ]


def test_counts_measurements_and_usable_ones() -> None:
    """A measurement without a position is not usable; the last status is reported."""
    statistics = Statistics([1, 2])
    statistics.measurement(MEASUREMENT)
    statistics.measurement(replace(MEASUREMENT, sequence=1, stamp_ns=11 * SECOND, status=Status.NO_TARGET))
    station = statistics.status(12 * SECOND).stations[1]
    assert (station.measurements, station.usable, station.status) == (2, 1, Status.NO_TARGET)
    assert station.age_s == 1.0


def test_age_of_the_last_target_check() -> None:
    """Of a station that was checked; null for the others."""
    first, second = Statistics([1, 2], {2: 10 * SECOND}).status(12 * SECOND).stations
    assert (first.last_target_check_age_s, second.last_target_check_age_s) == (None, 2.0)


def test_no_station_answers_while_the_radio_fails() -> None:
    """Until one responds again; one that was never asked is unknown."""
    statistics = Statistics([1, 2])
    statistics.exchange(1, responded=True)
    statistics.radio_failed()
    assert [each.answering for each in statistics.status(SECOND).stations] == [False, None]
    statistics.exchange(1, responded=True)
    assert statistics.status(SECOND).stations[0].answering


def test_unknown_station_is_ignored() -> None:
    """Unknown station is ignored."""
    statistics = Statistics([1])
    statistics.measurement(MEASUREMENT)
    assert statistics.status(12 * SECOND) == Statistics([1]).status(12 * SECOND)


def test_counts_poses() -> None:
    """Valid poses are counted within all poses."""
    statistics = Statistics([1])
    for valid in (True, False, True):
        statistics.pose(valid=valid)
    status = statistics.status(SECOND)
    assert (status.stamp_ns, status.poses, status.valid_poses) == (SECOND, 3, 2)


def test_rate_is_over_the_last_ten_seconds() -> None:
    """Measurements every 0.5 s are 2 Hz; without more the rate falls to zero."""
    statistics = Statistics([2])
    for n in range(60):
        statistics.measurement(replace(MEASUREMENT, sequence=n, received_ns=n * SECOND // 2))
    assert statistics.status(30 * SECOND - 1).stations[0].rate_hz == pytest.approx(2.0)
    assert statistics.status(34 * SECOND + 1).stations[0].rate_hz == pytest.approx(1.1)
    assert statistics.status(60 * SECOND).stations[0].rate_hz == 0


def test_loss_is_over_the_last_fifty_requests() -> None:
    """Loss is over the last fifty requests."""
    statistics = Statistics([2])
    for n in range(150):
        statistics.exchange(2, responded=n >= 100 and n % 5 > 0)
    assert statistics.status(SECOND).stations[0].loss == pytest.approx(0.2)


def test_last_packet_is_reported() -> None:
    """With signal strength and age."""
    statistics = Statistics([2])
    statistics.packet(2, 3 * SECOND, rssi_dbm=-91.5, snr_db=7.25)
    station = statistics.status(5 * SECOND).stations[0]
    assert (station.last_heard_s, station.rssi_dbm, station.snr_db) == (2.0, -91.5, 7.25)


def test_clock_is_evaluated_at_the_time_of_the_status() -> None:
    """Clock is evaluated at the time of the status."""
    statistics = Statistics([2])
    status = statistics.status(
        5 * SECOND, LinkStatus(clock=lambda station, now_ns: ClockEstimate(now_ns + station, 1, 7, 0.0))
    )
    station = status.stations[0]
    assert (station.clock_offset_ns, station.clock_bound_ns) == (5 * SECOND + 2, 7)


@pytest.mark.parametrize(
    ("status", "locked"), [(Status.OK, True), (Status.ANGLE_ONLY, True), (Status.NO_TARGET, False)]
)
def test_station_is_locked_while_it_has_a_target(status: Status, locked: bool) -> None:  # noqa: FBT001 (a parameter)
    """By its last measurement; an angle without a distance has a target."""
    statistics = Statistics([2])
    statistics.measurement(replace(MEASUREMENT, status=status))
    assert statistics.status(SECOND).stations[0].locked is locked


def test_late_measurement_is_counted_but_not_the_newest() -> None:
    """As in a backlog after an outage; a restart has lower numbers with later times."""
    statistics = Statistics([2])
    statistics.measurement(replace(MEASUREMENT, sequence=9, stamp_bound_ns=5))
    late = replace(MEASUREMENT, sequence=3, stamp_ns=2 * SECOND, status=Status.TILT, stamp_bound_ns=7)
    statistics.measurement(late)
    station = statistics.status(12 * SECOND).stations[0]
    assert (station.measurements, station.status, station.age_s, station.stamp_bound_ns) == (
        2,
        Status.OK,
        2.0,
        5,
    )
    statistics.measurement(replace(late, sequence=0, stamp_ns=11 * SECOND))
    assert statistics.status(12 * SECOND).stations[0].status is Status.TILT


def test_late_measurement_from_another_journal_is_not_the_newest() -> None:
    """A client that cannot write its journal takes random numbers far above: they do not tell the order in time."""
    statistics = Statistics([2])
    statistics.measurement(MEASUREMENT)
    statistics.measurement(replace(MEASUREMENT, sequence=3_239_826, stamp_ns=2 * SECOND, status=Status.TILT))
    station = statistics.status(12 * SECOND).stations[0]
    assert (station.measurements, station.status, station.age_s) == (2, Status.OK, 2.0)


def test_station_whose_clock_was_stepped_back_is_followed() -> None:
    """Its next measurement has an earlier stamp."""
    statistics = Statistics([2])
    statistics.measurement(MEASUREMENT)
    statistics.measurement(replace(MEASUREMENT, sequence=20_001, stamp_ns=2 * SECOND))
    assert statistics.status(12 * SECOND).stations[0].age_s == 10.0


def test_superframe_state_is_reported() -> None:
    """Nulls until it is known."""
    statistics = Statistics([2])
    station = statistics.status(SECOND).stations[0]
    assert (station.joined, station.outstanding, station.missed_slots, station.rejected_beacons) == (
        None,
        None,
        None,
        None,
    )
    statistics.superframe_state(
        SuperframeState(
            2,
            joined=True,
            outstanding=3,
            missed_slots=4,
            rejected_beacons=5,
            condition=InstrumentCondition(battery_percent=85, atmospheric_ppm=8.5, activity="tracking"),
        )
    )
    status = statistics.status(SECOND, LinkStatus(protocol="superframe", authenticated=True, frame_ms=378.5))
    assert (status.protocol, status.authenticated, status.frame_ms) == ("superframe", True, 378.5)
    station = status.stations[0]
    assert (station.joined, station.outstanding, station.missed_slots, station.rejected_beacons) == (
        True,
        3,
        4,
        5,
    )
    assert (station.battery_percent, station.atmospheric_ppm, station.activity, station.problem) == (
        85,
        8.5,
        "tracking",
        None,
    )


def test_drain_of_a_backlog_is_reported() -> None:
    """Its speed over the last minute and its end; not before ten seconds, and no end while it grows."""
    statistics = Statistics([2])

    def after(second: int, outstanding: int) -> tuple[float | None, float | None]:
        statistics.superframe_state(
            SuperframeState(
                2,
                joined=True,
                outstanding=outstanding,
                missed_slots=0,
                rejected_beacons=0,
                condition=InstrumentCondition(),
            )
        )
        station = statistics.status(second * SECOND).stations[0]
        return station.drain_rate_hz, station.drain_s

    assert after(100, 3000) == (None, None)
    assert after(109, 2964) == (None, None)
    assert after(110, 2960) == (4.0, 740.0)
    for second in range(111, 300):
        drained = after(second, 2960 - 2 * (second - 110))
    assert drained == (2.0, (2960 - 2 * 189) / 2.0)
    for second in range(300, 400):
        drained = after(second, 2582 + 3 * (second - 299))
    assert drained == (-3.0, None)
