"""Reading time is proportional to the file size."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest
from harness.files.pos_files import Variant
from harness.files.records import POSE, STATUS, measurement, recording_bytes

from tsgt.analysis.evaluation import read_tum
from tsgt.analysis.formats import read_pos, read_stationary_intervals, read_target_file
from tsgt.analysis.formats.trajectories import read_estimates
from tsgt.config import load_any
from tsgt.errors import ConfigError, InputFileError, RecordingError
from tsgt.recording import MAX_LINE_BYTES, load_recording
from tsgt.service import LineSplitter

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

TIMES = 8
MOST = 4
"""Allowed excess over proportional time on a busy machine; quadratic time would be eight times longer."""


def _recording(count: int) -> bytes:
    return recording_bytes(
        *(record for number in range(count) for record in (measurement(number), POSE, STATUS))
    )


def _pos(count: int) -> bytes:
    rows = [
        f"2022/03/14 {k // 3600:02d}:{k // 60 % 60:02d}:{k % 60:02d}.000 46.779400000 -71.274600000 61.0200 1 15 0.01 0.01 "
        "0.01 0.00 0.00 0.00 0.00 9.2"
        for k in range(count)
    ]
    return "\n".join([*Variant().header(), *rows, ""]).encode()


READERS: dict[str, tuple[Callable[[Path], object], Callable[[int], bytes]]] = {
    "recording": (load_recording, _recording),
    "recording of one line": (load_recording, lambda count: recording_bytes() + b"x" * 2000 * count),
    "nested": (load_recording, lambda count: recording_bytes() + b"[" * 500 * count + b"\n"),
    "receiver": (read_pos, _pos),
    "trajectory": (read_tum, lambda count: b"".join(b"%d.5 1 2 3 0 0 0 1\n" % k for k in range(10 * count))),
    "estimate": (
        read_estimates,
        lambda count: b"".join(b"%d.5,1,2,3,0,0,%d,1\n" % (k, k % 2) for k in range(10 * count)),
    ),
    "names": (read_estimates, lambda count: b"x." * 100 * count + b",y" * 20 * count + b"\n1\n"),
    "odometry": (
        read_stationary_intervals,
        lambda count: b"".join(b"%d,0,0\n" % k for k in range(10 * count)),
    ),
    "targets": (
        read_target_file,
        lambda count: (
            b"station,target,horizontal_angle_deg,zenith_angle_deg,slope_distance_m\n"
            + b"".join(b"1,%d,10,90,5\n" % (k + 1) for k in range(count))
        ),
    ),
    "configuration": (load_any, lambda count: b'kind = "prism_layout"\n' + b"# x\n" * 100 * count),
    "table": (
        load_any,
        lambda count: b'kind = "prism_layout"\n' + b"".join(b"[prisms.%d]\nx=1\n" % k for k in range(count)),
    ),
}


def _took_s(read: Callable[[Path], object], path: Path) -> float:
    best_s = float("inf")
    for _ in range(3):
        began_s = time.process_time()
        try:
            read(path)
        except (RecordingError, InputFileError, ConfigError) as error:
            assert len(str(error)) < 1000  # noqa: PT017 (it may well be read)
        best_s = min(best_s, time.process_time() - began_s)
    return best_s


@pytest.mark.parametrize("name", READERS)
def test_time_is_proportional_to_the_size(tmp_path: Path, name: str) -> None:
    """Time is proportional to the size."""
    read, content = READERS[name]
    small, large = tmp_path / "small", tmp_path / "large"
    small.write_bytes(content(150))
    large.write_bytes(content(150 * TIMES))
    small_s = _took_s(read, small)
    assert _took_s(read, large) < MOST * TIMES * small_s + 0.02


def test_endless_bridge_line_is_truncated() -> None:
    """Time is proportional to its length, and memory is bounded."""
    cutter = LineSplitter(1000)
    for _ in range(MAX_LINE_BYTES // 512):
        assert cutter.push(b"x" * 512) == []
    assert cutter.push(b"\nshort\n") == [b"x" * 1000, b"short"]
