"""Health of an IMU: what the samples show by themselves, and against the prisms."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.inertial_drive import imu_parameters, inertial_drive

from tsgt.geometry import FloatArray, exp_so3
from tsgt.geometry.inertial import InertialFixedLagSmoother, InertialSamples
from tsgt.geometry.inertial.health import HOLD_S, MAX_AGE_S, STUCK_S, HealthMonitor
from tsgt.model import MotionPrior

if TYPE_CHECKING:
    from numpy.typing import NDArray

IMU = imu_parameters()
DRIVE = inertial_drive(11.0, seed=12)
SAMPLES = DRIVE.samples(IMU)
CENTROID = DRIVE.layout.mean(axis=0)
FAULT_S = 5.0


def judged(samples: InertialSamples) -> tuple[HealthMonitor, NDArray[np.bool_], list[str | None]]:
    """Add lines of ten samples; return the monitor, which samples can be used, and the reason after each line."""
    monitor, used, reasons = HealthMonitor(), [], []
    for start in range(0, len(samples), 10):
        used.append(monitor.samples(samples.select(slice(start, start + 10))))
        reasons.append(monitor.reason)
    return monitor, np.concatenate(used), reasons


def changed(rows: slice, rate: FloatArray | None = None, force: FloatArray | None = None) -> InertialSamples:
    """Return the samples with other values in some rows."""
    rates, forces = SAMPLES.angular_rate_radps.copy(), SAMPLES.specific_force_mps2.copy()
    if rate is not None:
        rates[rows] = rate
    if force is not None:
        forces[rows] = force
    return replace(SAMPLES, angular_rate_radps=rates, specific_force_mps2=forces)


def test_good_samples_are_believed() -> None:
    """Also those of a shaken robot, and of one at rest."""
    for samples in (SAMPLES, DRIVE.shaken(IMU).samples(IMU)):
        _, used, reasons = judged(samples)
        assert used.all()
        assert set(reasons) == {None}


def test_stuck_values() -> None:
    """The reason comes within 0.15 s, and passes."""
    rows = slice(800, 900)
    samples = changed(rows, SAMPLES.angular_rate_radps[799], SAMPLES.specific_force_mps2[799])
    monitor, _, reasons = judged(samples)
    first = next(i for i, each in enumerate(reasons) if each)
    assert reasons[first] == "it repeats the same values"
    assert first * 0.05 - 4.0 < STUCK_S + 0.05
    last = max(i for i, each in enumerate(reasons) if each)
    assert last * 0.05 == pytest.approx(4.5 + HOLD_S, abs=0.1)
    assert monitor.stuck_from_s == np.inf


def test_values_beyond_any_range_are_left_out() -> None:
    """One spike."""
    _, used, reasons = judged(changed(slice(700, 701), rate=np.array([0.0, 60.0, 0.0])))
    assert np.flatnonzero(~used).tolist() == [700]
    assert "values beyond any measuring range" in reasons


def test_saturation() -> None:
    """An axis at its limit: the same high value, but for the little that the gyro matrix adds."""
    rate = np.tile([0.3, 2.0, 0.1], (40, 1)) + np.linspace(0, 1e-3, 40)[:, None]
    _, used, reasons = judged(changed(slice(700, 740), rate=rate))
    assert "the angular rate is at the limit of the device" in reasons
    assert not used[705:740].any()
    assert used[:700].all()


def test_old_samples() -> None:
    """None for some tenths of a second, at the time of a prediction; the next line is believed."""
    monitor, _, _ = judged(SAMPLES.select(slice(400)))
    reasons = []
    for now_s in (2.0 + 0.9 * MAX_AGE_S, 2.51):
        monitor.advance(now_s)
        reasons.append(monitor.reason)
    monitor.samples(SAMPLES.select(slice(400, 510)))
    assert [*reasons, monitor.reason] == [None, "no samples for 0.5 s", None]


def test_one_station_that_disagrees_is_not_the_imu() -> None:
    """Two prisms accuse the IMU, one its own station, and one alone the IMU."""
    monitor = HealthMonitor()
    for i in range(12):
        prism = i % 3
        assert not monitor.innovations(
            np.array([0.13 * i]), np.array([prism]), np.array([100.0 if prism == 1 else 2.0])
        )
    assert monitor.innovations(np.array([1.6]), np.array([0]), np.array([30.0]))
    assert monitor.reason == "it disagrees with the prisms"
    alone = HealthMonitor()
    found = [alone.innovations(np.array([0.4 * i]), np.array([0]), np.array([40.0])) for i in range(3)]
    assert found == [False, False, True]


@pytest.mark.slow
def test_knocked_imu_is_dropped_within_half_a_second_and_taken_back() -> None:
    """Knocked by 5 degrees, it disagrees with the next prisms; once back in its place it is believed again."""
    back_s = 6.5
    turn = exp_so3(np.radians([5.0, 0.0, 0.0]))
    rows = slice(*np.searchsorted(SAMPLES.end_s, (FAULT_S, back_s)))
    rates, forces = SAMPLES.angular_rate_radps.copy(), SAMPLES.specific_force_mps2.copy()
    rates[rows], forces[rows] = rates[rows] @ turn, forces[rows] @ turn
    # The knock itself turns the IMU.
    rates[rows.start : rows.start + 4] += np.radians([5.0, 0.0, 0.0]) / 0.02
    rates[rows.stop : rows.stop + 4] -= np.radians([5.0, 0.0, 0.0]) / 0.02
    samples = replace(SAMPLES, angular_rate_radps=rates, specific_force_mps2=forces)
    observations = replace(DRIVE.measure(), layout=DRIVE.layout - CENTROID)
    window = InertialFixedLagSmoother(IMU, MotionPrior(), reference_m=CENTROID)
    reasons, sampled, measured = [], 0, 0
    for now_s in np.arange(1.0, 10.9, 0.05):
        stop = int(np.searchsorted(samples.end_s, now_s))
        window.add_samples(samples.select(slice(sampled, stop)))
        sampled = stop
        while observations.time_s[measured] + 0.3 < now_s:
            window.update(observations.select(slice(measured, measured + 1)))
            measured += 1
        if window.initialised:
            window.predict(now_s)
        window.marginalise_before(now_s - 3.0)
        believed = window.health is None and window.converged and not window.ambiguous
        reasons.append((now_s, believed))
    dropped = [now_s for now_s, believed in reasons if not believed and now_s > 4.0]
    assert FAULT_S < dropped[0] < FAULT_S + 0.5 + 0.2  # the measurements are 0.3 s old
    assert back_s + 0.5 < dropped[-1] < 10.5
