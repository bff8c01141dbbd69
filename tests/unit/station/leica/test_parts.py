"""Parts of the Leica driver: replies, two faces, poll schedule, models, wet-bulb temperature."""

from __future__ import annotations

import math

import pytest

from tsgt.config import LeicaInstrumentConfig
from tsgt.errors import InstrumentRefusedError
from tsgt.model import Status
from tsgt.station.geocom import Reply
from tsgt.station.leica import Identity
from tsgt.station.leica.measurement import FullMeasurement, ReadingFactory, decode_full_measurement
from tsgt.station.leica.setup import PRISM_TYPES, TRACKING_MODES, wet_bulb_temperature_c
from tsgt.station.leica.target import check_same_target, mean_of_two_faces
from tsgt.station.leica.tracking import PollScheduler

MS = 1_000_000
GOOD = (1.5, 1.6, 1e-6, 0.0, 0.0, 1e-6, 50.5, 12_345)


def reply(code: int, *values: float | str) -> Reply:
    """Return a reply that arrived at 1 s."""
    return Reply(code, values, 0, 1_000_000_000)


@pytest.mark.parametrize("code", [0, 1283, 1284])
def test_usable_codes_have_a_distance(code: int) -> None:
    """In motion the accuracy is not guaranteed, and the distance is as good as it gets."""
    got = decode_full_measurement(reply(code, *GOOD))
    assert got.status.usable
    assert (got.distance_m, got.time_ms) == (50.5, 12_345)


@pytest.mark.parametrize(
    ("code", "status"),
    [
        (1285, Status.ANGLE_ONLY),
        (1288, Status.ANGLE_ONLY),
        (1289, Status.ANGLE_ONLY),
        (1290, Status.TILT),
        (1291, Status.WRONG_DISTANCE),
        (1292, Status.NO_TARGET),
        (12, Status.ERROR),
        (4711, Status.ERROR),
    ],
)
def test_other_codes_have_no_distance(code: int, status: Status) -> None:
    """Whatever the value of the distance."""
    got = decode_full_measurement(reply(code, *GOOD))
    assert got.status is status
    assert (got.distance_m, got.time_ms) == (None, None)


@pytest.mark.parametrize(
    "values",
    [
        (),
        (1.5,),
        GOOD[:7],
        (*GOOD[:6], 0.0, 12_345),
        (*GOOD[:6], float("nan"), 1),
        (*GOOD[:6], "x", 1),
        (*GOOD[:6], 50_500.0, 12_345),
        (*GOOD[:7], 1e308),
        (15.2, *GOOD[1:]),
        (1.5, 16.0, *GOOD[2:]),
        ("a", *GOOD[1:]),
    ],
)
def test_invalid_values_give_no_distance(values: tuple[float | str, ...]) -> None:
    """A distance of zero is none, and an incomplete reply is not completed."""
    got = decode_full_measurement(reply(0, *values))
    assert not got.status.usable
    assert got.distance_m is None


def test_two_face_mean_cancels_axis_errors() -> None:
    """Collimation and index errors have opposite signs in the two; also across the zero of the circle."""
    for horizontal_rad in (0.00001, 1.0, math.tau - 0.00001):
        collimation, index = 0.0001, 0.0002
        first = FullMeasurement(
            (horizontal_rad + collimation) % math.tau, 1.4 + index, 20.0, 1, Status.OK, 0, 0
        )
        second = FullMeasurement(
            (horizontal_rad + math.pi - collimation) % math.tau,
            math.tau - 1.4 + index,
            20.002,
            2,
            Status.LOW_ACCURACY,
            1284,
            0,
        )
        mean = mean_of_two_faces(first, second)
        difference = math.remainder(mean.horizontal_angle_rad - horizontal_rad, math.tau)
        assert difference == pytest.approx(0.0, abs=1e-12)
        assert mean.zenith_angle_rad == pytest.approx(1.4)
        assert mean.distance_m == pytest.approx(20.001)
        assert mean.status is Status.LOW_ACCURACY


def test_faces_of_different_targets_are_refused() -> None:
    """The telescope was turned, or the line of sight was interrupted."""
    first = FullMeasurement(1.0, 1.4, 20.0, 1, Status.OK, 0, 0)
    second = FullMeasurement(1.0 + math.pi, math.tau - 1.4, 20.001, 2, Status.OK, 0, 0)
    check_same_target(first, second)
    for other in (
        second._replace(distance_m=18.7),
        second._replace(horizontal_angle_rad=1.02 + math.pi),
        second._replace(zenith_angle_rad=math.tau - 1.38),
    ):
        with pytest.raises(InstrumentRefusedError, match="measure again"):
            check_same_target(first, other)


def test_unchanged_status_is_repeated_every_half_second() -> None:
    """A changed one is reported at once."""
    readings = ReadingFactory(1, 0)
    reported = []
    for number in range(100):
        status = Status.NO_TARGET if number < 50 else Status.TILT
        measured = FullMeasurement(0.0, 0.0, None, None, status, 0, number * 50 * MS)
        reading = readings.without_distance(measured)
        if reading is not None:
            reported.append((number, reading.status))
    assert reported[0] == (0, Status.NO_TARGET)
    assert (50, Status.TILT) in reported
    assert len(reported) == 10


def test_polls_follow_the_interval_of_distances() -> None:
    """At once until the interval is known, then shortly before the next distance is due."""
    scheduler = PollScheduler()
    for number in range(5):
        assert scheduler.next_ns(0, 0) == 0
        scheduler.add_distance(1000 + 400 * number)
    assert scheduler.interval_ns == 400 * MS
    assert scheduler.next_ns(1_000 * MS, 50 * MS) == 1_340 * MS
    scheduler.add_distance(1000 + 1650)
    assert scheduler.interval_ns == 50 * MS


def test_higher_rate_is_detected() -> None:
    """Once in a while an interval is polled throughout."""
    scheduler = PollScheduler()
    for number in range(30):
        scheduler.add_distance(400 * number)
    waits = []
    for number in range(30, 80):
        scheduler.add_distance(400 * number)
        waits.append(scheduler.next_ns(1, 0) != 0)
    assert 0 < waits.count(False) <= 3


def test_model_is_identified_by_prefix() -> None:
    """An unknown model has no delays."""
    assert Identity(model='TS16 P 1" R500').properties.angle_delay_ns == 7_220_000
    assert Identity(model="Leica TS60 I").properties.angle_delay_ns == 4_980_000
    assert Identity(model="MS60").properties.angle_delay_ns == 0
    assert Identity(model="TCRP1201+").properties.latency_ns == 0
    assert Identity(model="").properties.angle_delay_ns == 0


@pytest.mark.parametrize(("dry_c", "wet_c"), [(12.0, 8.2), (20.0, 15.1), (30.0, 23.9), (0.0, -2.3)])
def test_wet_bulb_temperature(dry_c: float, wet_c: float) -> None:
    """At 60 % relative humidity, against psychrometric tables."""
    assert wet_bulb_temperature_c(dry_c) == pytest.approx(wet_c, abs=0.8)


def test_driver_supports_every_configuration_value() -> None:
    """Prism types and distance modes."""
    fields = LeicaInstrumentConfig.model_fields
    assert set(fields["prism_type"].annotation.__args__) == set(PRISM_TYPES)  # type: ignore[union-attr]
    assert set(fields["distance_mode"].annotation.__args__) == set(TRACKING_MODES)  # type: ignore[union-attr]
