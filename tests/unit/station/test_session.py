"""The client's session: what it makes of readings and packets, without instrument, radio and time."""

from __future__ import annotations

import pytest

from tsgt.model import PolarMeasurement, Status
from tsgt.radio.classic import DirectOrder, MeasureOrder, TrackOrder
from tsgt.radio.classic_messages import Acknowledgement, MeasurementMessage, decode_reply
from tsgt.station.instrument import Reading
from tsgt.station.session import Session
from tsgt.station.status import ClientStatus

SECOND = 1_000_000_000
START = 1_600_000_000 * SECOND
ZERO = START - 77


def reading(seconds: float, *, prism: int | None = 1, status: Status = Status.OK) -> Reading:
    """Make a reading so many seconds after the start."""
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


def measure(session: Session, seconds: float, **changes: object) -> PolarMeasurement:
    """Let the session take a reading, and offer it as if the disk had taken it."""
    made = reading(seconds, **changes)  # type: ignore[arg-type]
    measurement = session.measured(made, ZERO + made.at_ns)
    session.offer(measurement)
    return measurement


def ask(session: Session, payload: bytes, seconds: float = 0.0) -> object:
    """Hand the session a packet."""
    return session.received(payload, START + round(seconds * SECOND), rssi_dbm=-80.5, snr_db=9.25)


def answer(session: Session, payload: bytes) -> MeasurementMessage:
    """Ask for data, of a station that has been synchronised."""
    ask(session, b"e" + payload[1:])
    raw = ask(session, payload)
    assert isinstance(raw, bytes)
    message = decode_reply(raw)
    assert isinstance(message, MeasurementMessage)
    return message


def status(session: Session, seconds: float) -> ClientStatus:
    """Ask how it goes."""
    return session.status(
        START + round(seconds * SECOND),
        instrument="i",
        journal="/j",
        journal_ok=True,
        journal_waiting=0,
        radio_ok=True,
    )


def test_the_journal_gets_what_the_instrument_said() -> None:
    """Raw values, three times the one stamp, and running numbers."""
    session = Session(3, 1)
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


def test_the_master_gets_the_newest_again_and_again() -> None:
    """Bit for bit the raw values, and the host's stamp."""
    session = Session(3, 1)
    measure(session, 0.0)
    measure(session, 0.4)
    for _ in range(2):
        assert answer(session, b"t3") == MeasurementMessage(
            station=3,
            status=0,
            zenith_angle_rad=1.6,
            horizontal_angle_rad=0.5,
            slope_distance_m=42.123456789,
            time_ns=START + 400_000_000,
        )


@pytest.mark.parametrize(
    ("verdict", "raw"),
    [
        (Status.OK, 0),
        (Status.LOW_ACCURACY, 0),
        (Status.TILT, 1),
        (Status.WRONG_DISTANCE, 2),
        (Status.NO_TARGET, 3),
        (Status.ERROR, 3),
        (Status.ANGLE_ONLY, 4),
    ],
)
def test_every_status_reaches_journal_and_master(verdict: Status, raw: int) -> None:
    """Seven verdicts become five numbers on the air; the journal keeps all."""
    session = Session(3, 1)
    measurement = measure(session, 0.0, status=verdict)
    assert (measurement.status, measurement.raw_status) == (verdict, 12)
    message = answer(session, b"t3")
    assert (message.status, message.time_ns) == (raw, START)


def test_what_is_not_journalled_is_not_offered() -> None:
    """A measurement is the disk's first and the radio's second."""
    session = Session(3, 1)
    measure(session, 0.0)
    session.measured(reading(0.4), START + 400_000_000)
    assert answer(session, b"t3").time_ns == START


def test_what_the_disk_held_up_is_not_offered_as_another_prism() -> None:
    """After a change of prism a late line of the old one is journalled, and that is all."""
    session = Session(3, 1)
    late = session.measured(reading(0.0), START)
    order = ask(session, b"n32")
    assert order == TrackOrder(2)
    assert decode_reply(session.executed(order, ok=True)) == Acknowledgement("n", ok=True)
    session.offer(late)
    assert answer(session, b"t3").time_ns == 0
    measure(session, 0.4, prism=2)
    assert answer(session, b"t3").time_ns == START + 400_000_000


def test_orders_move_the_mode_only_when_they_are_done() -> None:
    """A failure leaves mode and prism as they were."""
    session = Session(3, 1)
    order = ask(session, b"d3")
    assert order == DirectOrder()
    assert not session.is_done_already(order)
    assert session.executed(order, ok=False) == b"dNo"
    assert status(session, 0.0).mode == "tracking"
    ask(session, b"d3")
    assert session.executed(order, ok=True) == b"dOk"
    assert status(session, 0.0).mode == "direct"
    assert session.is_done_already(order)
    order = ask(session, b"n37")
    assert order == TrackOrder(7)
    assert session.executed(order, ok=False) == b"nNo"
    assert (status(session, 0.0).mode, session.prism) == ("direct", 1)
    order = ask(session, b"n37")
    assert isinstance(order, TrackOrder)
    session.executed(order, ok=True)
    assert (status(session, 0.0).mode, session.prism) == ("tracking", 7)
    assert session.is_done_already(TrackOrder(None))
    assert session.is_done_already(TrackOrder(7))
    assert not session.is_done_already(TrackOrder(1))
    assert not session.is_done_already(MeasureOrder())


def test_a_shot_goes_to_journal_and_master() -> None:
    """In direct mode `t` is an order for one single measurement; its answer carries it."""
    session = Session(3, 1)
    session.executed(DirectOrder(), ok=True)
    assert ask(session, b"t3") == MeasureOrder()
    target = session.shot(reading(1.0, prism=None), START + SECOND)
    assert (target.station, target.stamp_ns, target.slope_distance_m) == (3, START + SECOND, 42.123456789)
    message = decode_reply(session.shot_answer(target))
    assert isinstance(message, MeasurementMessage)
    assert (message.status, message.time_ns) == (0, START + SECOND)
    assert ask(session, b"t3") == MeasureOrder()
    failed = decode_reply(session.shot_failed(START + 2 * SECOND))
    assert isinstance(failed, MeasurementMessage)
    assert (failed.status, failed.time_ns) == (3, START + 2 * SECOND)


def test_the_status_before_anything_has_happened() -> None:
    """What is not known is null."""
    assert status(Session(3, 1), 0.0) == ClientStatus(
        stamp_ns=START,
        station=3,
        instrument="i",
        mode="tracking",
        prism=1,
        locked=None,
        last=None,
        measurements=0,
        rate_hz=0.0,
        journal="/j",
        journal_ok=True,
        journal_waiting=0,
        master_heard_s=None,
        rssi_dbm=None,
        snr_db=None,
        radio_ok=True,
    )


def test_the_status_knows_lock_rate_and_master() -> None:
    """The rate is that of the last ten seconds, and sinks when nothing comes any more."""
    session = Session(3, 1)
    for number in range(100):
        measure(session, number * 0.4)
    ask(session, b"t3", 39.0)
    ask(session, b"t2", 39.5)  # another station's
    ask(session, b"e2", 39.5)
    now = status(session, 40.0)
    assert now.rate_hz == pytest.approx(2.5, abs=0.11)
    assert (now.locked, now.measurements) == (True, 100)
    assert (now.master_heard_s, now.rssi_dbm, now.snr_db) == (1.0, -80.5, 9.25)
    assert now.last is not None
    assert now.last.age_s == pytest.approx(0.4)
    assert status(session, 60.0).rate_hz == 0.0
    measure(session, 60.0, status=Status.NO_TARGET)
    assert status(session, 60.0).locked is False
