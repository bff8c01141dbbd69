"""Health of an IMU: what the samples show by themselves, and against the prisms."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from harness.inertial.inertial_drive import imu_parameters, inertial_drive

from tsgt.geometry import FloatArray, exp_so3
from tsgt.geometry.inertial import (
    InertialFixedLagSmoother,
    InertialSamples,
    SaturationMonitor,
    usable_samples,
)
from tsgt.geometry.inertial.live.health import HOLD_S, MAX_AGE_S, SHOCK, STUCK_S, HealthMonitor
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
    monitor, used, reasons = HealthMonitor(IMU), [], []
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


def clipped(samples: InertialSamples, rate: float, force: float, *, from_s: float) -> InertialSamples:
    """Clip samples from a time on."""
    late = (samples.end_s >= from_s)[:, None]
    return replace(
        samples,
        angular_rate_radps=np.where(
            late, samples.angular_rate_radps.clip(-rate, rate), samples.angular_rate_radps
        ),
        specific_force_mps2=np.where(
            late, samples.specific_force_mps2.clip(-force, force), samples.specific_force_mps2
        ),
    )


def quantised(samples: InertialSamples, step: float) -> InertialSamples:
    """Round angular rates and forces, the latter to ten steps."""
    return replace(
        samples,
        angular_rate_radps=np.round(samples.angular_rate_radps / step) * step,
        specific_force_mps2=np.round(samples.specific_force_mps2 / (10 * step)) * 10 * step,
    )


@pytest.mark.parametrize("step", [1e-7, 2e-4, 3e-3], ids=["fine", "chip", "coarse"])
def test_values_of_any_resolution_are_believed(step: float) -> None:
    """Also if the noise at rest does not change them."""
    samples = quantised(DRIVE.shaken(IMU).samples(IMU), step)
    resting = quantised(at_rest(), step)
    for each in (samples, resting):
        _, used, reasons = judged(each)
        assert used.all()
        assert {each for each in reasons if each != "it repeats the same values"} == {None}


def test_zeros_of_a_coarse_gyro_are_no_small_steps() -> None:
    """The gyro matrix mixes its axes: a zero is zero up to rounding only, and its changes are no steps of the device."""
    matrix = np.array([[1.0, 3e-3, -2e-3], [4e-3, 1.0, 1e-3], [2e-3, 2e-3, 1.0]])
    rest, drive = at_rest(), DRIVE.shaken(IMU).samples(IMU)
    rates = np.concatenate([rest.angular_rate_radps[:400] - 0.01, drive.angular_rate_radps[400:]])
    samples = quantised(replace(drive, angular_rate_radps=rates), 3e-3)
    samples = replace(samples, angular_rate_radps=samples.angular_rate_radps @ matrix.T)
    monitor = HealthMonitor(replace(IMU, gyro_matrix=matrix.tolist()))
    reasons = set()
    for start in range(0, len(samples), 10):
        monitor.samples(samples.select(slice(start, start + 10)))
        reasons.add(monitor.reason)
    assert reasons - {"it repeats the same values"} == {None}


def at_rest() -> InertialSamples:
    """Return noise and gravity."""
    rng = np.random.default_rng(3)
    root_hz = np.sqrt(200.0)
    size = (len(SAMPLES), 3)
    return replace(
        SAMPLES,
        angular_rate_radps=0.01 + rng.normal(0.0, IMU.noise.gyro_noise_density * root_hz, size),
        specific_force_mps2=rng.normal(
            [0.3, -0.2, 9.8], IMU.noise.accelerometer_noise_density * root_hz, size
        ),
    )


@pytest.mark.parametrize(
    ("rate", "force", "sensor"), [(0.1, 99.0, "angular rate"), (9.0, 11.0, "specific force")]
)
@pytest.mark.parametrize("step", [1e-6, 2e-4])
def test_saturation(rate: float, force: float, sensor: str, step: float) -> None:
    """An axis whose largest value comes again and again is at its limit, whatever the gyro matrix mixes."""
    matrix = ((1.0, 3e-3, -2e-3), (4e-3, 1.0, 1e-3), (2e-3, 2e-3, 1.0))
    samples = clipped(quantised(DRIVE.shaken(IMU).samples(IMU), step), rate, force, from_s=1.0)
    limited = (np.abs(samples.angular_rate_radps) == rate) | (np.abs(samples.specific_force_mps2) == force)
    samples = replace(samples, angular_rate_radps=samples.angular_rate_radps @ np.array(matrix).T)
    monitor, used, reasons = HealthMonitor(replace(IMU, gyro_matrix=matrix)), [], []
    for start in range(0, len(samples), 10):
        used.append(monitor.samples(samples.select(slice(start, start + 10))))
        reasons.append(monitor.reason)
    assert {each for each in reasons if each} == {f"the {sensor} is at the limit of the device"}
    # Larger values from before are in the last half second then.
    assert 1.0 < next(0.05 * i for i, each in enumerate(reasons, 1) if each) < 1.4
    bad = limited.any(axis=1)
    assert np.concatenate(used)[~bad].all()
    assert np.count_nonzero(~np.concatenate(used)[bad]) > 0.2 * np.count_nonzero(bad)


def test_axis_that_is_at_its_limit_at_once_is_noticed_within_a_line_or_two() -> None:
    """Four successive values that noise would change; the others move."""
    samples = changed(
        slice(704, 740),
        rate=np.stack(
            [
                0.3 + SAMPLES.angular_rate_radps[704:740, 0],
                np.full(36, 0.3),
                SAMPLES.angular_rate_radps[704:740, 2],
            ],
            axis=1,
        ),
    )
    _, used, reasons = judged(quantised(samples, 1e-6))
    assert reasons.index("the angular rate is at the limit of the device") == 70
    assert not used[704:740].any()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_limit_is_known_to_the_monitor_of_the_next_window(sign: float) -> None:
    """One value at it, which nothing repeats, is left out, until another is beyond it."""
    rates = SAMPLES.angular_rate_radps.copy()
    wave = np.sin(0.1 * np.arange(len(rates)))
    rates[:, 1] = sign * np.where(np.arange(len(rates)) < 500, np.minimum(0.3 * wave, 0.29), 0.25 * wave)
    limited = rates[:, 1] == sign * 0.29
    rates[[700, 900, 1000], 1] = sign * np.array([0.29, 0.295, 0.29])
    samples = replace(SAMPLES, angular_rate_radps=rates)
    saturation = SaturationMonitor(IMU)
    first = HealthMonitor(IMU, saturation)
    np.testing.assert_array_equal(first.samples(samples.select(slice(400))), ~limited[:400])
    second = HealthMonitor(IMU, saturation)
    reasons, used = [], []
    for start in range(600, 1100, 10):
        used.append(second.samples(samples.select(slice(start, start + 10))))
        reasons.append(second.reason)
    assert (600 + np.flatnonzero(~np.concatenate(used))).tolist() == [700]
    assert reasons[9:11] == [None, "the angular rate is at the limit of the device"]


def test_limit_between_the_steps_of_a_device_is_no_smaller_step() -> None:
    """Else coarse values of a robot at rest, which come again and again, would be at a limit."""
    samples = quantised(at_rest(), 2e-4)
    forces = samples.specific_force_mps2
    forces[300:320:2, 2] = 11.00002
    forces[301:321:2, 2] = 11.0 - 0.002 * np.arange(10)
    _, used, reasons = judged(samples)
    assert "the specific force is at the limit of the device" in reasons
    assert np.flatnonzero(~used).tolist() == list(range(310, 320, 2))


def test_blow_puts_the_setup_in_doubt() -> None:
    """For good."""
    monitor, used, reasons = judged(changed(slice(700, 702), force=np.array([0.0, 90.0, 9.0])))
    assert np.flatnonzero(~used).tolist() == [700, 701]
    assert "a shock may have displaced it" in reasons
    assert reasons[-1] is None
    assert monitor.setup_doubt
    assert not judged(SAMPLES)[0].setup_doubt


@pytest.mark.parametrize(("force_mps2", "doubt"), [(400.0, SHOCK), (np.inf, ""), (np.nan, "")])
def test_blow_beyond_any_range_is_one_nevertheless(force_mps2: float, doubt: str) -> None:
    """Some devices measure 40 g and more; what is no number is no blow."""
    monitor, used, _ = judged(changed(slice(700, 701), force=np.array([0.0, force_mps2, 9.0])))
    assert np.flatnonzero(~used).tolist() == [700]
    assert monitor.setup_doubt == doubt


def test_bad_samples_of_a_drive_are_left_out() -> None:
    """And no others."""
    samples = changed(slice(700, 702), force=np.array([0.0, 90.0, 9.0]))
    assert (
        np.setdiff1d(samples.end_s, usable_samples(samples, IMU).end_s).tolist()
        == samples.end_s[700:702].tolist()
    )


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
    monitor = HealthMonitor(IMU)
    for i in range(12):
        prism = i % 3
        assert not monitor.innovations(
            np.array([0.13 * i]), np.array([prism]), np.array([100.0 if prism == 1 else 2.0])
        )
    assert monitor.innovations(np.array([1.6]), np.array([0]), np.array([30.0]))
    assert monitor.reason == "it disagrees with the prisms"
    alone = HealthMonitor(IMU)
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
