"""Importing wheel odometry that another program recorded."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING

from harness.files.cli import called

from tsgt.cli.convert.cut_tables import note_cut_tables
from tsgt.recording import read_odometry

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

START_NS = 1_700_000_000_000_000_000


def write_table(path: Path, columns: str = "stamp_ns,speed_mps,yaw_rate_radps") -> Path:
    """Write samples at 20 Hz, two of which are missing."""
    rows = [f"{START_NS + n * 50_000_000},{n / 100},0.1" for n in range(50) if n not in (20, 21)]
    path.write_text("\n".join([columns, *rows]) + "\n")
    return path


def test_table_becomes_lines_of_odometry(tmp_path: Path) -> None:
    """Times with the offset, means over the intervals, missing samples counted."""
    output = tmp_path / "odometry.jsonl"
    result = called(
        "import", "odometry", write_table(tmp_path / "wheels.csv"), "--offset-ms", "2", "--output", output
    )
    assert result.code == 0, result.err
    records = list(read_odometry(output))
    assert sum(len(each.stamp_ns) for each in records) == 48
    assert records[0].stamp_ns[0] == START_NS + 2_000_000
    assert records[0].speed_mps[:2] == (0.0, 0.01)
    assert records[0].yaw_rate_radps is not None
    assert {duration for each in records for duration in each.duration_ns} == {50_000_000}
    last = records[-1]
    assert last.sequence + len(last.stamp_ns) == 50


def test_cut_table_is_imported_with_a_note(tmp_path: Path) -> None:
    """A last line without line end may lack digits."""
    table = write_table(tmp_path / "wheels.csv")
    table.write_bytes(table.read_bytes()[:-1])
    done = called("import", "odometry", table, "--output", tmp_path / "odometry.jsonl")
    assert done.code == 0
    assert f"note: {table}: the last line has no line end" in done.err


def test_table_without_speed_is_rejected(tmp_path: Path) -> None:
    """The error names the column."""
    table = write_table(tmp_path / "wheels.csv", "stamp_ns,velocity,yaw_rate_radps")
    result = called("import", "odometry", table, "--output", tmp_path / "odometry.jsonl")
    assert result.code == 1
    assert "speed_mps" in result.err


def test_two_speeds_of_one_time_are_rejected(tmp_path: Path) -> None:
    """As of a driver that stamps a batch, or with too few digits: one of them would stand for both."""
    table = tmp_path / "wheels.csv"
    table.write_text("time_s,speed_mps\n1.0,0.1\n1.1,0.2\n1.1,0.3\n")
    result = called("import", "odometry", table, "--output", tmp_path / "odometry.jsonl")
    assert result.code == 1
    assert "different samples have the same time, 1.100000000 s" in result.err


def test_empty_table_is_not_called_cut(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It has no last line; the reader says what is wrong with it."""
    (path := tmp_path / "empty.csv").touch()
    note_cut_tables([path])
    assert capsys.readouterr().err == ""


def test_bytes_of_a_name_that_are_not_utf8_are_replaced(tmp_path: Path) -> None:
    """The header names the table, whose name a system with Latin-1 has written."""
    table, output = write_table(tmp_path / os.fsdecode(b"w\xe4.csv")), tmp_path / "odometry.jsonl"
    done = called("import", "odometry", table, "--output", output)
    assert done.code == 0, done.err
    assert json.loads(output.read_bytes().splitlines()[0])["source"] == "import odometry: w\ufffd.csv"
