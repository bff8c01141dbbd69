"""Recordings, journals and merged records of simulated missions, for tests of merging."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tsgt.recording import MergedRecord, decode_line, read_lines

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.model import PolarMeasurement
    from tsgt.simulation.mission import MissionResult


def journals(run: MissionResult) -> list[Path]:
    """Return the journals of all stations."""
    return [path for station_log in run.station_logs.values() for path in station_log.journals]


def recording(run: MissionResult, path: Path, *, without: int = 0) -> Path:
    """Concatenate the recordings of all master sessions; drop every ``without``-th measurement (0: none), as if lost by radio."""
    kept, measurements = [], 0
    for session in run.master_logs:
        recorded = session.recording()
        assert recorded is not None
        for line in recorded.read_bytes().splitlines(keepends=True):
            measurements += (measurement := line.startswith(b'{"type":"measurement"'))
            if not (measurement and without and measurements % without == 0):
                kept.append(line)
    path.write_bytes(b"".join(kept))
    return path


def merged_in(path: Path) -> list[PolarMeasurement]:
    """Return the measurements merged into a recording."""
    return [
        decode_line(MergedRecord, line, path).measurement
        for line in read_lines(path)
        if line.type == "merged"
    ]


def assert_true(run: MissionResult, measurements: list[PolarMeasurement]) -> None:
    """Check that the time errors of merged measurements are within their stated bounds."""
    for measurement in measurements:
        assert measurement.host_time_ns is not None
        assert measurement.stamp_bound_ns is not None
        true_ns = run.station_logs[measurement.station].true_times_ns[measurement.host_time_ns]
        assert abs(measurement.stamp_ns - run.start_ns - true_ns) <= measurement.stamp_bound_ns
