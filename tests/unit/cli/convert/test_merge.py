"""``tsgt merge``."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
from harness.missions.merging import journals, recording
from harness.missions.missions import run_mission

if TYPE_CHECKING:
    from pathlib import Path

    from harness.files.cli import Tsgt

    from tsgt.simulation.mission import MissionResult


pytestmark = pytest.mark.slow  # whole missions


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> MissionResult:
    """Half a minute with the protocol classic."""
    return run_mission(tmp_path_factory.mktemp("mission"))


def test_merge_reports_each_journal(tsgt: Tsgt, run: MissionResult, tmp_path: Path) -> None:
    """Text and JSON agree, and a second merge adds nothing."""
    path = recording(run, tmp_path / "r.jsonl")
    merged = tsgt("merge", path, *journals(run), "--output", tmp_path / "o.jsonl")
    assert merged.code == 0
    figures = tsgt("merge", path, *journals(run), "--json").json()
    assert figures["added"] == sum(journal["added"] for journal in figures["journals"]) > 0
    assert figures["journals"][0]["path"] == str(journals(run)[0])
    first, *_, last = merged.out.splitlines()
    counts = figures["journals"][0]
    assert first == (
        f"{counts['path']}: {counts['added']} of {counts['measurements']} measurements added, "
        f"{counts['already_there']} already in the recording"
    )
    assert last == (
        f"{tmp_path / 'o.jsonl'}: {figures['added']} measurements added, timestamp bound "
        f"{figures['bound_ms']['p50']:.2f} ms (median), {figures['bound_ms']['max']:.2f} ms (max)"
    )
    again = tsgt("merge", path, *journals(run), "--json").json()
    assert again["added"] == 0
    assert again["already_there"] == figures["added"] + figures["already_there"]
    assert again["bound_ms"] == {"p50": None, "max": None}


def test_merged_measurements_are_processed_and_exported(
    tsgt: Tsgt, run: MissionResult, tmp_path: Path
) -> None:
    """They are used like all others."""
    path = recording(run, tmp_path / "r.jsonl")
    added = tsgt("merge", path, *journals(run), "--json").json()["added"]
    kept = sum(json.loads(line)["type"] == "measurement" for line in path.read_bytes().splitlines())
    figures = tsgt("process", path, "--output", tmp_path / "p.tum", "--json").json()
    assert figures["measurements"] == kept + added
    assert figures["valid_poses"] > 20 * 25
    assert tsgt("evaluate", path).code == 0
    csv = tsgt("export", path, "--format", "csv", "--records", "measurements").out
    assert len(csv.splitlines()) == 1 + kept + added


def test_skipped_journal_is_a_warning(tsgt: Tsgt, run: MissionResult, tmp_path: Path) -> None:
    """If no journal is left, it is an error."""
    path, other = recording(run, tmp_path / "r.jsonl"), tmp_path / "station9.jsonl"
    other.write_bytes(journals(run)[0].read_bytes().replace(b'"station":1', b'"station":9'))
    merged = tsgt("merge", path, *journals(run), other)
    assert merged.code == 0
    assert merged.err == f"warning: {other}: skipped: is of station 9, but the recording has only 1, 2, 3\n"
    merged = tsgt("merge", path, other)
    assert merged.code == 1
    assert merged.err.startswith(
        f"error: {path}: none of the journals can be merged; {other}: is of station 9"
    )


@pytest.mark.parametrize("content", [b"", b'{"type":"recor', b'{"type":"recording","version":1}\n{"ty'])
def test_empty_journal_is_skipped(tsgt: Tsgt, run: MissionResult, tmp_path: Path, content: bytes) -> None:
    """A client killed at its start leaves one; the others are merged."""
    path, begun = recording(run, tmp_path / "r.jsonl"), tmp_path / "station1-begun.jsonl"
    begun.write_bytes(content)
    merged = tsgt("merge", path, *journals(run), begun)
    assert merged.code == 0
    assert f"{begun}: is empty" in merged.err
    assert "0 measurements added" in tsgt("merge", path, begun).out


def test_torn_line_is_removed_with_a_warning(tsgt: Tsgt, run: MissionResult, tmp_path: Path) -> None:
    """The recording of a killed master ends with one."""
    path = recording(run, tmp_path / "r.jsonl")
    path.write_bytes(path.read_bytes() + b'{"type":"mea')
    merged = tsgt("merge", path, *journals(run))
    assert merged.err == f"warning: {path}: removed a torn last line of 12 bytes\n"


def test_merge_does_not_replace_an_input(tsgt: Tsgt, run: MissionResult, tmp_path: Path) -> None:
    """Neither the recording nor a journal."""
    path = recording(run, tmp_path / "r.jsonl")
    for input_path in (path, journals(run)[1]):
        merged = tsgt("merge", path, *journals(run), "--output", input_path)
        assert merged.code == 2
        assert "would replace its own input" in merged.err


def test_merge_needs_a_journal(tsgt: Tsgt, run: MissionResult, tmp_path: Path) -> None:
    """A recording alone is a usage error."""
    assert tsgt("merge", recording(run, tmp_path / "r.jsonl")).code == 2
