"""Invariants of the wheel odometry: recorded as its program gave it, at its true times, and its silence and return are events."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from tsgt.errors import RecordingError
from tsgt.recording import read_odometry
from tsgt.simulation.checks.devices.sample_events import missing_events
from tsgt.simulation.checks.liveness import RECOVERY_TIME_S

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from tsgt.simulation.mission import MasterLog, MissionResult
    from tsgt.simulation.wheel_odometry import OdometrySamples

MAX_TIME_ERROR_S = 0.010
"""Limit of a stamp less true end less latency, as for the IMU."""

MIN_RECORDED_SHARE = 0.98
"""Minimum share of the program's samples that are recorded, from :data:`RECOVERY_TIME_S` after the last fault on."""

LAST_LINE_S = 0.2
"""The last line of the program may be incomplete at the end."""

_DECIMALS = 6


def odometry_failures(result: MissionResult) -> Iterator[str]:
    """Yield what is wrong with the recorded samples and with the events, one line each."""
    if result.odometry is None or result.parameters.odometry is None:
        return
    latency_s = result.parameters.odometry.latency_ns / 1e9
    recorded = [_recorded(log, result.odometry) for log in result.master_logs]
    for log, (rows, stamps_ns, problem) in zip(result.master_logs, recorded, strict=True):
        if problem:
            yield problem
        if len(np.unique(rows)) < len(rows):
            yield f"{len(rows) - len(np.unique(rows))} samples are recorded twice"
        if (np.diff(stamps_ns) <= 0).any():
            yield "stamps do not increase"
        error_s = (stamps_ns - log.unix_at_zero_ns) / 1e9 - result.odometry.time_s[rows] - latency_s
        if len(rows) and np.abs(error_s).max() > MAX_TIME_ERROR_S:
            worst = int(np.argmax(np.abs(error_s)))
            yield (
                f"stamp of the sample at {result.odometry.time_s[rows][worst]:.3f} s is off by {1e3 * error_s[worst]:.1f} ms, "
                f"limit {1e3 * MAX_TIME_ERROR_S:g} ms"
            )
        yield from missing_events(log, result.odometry.arrival_s, "odometry")
    if result.faults_end_s is not None:
        arrival_s = result.odometry.arrival_s
        expected = (arrival_s >= result.faults_end_s + RECOVERY_TIME_S) & (
            arrival_s < result.duration_s - LAST_LINE_S
        )
        missing = expected.copy()
        for rows, _, _ in recorded:
            missing[rows] = False
        if missing.sum() > (1 - MIN_RECORDED_SHARE) * expected.sum():
            yield f"{missing.sum()} of {expected.sum()} samples after the faults are not recorded"


def _recorded(log: MasterLog, samples: OdometrySamples) -> tuple[NDArray[np.intp], NDArray[np.int64], str]:
    """Rows and stamps of the recorded samples, (N,) each, and what has not been given."""
    rows_of = {
        (round(time_s * 1e9), round(speed, _DECIMALS)): row
        for row, (time_s, speed) in enumerate(
            zip(samples.time_s.tolist(), samples.speed_mps.tolist(), strict=True)
        )
    }
    rows: list[int] = []
    stamps_ns: list[int] = []
    problem = ""
    # A master that is killed at once leaves no header. The check of the replay notices all other damage.
    path = log.recording()
    with suppress(RecordingError):
        for line in () if path is None else read_odometry(path, keep_going=True):
            times_ns = line.instrument_time_ns or line.stamp_ns
            for time_ns, stamp_ns, speed in zip(times_ns, line.stamp_ns, line.speed_mps, strict=True):
                if (row := rows_of.get((time_ns, round(speed, _DECIMALS)))) is None:
                    problem = f"the sample at {time_ns / 1e9:.3f} s of its clock has not been given"
                else:
                    rows.append(row)
                    stamps_ns.append(stamp_ns)
    return np.array(rows, dtype=np.intp), np.array(stamps_ns, dtype=np.int64), problem
