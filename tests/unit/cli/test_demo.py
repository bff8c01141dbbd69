"""The demo on virtual time: how good its poses are, what it records, and how it ends early."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest
from structlog.testing import capture_logs

from tsgt.cli.demo import run_demo
from tsgt.config import ScenarioConfig
from tsgt.errors import StreamError
from tsgt.master.replay import replayed
from tsgt.master.stream_records import StatusRecord
from tsgt.recording import decode_line, load_recording, read_lines
from tsgt.simulation.clocks import VirtualClock

if TYPE_CHECKING:
    from pathlib import Path

    from tsgt.cli.demo import Result

START_NS = 1_700_000_000_123_456_789


async def _demo(folder: Path, *, duration_s: float = 60.0, seed: int = 0, name: str = "demo") -> Result:
    elapsed_ns = round(asyncio.get_running_loop().time() * 1e9)
    return await run_demo(
        ScenarioConfig(),
        VirtualClock(START_NS - elapsed_ns),
        duration_s=duration_s,
        seed=seed,
        socket_path=folder / f"{name}.sock",
        output=folder / f"{name}.jsonl",
    )


async def test_poses_are_near_the_truth(tmp_path: Path) -> None:
    """A minute of driving gives 20 poses a second, all but the first few valid, some millimetres off."""
    result = await _demo(tmp_path)
    assert 1160 < result.poses <= 1200
    assert result.poses - result.valid_poses < 10
    assert 1.0 < result.errors.position_rms_mm < 10.0
    assert 0.05 < result.errors.orientation_rms_deg < 0.6
    # 2 s at each end do not count.
    assert len(result.errors.position_m) == pytest.approx(56 * 20, abs=1)


async def test_the_recording_replays_bit_for_bit(tmp_path: Path) -> None:
    """Played again through the live pipeline, the recording gives every line once more, in the same order."""
    await _demo(tmp_path, duration_s=20.0)
    path = tmp_path / "demo.jsonl"
    recorded = [line.data for line in read_lines(path) if line.type not in {"recording", "parameters"}]
    assert [line for _, lines in replayed(path) for line in lines] == recorded
    assert len(recorded) > 500


async def test_the_same_seed_gives_the_same_recording(tmp_path: Path) -> None:
    """One seed is one run, to the byte; another seed is another."""
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        await _demo(tmp_path, duration_s=8.0, seed=seed, name=name)
    contents = {name: (tmp_path / f"{name}.jsonl").read_bytes() for name in "abc"}
    assert contents["a"] == contents["b"] != contents["c"]


async def test_status_every_second_and_at_the_end(tmp_path: Path) -> None:
    """A status line comes every second, the last one at the very end, with all that came counted."""
    await _demo(tmp_path, duration_s=6.5)
    path = tmp_path / "demo.jsonl"
    lines = list(read_lines(path))
    status = [decode_line(StatusRecord, line, path) for line in lines if line.type == "status"]
    assert [s.stamp_ns - START_NS for s in status] == [int(t * 1e9) for t in (1, 2, 3, 4, 5, 6, 6.5)]
    assert lines[-1].type == "status"
    assert status[-1].poses == sum(line.type == "pose" for line in lines)
    counted = sum(station.measurements for station in status[-1].stations)
    assert counted == len(load_recording(path).measurements)


async def test_a_reader_gets_what_is_recorded(tmp_path: Path) -> None:
    """The socket carries the greeting and then the lines of the recording."""
    running = asyncio.create_task(_demo(tmp_path, duration_s=10.0))
    await asyncio.sleep(0.05)
    reader, writer = await asyncio.open_unix_connection(tmp_path / "demo.sock")
    received = (await reader.read()).splitlines()
    writer.close()
    await running
    recorded = [line.data for line in read_lines(tmp_path / "demo.jsonl")]
    assert received[0].startswith(b'{"type":"hello"')
    assert len(received) > 200
    assert received[1:] == recorded[-len(received) + 1 :]


async def test_ended_early_it_still_sums_up(tmp_path: Path) -> None:
    """Stopped in the middle, the demo closes the recording with a status and judges what there was."""
    running = asyncio.create_task(_demo(tmp_path, duration_s=60.0))
    await asyncio.sleep(9.123)
    running.cancel()
    result = await running
    assert 150 < result.poses < 185
    assert result.errors.position_rms_mm < 10.0
    path = tmp_path / "demo.jsonl"
    last = list(read_lines(path))[-1]
    stamp_ns = decode_line(StatusRecord, last, path).stamp_ns
    assert stamp_ns - START_NS == pytest.approx(9_123_000_000, abs=2_000_000)
    assert not (tmp_path / "demo.sock").exists()


async def test_progress_is_readable(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every five seconds a line says how many poses there are, where the robot is, and how far off."""
    with capture_logs():
        await _demo(tmp_path, duration_s=10.0)
    printed = capsys.readouterr()
    assert printed.out == ""
    assert f"tsgt listen --socket {tmp_path / 'demo.sock'}" in printed.err
    progress = [line for line in printed.err.splitlines() if "poses valid" in line]
    assert [line.split()[0] for line in progress] == ["5", "10"]
    assert "mm rms" in progress[0]
    assert "0 readers" in progress[0]


async def test_a_socket_in_use_leaves_no_recording(tmp_path: Path) -> None:
    """When the socket cannot be had, nothing half-written stays behind."""
    (tmp_path / "demo.sock").write_text("not a socket")
    with pytest.raises(StreamError, match="is not a socket"):
        await _demo(tmp_path)
    assert not (tmp_path / "demo.jsonl").exists()
