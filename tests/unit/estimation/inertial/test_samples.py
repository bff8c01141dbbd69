"""Recorded samples of an IMU as arrays."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from harness.files.records import IMU_PARAMETERS, START, imu_samples

from tsgt.estimation import SampleConverter, inertial_samples
from tsgt.geometry.inertial import InertialSamples, concatenate_samples


def test_values_and_times() -> None:
    """Latency and gyro matrix are applied; times count from the origin."""
    parameters = replace(
        IMU_PARAMETERS,
        latency_ns=2_000_000,
        gyro_matrix=((1.0, 0.0, 0.5), (0.0, 1.0, 0.0), (0.0, 0.0, 2.0)),
    )
    samples = inertial_samples([imu_samples(0), imu_samples(10)], parameters, START)
    assert samples.end_s == pytest.approx(np.arange(20) * 0.005 - 0.002, abs=1e-12)
    assert samples.duration_s == pytest.approx(np.full(20, 0.005), abs=1e-12)
    assert samples.angular_rate_radps[0] == pytest.approx((0.05, 0.0, 0.2))
    assert samples.specific_force_mps2[7] == pytest.approx((0.0, 0.0, 9.81))


def test_samples_that_follow_each_other_touch() -> None:
    """Also where the fit of the clock has moved the stamps a little; a gap stays one."""
    second = imu_samples(10)
    second = replace(second, stamp_ns=tuple(stamp + 40_000 for stamp in second.stamp_ns))
    samples = inertial_samples([imu_samples(0), second, imu_samples(30)], IMU_PARAMETERS, START)
    gaps = samples.end_s[1:] - samples.duration_s[1:] - samples.end_s[:-1]
    assert gaps[:19] == pytest.approx(np.zeros(19), abs=1e-12)
    assert samples.duration_s[10] == pytest.approx(0.00504)
    assert gaps[19] == pytest.approx(0.05 - 0.00004)
    assert samples.duration_s[20] == pytest.approx(0.005)


def test_overlapping_samples_are_dropped() -> None:
    """The later ones of a record that repeats times, in any order of the records."""
    samples = inertial_samples([imu_samples(5), imu_samples(0), imu_samples(10)], IMU_PARAMETERS, START)
    assert len(samples) == 20
    assert (np.diff(samples.end_s) > 0.004).all()


def test_no_records_are_no_samples() -> None:
    """Empty arrays of the right shape."""
    samples = inertial_samples([], IMU_PARAMETERS, START)
    assert len(samples) == 0
    assert samples.angular_rate_radps.shape == (0, 3)


def test_records_one_by_one_are_the_samples_of_all() -> None:
    """Bit for bit, over joints, a gap and an overlap."""
    parameters = replace(IMU_PARAMETERS, gyro_matrix=((1.01, 0.02, 0.5), (0.03, 0.98, 0.01), (0.1, 0.0, 1.1)))
    shifted = imu_samples(10)
    shifted = replace(shifted, stamp_ns=tuple(stamp + 40_000 for stamp in shifted.stamp_ns))
    records = [imu_samples(0), shifted, imu_samples(25, 3), imu_samples(26), imu_samples(40)]
    whole = inertial_samples(records, parameters, START)
    converter = SampleConverter(parameters, START)
    parts = concatenate_samples([converter.convert([record]) for record in records])
    assert 0 < len(whole) < sum(len(record.stamp_ns) for record in records)
    for each in fields(InertialSamples):
        np.testing.assert_array_equal(getattr(parts, each.name), getattr(whole, each.name))


def test_samples_of_a_stuck_device_are_dropped() -> None:
    """From the third of the same values on, also across records: they are missing."""
    stuck = replace(imu_samples(10), angular_rate_radps=((9e-6, 0.0, 0.1),) * 9 + ((0.0, 0.0, 0.1),))
    converter = SampleConverter(IMU_PARAMETERS, START)
    counts = [len(converter.convert([record])) for record in (imu_samples(0), stuck, imu_samples(20))]
    assert counts == [10, 2, 10]


def test_samples_without_a_duration_are_dropped() -> None:
    """No device gives them, a damaged recording may: they are missing."""
    record = imu_samples(0)
    samples = inertial_samples(
        [replace(record, duration_ns=(0, *record.duration_ns[1:]))], IMU_PARAMETERS, START
    )
    assert len(samples) == 9
    assert (samples.duration_s > 0.0).all()
