"""Offset and drift of the clock of an IMU's samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from harness.inertial.imu_calibration import uncalibrated_drive

from tsgt.errors import GeometryError
from tsgt.geometry.inertial_calibration import align_clock
from tsgt.geometry.inertial_calibration.clock_alignment import PartOffset, fit_clock

OFFSET_S, DRIFT = -7203.4567, 90e-6


def parts(*errors_s: float, drift: float = DRIFT) -> list[PartOffset]:
    """Return parts of a drive, 100 s apart, whose offsets are on a line up to errors."""
    return [
        PartOffset(100.0 * n, OFFSET_S + drift * 100.0 * n + error_s, 5e-4)
        for n, error_s in enumerate(errors_s)
    ]


@pytest.mark.slow
def test_offset_of_hours_and_drift_are_found() -> None:
    """Within four sigmas, from less than three minutes and without a first guess; both are small enough not to matter."""
    drive = uncalibrated_drive(160.0, latency_s=0.0, seed=3)
    stamps_s = drive.samples.end_s + OFFSET_S + DRIFT * drive.samples.end_s
    found = align_clock(
        drive.observations, replace(drive.samples, end_s=stamps_s), drive.imu.noise, drive.gravity
    )
    assert found.parts == 2
    assert abs(found.drift - DRIFT) < 4 * found.drift_sigma
    assert found.drift_sigma < 1.5e-5
    error_s = found.to_measurements_s(stamps_s) - drive.samples.end_s
    assert abs(error_s.mean()) < 4 * found.offset_sigma_s
    assert found.offset_sigma_s < 1e-3
    assert np.abs(error_s).max() < 2.5e-3


def test_line_through_parts() -> None:
    """Times on the clock of the measurements are those without offset and drift."""
    found = fit_clock(parts(0.0, 0.0, 0.0))
    stamps_s = np.array([-500.0, 0.0, 1000.0])
    np.testing.assert_allclose(
        found.to_measurements_s(stamps_s), stamps_s - OFFSET_S - DRIFT * stamps_s, atol=1e-9
    )
    assert found.parts == 3
    assert found.rms_s == pytest.approx(0.0, abs=1e-9)


def test_parts_that_disagree_raise_the_sigmas() -> None:
    """Two parts have their own sigmas; more are compared with the line."""
    assert fit_clock(parts(0.0, 0.001)).offset_sigma_s == pytest.approx(5e-4 / np.sqrt(2))
    assert fit_clock(parts(0.0, 0.0, 0.0, 0.0)).offset_sigma_s == pytest.approx(2.5e-4)
    assert fit_clock(parts(0.004, -0.004, -0.004, 0.004)).offset_sigma_s > 2e-3


def test_clock_that_was_stepped_is_an_error() -> None:
    """No line describes it."""
    with pytest.raises(GeometryError, match=r"did not run evenly: its offsets are .* ms"):
        fit_clock(parts(0.0, 0.0, 0.0, 0.1, 0.1, 0.1))
    with pytest.raises(GeometryError, match=r"a line of \+1090 ppm \(limits 10 ms and 200 ppm\)"):
        fit_clock(parts(0.0, 0.1))


def test_single_part_does_not_tell_the_drift() -> None:
    """The error says what is needed."""
    with pytest.raises(GeometryError, match=r"2 parts of a drive, of at least 60 s each.*found 1"):
        fit_clock(parts(0.0))


@pytest.mark.slow
def test_samples_of_another_drive_are_an_error() -> None:
    """At no shift do they turn as the robot does."""
    drive, other = (uncalibrated_drive(125.0, seed=seed) for seed in (1, 2))
    with pytest.raises(GeometryError, match="not those of the robot at any latency "):
        align_clock(drive.observations, other.samples, drive.imu.noise, drive.gravity)
