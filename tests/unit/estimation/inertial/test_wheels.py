"""Recorded wheel odometry as arrays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tsgt.estimation import wheel_samples
from tsgt.estimation.inertial.wheels import WheelConverter
from tsgt.model import OdometryParameters, OdometrySamples

ORIGIN_NS = 1_800_000_000_000_000_000
PARAMETERS = OdometryParameters(latency_ns=10_000_000)


def record(first: int, **others: tuple[object, ...]) -> OdometrySamples:
    """Return a line of two samples at 20 Hz."""
    stamps = tuple(ORIGIN_NS + 50_000_000 * (first + i) for i in range(2))
    line = OdometrySamples(
        sequence=first,
        received_ns=stamps[-1],
        stamp_ns=stamps,
        duration_ns=(50_000_000, 50_000_000),
        instrument_time_ns=None,
        speed_mps=(0.1 * first, 0.1 * first + 0.1),
        yaw_rate_radps=None,
        valid=(True, True),
    )
    return replace(line, **others)  # type: ignore[arg-type]


def test_latency_is_subtracted_and_invalid_samples_are_dropped() -> None:
    """A sample that the device does not trust leaves a gap."""
    found = wheel_samples([record(2), record(4, valid=(False, True))], PARAMETERS, ORIGIN_NS)
    np.testing.assert_allclose(found.end_s, [0.09, 0.14, 0.24])
    np.testing.assert_allclose(found.speed_mps, [0.2, 0.3, 0.5])
    np.testing.assert_allclose(found.duration_s, 0.05)


def test_records_one_by_one_give_the_samples_of_all() -> None:
    """Of samples that come twice, and of one that is not after those before, the first is kept."""
    records = [record(0), record(1), record(0), record(4)]
    converter = WheelConverter(PARAMETERS, ORIGIN_NS)
    parts = [converter.convert([each]) for each in records]
    np.testing.assert_allclose(
        np.concatenate([each.end_s for each in parts]), [-0.01, 0.04, 0.09, 0.19, 0.24]
    )
    whole = wheel_samples(records, PARAMETERS, ORIGIN_NS)
    np.testing.assert_array_equal(np.concatenate([each.end_s for each in parts]), whole.end_s)


def test_samples_that_no_program_gives_are_dropped() -> None:
    """Of a damaged recording: without a duration, or faster than any ground robot."""
    records = [record(0), record(2, duration_ns=(0, 50_000_000)), record(4, speed_mps=(0.1, 1e100))]
    np.testing.assert_allclose(wheel_samples(records, PARAMETERS, ORIGIN_NS).end_s, [-0.01, 0.04, 0.14, 0.19])
