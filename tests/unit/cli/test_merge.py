"""``tsgt merge`` through the real command line."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
from harness.merging import journals, recording
from harness.missions import mission

if TYPE_CHECKING:
    from pathlib import Path

    from harness.cli import Tsgt

    from tsgt.simulation.mission import Run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Half a minute over classic."""
    return mission(tmp_path_factory.mktemp("mission"))


def test_what_it_says(tsgt: Tsgt, run: Run, tmp_path: Path) -> None:
    """A line for each journal, one for all; figures for machines say the same, and that the second time adds nothing."""
    path = recording(run, tmp_path / "r.jsonl")
    told = tsgt("merge", path, *journals(run), "--output", tmp_path / "o.jsonl")
    assert told.code == 0
    figures = tsgt("merge", path, *journals(run), "--json").json()
    assert figures["added"] == sum(journal["added"] for journal in figures["journals"]) > 0
    assert figures["journals"][0]["path"] == str(journals(run)[0])
    first, *_, last = told.out.splitlines()
    counts = figures["journals"][0]
    assert first == (
        f"{counts['path']}: {counts['added']} of {counts['measurements']} measurements added, "
        f"{counts['already_there']} already there"
    )
    assert last == (
        f"{tmp_path / 'o.jsonl'}: {figures['added']} measurements added, times within "
        f"{figures['bound_ms']['p50']:.2f} ms (median), {figures['bound_ms']['max']:.2f} ms (largest)"
    )
    again = tsgt("merge", path, *journals(run), "--json").json()
    assert again["added"] == 0
    assert again["already_there"] == figures["added"] + figures["already_there"]
    assert again["bound_ms"] == {"p50": None, "max": None}


def test_what_was_merged_is_processed_and_exported(tsgt: Tsgt, run: Run, tmp_path: Path) -> None:
    """The desk takes what was merged for measurements like the others."""
    path = recording(run, tmp_path / "r.jsonl")
    added = tsgt("merge", path, *journals(run), "--json").json()["added"]
    kept = sum(json.loads(line)["type"] == "measurement" for line in path.read_bytes().splitlines())
    figures = tsgt("process", path, "--output", tmp_path / "p.tum", "--json").json()
    assert figures["measurements"] == kept + added
    assert figures["valid_poses"] > 20 * 25
    assert tsgt("evaluate", path).code == 0
    csv = tsgt("export", path, "--format", "csv", "--records", "measurements").out
    assert len(csv.splitlines()) == 1 + kept + added


def test_a_skipped_journal_is_a_warning(tsgt: Tsgt, run: Run, tmp_path: Path) -> None:
    """One line says which and why; without any other it is an error."""
    path, other = recording(run, tmp_path / "r.jsonl"), tmp_path / "station9.jsonl"
    other.write_bytes(journals(run)[0].read_bytes().replace(b'"station":1', b'"station":9'))
    told = tsgt("merge", path, *journals(run), other)
    assert told.code == 0
    assert told.err == f"warning: {other}: skipped: is of station 9, and the recording has only 1, 2, 3\n"
    told = tsgt("merge", path, other)
    assert told.code == 1
    assert told.err.startswith(f"error: {path}: none of the journals can be merged; {other}: is of station 9")


@pytest.mark.parametrize("content", [b"", b'{"type":"recor', b'{"type":"recording","version":1}\n{"ty'])
def test_a_journal_that_was_only_begun_is_passed_over(
    tsgt: Tsgt, run: Run, tmp_path: Path, content: bytes
) -> None:
    """A client that is killed as it starts leaves one; the others are merged all the same."""
    path, begun = recording(run, tmp_path / "r.jsonl"), tmp_path / "station1-begun.jsonl"
    begun.write_bytes(content)
    told = tsgt("merge", path, *journals(run), begun)
    assert told.code == 0
    assert f"{begun}: was only begun" in told.err
    assert "0 measurements added" in tsgt("merge", path, begun).out


def test_a_torn_line_is_told(tsgt: Tsgt, run: Run, tmp_path: Path) -> None:
    """The recording of a master that was killed ends in one, and has to be whole before anything follows."""
    path = recording(run, tmp_path / "r.jsonl")
    path.write_bytes(path.read_bytes() + b'{"type":"mea')
    told = tsgt("merge", path, *journals(run))
    assert told.err == f"warning: {path}: a torn last line of 12 bytes was cut off\n"


def test_the_output_replaces_no_input(tsgt: Tsgt, run: Run, tmp_path: Path) -> None:
    """Neither the recording nor a journal."""
    path = recording(run, tmp_path / "r.jsonl")
    for input_path in (path, journals(run)[1]):
        told = tsgt("merge", path, *journals(run), "--output", input_path)
        assert told.code == 2
        assert "would replace its own input" in told.err


def test_it_needs_a_journal(tsgt: Tsgt, run: Run, tmp_path: Path) -> None:
    """A recording alone is a usage error."""
    assert tsgt("merge", recording(run, tmp_path / "r.jsonl")).code == 2
