"""Invariants of the IMU's samples in the recordings: unchanged, once, in order, at their true times, and back after faults."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import RecordingError
from tsgt.recording import read_imu_samples
from tsgt.simulation.checks.devices.sample_events import missing_events
from tsgt.simulation.checks.liveness import RECOVERY_TIME_S

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tsgt.model import ImuSamples
    from tsgt.simulation.imu import DeviceSamples
    from tsgt.simulation.mission import MasterLog, MissionResult

MAX_TIME_ERROR_S = 0.010
"""Limit of a stamp less true end less latency."""

MIN_RECORDED_SHARE = 0.98
"""Minimum share of the program's samples that are recorded, from :data:`RECOVERY_TIME_S` after the last fault on."""

LAST_LINE_S = 0.2
"""The last line of the program may be incomplete at the end."""

MIN_JUMPS, MIN_STATUSES = 20, 10

MAX_DIFFERENT_SHARE = 0.2
"""Share of the statuses that may state another use of the IMU than the newest pose: it changes between two poses."""

MAX_BIAS_ERROR_RADPS, MAX_BIAS_ERROR_SHARE = 0.01, 2 / 3
"""Limit of the median error of the gyro's stated bias, and its share of a true bias of which that is more: with one prism the half
minute between two masters may not tell more of a large one.
"""

_DECIMALS = 9


def imu_failures(result: MissionResult) -> Iterator[str]:
    """Yield what is wrong with the recorded samples of the IMU, one line each."""
    if result.imu is None:
        return
    samples = result.imu.samples
    rows = {key: row for row, key in enumerate(_keys(samples))}
    found: set[int] = set()
    for master_log in result.master_logs:
        if (path := master_log.recording()) is not None:
            recorded = [(line, index, rows.get(key)) for line, index, key in _recorded(path)]
            found.update(row for _, _, row in recorded if row is not None)
            yield from _recording_failures(master_log, path, samples, recorded, result.imu.truth.latency_s)
    if result.faults_end_s is not None:
        yield from _missing(result, found)


def imu_status_failures(result: MissionResult) -> Iterator[str]:
    """Yield what is wrong with what poses, status and events say: use of the IMU, its jumps, its bias, its silences."""
    if result.imu is None:
        return
    for master_log in result.master_logs:
        yield from missing_events(master_log, result.imu.samples.arrival_s, "imu")
        if len(master_log.jumps_m) >= MIN_JUMPS and not any(master_log.jumps_m):
            yield f"none of {len(master_log.jumps_m)} jumps of predicted poses is above 0"
        statuses = [status.imu for status in master_log.statuses]
        pairs = [
            (status.use, use)
            for status, use in zip(statuses, master_log.imu_uses_at_status, strict=True)
            if status is not None and use is not None
        ]
        different = sum(use != of_pose for use, of_pose in pairs)
        if len(pairs) >= MIN_STATUSES and different > MAX_DIFFERENT_SHARE * len(pairs):
            yield f"{different} of {len(pairs)} statuses state another use of the IMU than the pose before"
        # Before poses rest on the IMU and are certain enough to be valid, the bias is not known either.
        valid = np.diff([counts.valid_poses for _, counts in master_log.counts_at_status], prepend=0) > 0
        errors = [
            float(np.linalg.norm(np.array(status.gyro_bias_radps) - result.imu.truth.gyro_bias_radps[-1]))
            for status, certain in zip(statuses, valid.tolist(), strict=True)
            if status is not None and status.gyro_bias_radps is not None and status.use == "used" and certain
        ]
        true_radps = float(np.linalg.norm(result.imu.truth.gyro_bias_radps[-1]))
        limit = max(MAX_BIAS_ERROR_RADPS, MAX_BIAS_ERROR_SHARE * true_radps)
        if len(errors) >= MIN_STATUSES and (median := float(np.median(errors))) > limit:
            yield f"gyro bias by {len(errors)} statuses: median error {median:.4f} rad/s, limit {limit:.4f}"


def _keys(samples: DeviceSamples) -> Iterator[tuple[int, tuple[float, ...]]]:
    """Yield what distinguishes each sample: its time on the device's clock, and its values, which its noise changes."""
    rates = np.round(samples.angular_rate_radps, _DECIMALS).tolist()
    forces = np.round(samples.specific_force_mps2, _DECIMALS).tolist()
    for device_ns, rate, force in zip(samples.device_ns.tolist(), rates, forces, strict=True):
        yield device_ns, (*rate, *force)


def _recorded(path: Path) -> Iterator[tuple[ImuSamples, int, tuple[int, tuple[float, ...]]]]:
    """Yield each recorded sample: its line, its index there, and its key."""
    # A master that is killed at once leaves no header. The check of the replay notices all other damage.
    with suppress(RecordingError):
        for line in read_imu_samples(path, keep_going=True):
            times_ns = line.instrument_time_ns or line.stamp_ns
            values = zip(times_ns, line.angular_rate_radps, line.specific_force_mps2, strict=True)
            for index, (device_ns, rate, force) in enumerate(values):
                yield line, index, (device_ns, tuple(round(each, _DECIMALS) for each in (*rate, *force)))


def _recording_failures(
    master_log: MasterLog,
    path: Path,
    samples: DeviceSamples,
    recorded: list[tuple[ImuSamples, int, int | None]],
    latency_s: float,
) -> Iterator[str]:
    found: list[int] = []
    stamps_ns: list[int] = []
    for line, index, row in recorded:
        if row is None:
            yield f"{path.name}: sample {line.sequence + index}: the IMU has not given it"
            return
        found.append(row)
        stamps_ns.append(line.stamp_ns[index])
    if len(set(found)) < len(found):
        yield f"{path.name}: {len(found) - len(set(found))} samples are recorded twice"
    if (np.diff(stamps_ns) <= 0).any():
        yield f"{path.name}: stamps do not increase"
    true_s = samples.end_s[found] + latency_s
    error_s = (np.array(stamps_ns, dtype=np.int64) - master_log.unix_at_zero_ns) / 1e9 - true_s
    if found and (worst := int(np.argmax(np.abs(error_s)))) and abs(error_s[worst]) > MAX_TIME_ERROR_S:
        yield (
            f"{path.name}: stamp of the sample at {true_s[worst]:.3f} s is off by {1e3 * error_s[worst]:.1f} ms, "
            f"limit {1e3 * MAX_TIME_ERROR_S:g} ms ({np.count_nonzero(np.abs(error_s) > MAX_TIME_ERROR_S)} samples)"
        )


def _missing(result: MissionResult, found: set[int]) -> Iterator[str]:
    """Compare what the program has printed after the faults with the recorded samples."""
    assert result.imu is not None  # noqa: S101 (checked by the caller)
    assert result.faults_end_s is not None  # noqa: S101 (checked by the caller)
    from_s, to_s = result.faults_end_s + RECOVERY_TIME_S, result.duration_s - LAST_LINE_S
    arrival_s = result.imu.samples.arrival_s
    expected = set(np.flatnonzero((arrival_s >= from_s) & (arrival_s < to_s)).tolist()) - found
    total = np.count_nonzero((arrival_s >= from_s) & (arrival_s < to_s))
    if len(expected) > (1 - MIN_RECORDED_SHARE) * total:
        yield f"IMU: {len(expected)} of {total} samples from {from_s:g} to {to_s:g} s are not recorded"
