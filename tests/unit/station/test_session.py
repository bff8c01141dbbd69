"""The client session: records and status from readings and commands, without instrument, radio and time."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tsgt.model import PolarMeasurement, Status
from tsgt.radio import DirectCommand, MeasureCommand, SearchCommand, TrackCommand
from tsgt.recording.journal import InstrumentRecord
from tsgt.station import ClientStatus, Condition, Reading
from tsgt.station.session import ClientSession
from tsgt.station.status import LinkStatus

SECOND = 1_000_000_000
START = 1_600_000_000 * SECOND
ZERO = START - 77
SETTINGS = InstrumentRecord(make="i")
SILENT = LinkStatus(protocol="classic", master_received_ns=None, rssi_dbm=None, snr_db=None)


def reading(seconds: float, *, prism: int | None = 1, status: Status = Status.OK) -> Reading:
    """Return a reading this long after the start."""
    good = status in (Status.OK, Status.LOW_ACCURACY)
    return Reading(
        at_ns=77 + round(seconds * SECOND),
        prism=prism,
        horizontal_angle_rad=0.5,
        zenith_angle_rad=1.6,
        slope_distance_m=42.123456789 if good else None,
        status=status,
        raw_status=12,
        instrument_time_ns=99,
    )


def measure(session: ClientSession, seconds: float, *, status: Status = Status.OK) -> PolarMeasurement:
    """Return the record of a reading."""
    made = reading(seconds, status=status)
    return session.measurement(made, ZERO + made.at_ns)


def status(session: ClientSession, seconds: float, link: LinkStatus = SILENT) -> ClientStatus:
    """Return the status."""
    return session.status(
        START + round(seconds * SECOND),
        link,
        instrument="i",
        condition=Condition(activity="tracking", problem="battery low", battery_percent=9),
        settings=SETTINGS,
        journal="/j",
        journal_ok=True,
        journal_waiting=0,
        journal_lost=0,
        radio_ok=True,
    )


def test_measurement_has_raw_values() -> None:
    """One timestamp in three fields, and consecutive sequence numbers."""
    session = ClientSession(3, 1)
    first, second = measure(session, 0.0), measure(session, 0.4)
    assert first == PolarMeasurement(
        station=3,
        prism=1,
        sequence=0,
        stamp_ns=START,
        received_ns=START,
        horizontal_angle_rad=0.5,
        zenith_angle_rad=1.6,
        slope_distance_m=42.123456789,
        status=Status.OK,
        raw_status=12,
        host_time_ns=START,
        instrument_time_ns=99,
    )
    assert (second.sequence, second.host_time_ns) == (1, START + 400_000_000)


def test_measurement_has_raw_arrival() -> None:
    """Post-processing can recompute the timestamp from the instrument's time."""
    made = replace(reading(0.0), received_ns=77 + 95_000_000)
    measurement = ClientSession(3, 1).measurement(made, ZERO + made.at_ns)
    assert (measurement.stamp_ns, measurement.received_ns) == (START, START + 95_000_000)


def test_sequence_numbers_start_at_the_given_one() -> None:
    """Where the protocol identifies measurements by them."""
    session = ClientSession(3, 1, 1501)
    assert [measure(session, at).sequence for at in (0.0, 0.4)] == [1501, 1502]
    assert status(session, 1.0).measurements == 2


@pytest.mark.parametrize("value", Status)
def test_every_status_is_journalled(value: Status) -> None:
    """With the instrument's own code."""
    measurement = measure(ClientSession(3, 1), 0.0, status=value)
    assert (measurement.status, measurement.raw_status) == (value, 12)


def test_commands_change_mode() -> None:
    """Direct mode and back, to another prism or the same; the session knows which commands are satisfied."""
    session = ClientSession(3, 1)
    assert not session.is_satisfied(DirectCommand())
    session.apply(DirectCommand())
    assert (status(session, 0.0).mode, session.prism) == ("direct", 1)
    assert session.is_satisfied(DirectCommand())
    assert not session.is_satisfied(TrackCommand(1))
    session.apply(TrackCommand(7))
    assert (status(session, 0.0).mode, session.prism) == ("tracking", 7)
    assert session.is_satisfied(TrackCommand(None))
    assert session.is_satisfied(TrackCommand(7))
    assert not session.is_satisfied(TrackCommand(1))
    assert not session.is_satisfied(MeasureCommand())
    assert not session.is_satisfied(SearchCommand())
    session.apply(DirectCommand())
    session.apply(SearchCommand())
    assert (status(session, 0.0).mode, session.prism) == ("tracking", 7)


def test_single_measurement_is_journalled() -> None:
    """It has neither prism nor sequence number."""
    session = ClientSession(3, 1)
    target = session.single_measurement(reading(1.0, prism=None), START + SECOND)
    assert (target.station, target.stamp_ns, target.slope_distance_m) == (3, START + SECOND, 42.123456789)
    assert status(session, 1.0).measurements == 0


@pytest.mark.parametrize("value", Status)
def test_locked_is_as_the_master_reports_it(value: Status) -> None:
    """The last measurement had a target: at least its angles are valid."""
    session = ClientSession(3, 1)
    measure(session, 0.0, status=value)
    assert status(session, 1.0).locked is (value in (Status.OK, Status.LOW_ACCURACY, Status.ANGLE_ONLY))


def test_initial_status() -> None:
    """Unknown fields are null."""
    assert status(ClientSession(3, 1), 0.0) == ClientStatus(
        stamp_ns=START,
        station=3,
        instrument="i",
        activity="tracking",
        problem="battery low",
        battery_percent=9,
        settings=SETTINGS,
        mode="tracking",
        prism=1,
        locked=None,
        last=None,
        measurements=0,
        rate_hz=0.0,
        journal="/j",
        journal_ok=True,
        journal_waiting=0,
        journal_lost=0,
        master_heard_s=None,
        rssi_dbm=None,
        snr_db=None,
        unknown_packets=0,
        radio_ok=True,
        protocol="classic",
        authenticated=None,
        joined=None,
        queued=None,
        missed_slots=None,
        rejected_beacons=None,
        refused=None,
        clock_bound_ns=None,
    )


def test_status_has_lock_rate_and_master() -> None:
    """The rate covers the last ten seconds, and falls to 0 without measurements."""
    session = ClientSession(3, 1)
    for number in range(100):
        measure(session, number * 0.4)
    master_received_ns = START + 39 * SECOND
    link = LinkStatus(
        protocol="superframe", master_received_ns=master_received_ns, rssi_dbm=-80.5, snr_db=9.25, queued=3
    )
    now = status(session, 40.0, link)
    assert (now.protocol, now.queued, now.missed_slots) == ("superframe", 3, None)
    assert now.rate_hz == pytest.approx(2.5, abs=0.11)
    assert (now.locked, now.measurements) == (True, 100)
    assert (now.master_heard_s, now.rssi_dbm, now.snr_db) == (1.0, -80.5, 9.25)
    assert now.last is not None
    assert now.last.age_s == pytest.approx(0.4)
    assert status(session, 60.0).rate_hz == 0.0
    measure(session, 60.0, status=Status.NO_TARGET)
    assert status(session, 60.0).locked is False
