"""``tsgt analyse gnss`` on simulated receivers and prisms."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from harness.files.authors_files import write_prisms, write_tracks
from harness.files.pos_files import SECOND, Variant, write_pos

if TYPE_CHECKING:
    from harness.files.cli import Tsgt

PAGE = Path(__file__).parents[4] / "docs" / "how-to" / "compare-with-gnss.md"
START = 1_700_000_000 * SECOND
COUNT = 60


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    """Three receivers over 12 s in three notations; the last third of the second is not fixed and 1 m off."""
    times = [START + k * SECOND // 5 for k in range(COUNT)]
    way = np.column_stack([np.arange(COUNT) * 0.2, np.zeros(COUNT), np.zeros(COUNT)])
    off = np.column_stack([np.full(COUNT, 0.81), np.zeros(COUNT), np.where(np.arange(COUNT) < 40, 0.0, 1.0)])
    quality = [1] * 40 + [5] * 20
    ways = {
        "front": (way, Variant(), [1] * COUNT),
        "middle": (way + off, Variant(system="UTC", coordinates="ecef"), quality),
        "back": (way + np.array([0.0, 0.5, 0.0]), Variant(coordinates="sexagesimal", week=True), [1] * COUNT),
    }
    return [
        write_pos(tmp_path / f"{name}.pos", times, points, variant, quality=q)
        for name, (points, variant, q) in ways.items()
    ]


@pytest.fixture
def recording(tsgt: Tsgt, tmp_path: Path) -> Path:
    """Ten seconds of a drive that starts with the receivers' data."""
    path = tmp_path / "drive.jsonl"
    tracks, prisms = write_tracks(tmp_path), write_prisms(tmp_path)
    assert tsgt("import", "rts", "--tracks", *tracks, "--prisms", prisms, "--output", path).code == 0
    return path


def test_distance_errors_refer_to_the_given_references(tsgt: Tsgt, files: list[Path]) -> None:
    """References are assigned in the order of the pairs."""
    given = ["--reference-mm", 812, "--reference-mm", 500, "--reference-mm", 951.9]
    found: dict[str, Any] = tsgt("analyse", "gnss", *files, *given, "--json").json()
    pair = found["inter_receiver_mm"]["front-middle"]
    assert pair["reference"] == 812
    assert pair["by_quality"]["fix"]["mean_abs_error"] == pytest.approx(2, abs=0.3)
    assert pair["by_quality"]["single"]["mean_abs_error"] == pytest.approx(np.hypot(810, 1000) - 812, abs=0.3)
    assert (pair["valid"], pair["invalid"], pair["by_quality"]["single"]["valid"]) == (60, 0, 20)
    assert found["inter_receiver_mm"]["front-back"]["max"] < 0.5
    assert found["inter_receiver_all_mm"]["valid"] == 180
    assert found["reference"] == "given"


def test_receivers_are_described(tsgt: Tsgt, files: list[Path]) -> None:
    """The JSON output has time system, satellites and quality of each receiver."""
    keys = tsgt("analyse", "gnss", *files, "--json").json()
    assert (keys["start_ns"], keys["end_ns"]) == (START, START + (COUNT - 1) * SECOND // 5)
    found = keys["receivers"]
    assert [found[name]["time_system"] for name in found] == ["GPST", "UTC", "GPST"]
    assert found["middle"]["quality"] == pytest.approx({"fix": 2 / 3, "single": 1 / 3})
    assert found["middle"]["satellites"] == {"mean": 15, "std": 0, "min": 15, "max": 15}


def test_default_reference_is_the_median_of_fixed_solutions(tsgt: Tsgt, files: list[Path]) -> None:
    """The text says that this hides a constant error."""
    outcome = tsgt("analyse", "gnss", *files)
    assert (
        "reference: median of the fixed solutions (of all, if none is fixed), which hides a constant error"
        in outcome.out
    )
    assert re.search(r"^front-middle +60 +810\.\d ", outcome.out, flags=re.MULTILINE)
    assert re.search(r"^  single +20 ", outcome.out, flags=re.MULTILINE)


@pytest.mark.slow
def test_prism_distances_of_a_recording_are_added(
    tsgt: Tsgt, files: list[Path], recording: Path, tmp_path: Path
) -> None:
    """Both cover the common time; the figures of the prisms equal those of evaluate."""
    figure = tmp_path / "gnss.svg"
    found = tsgt("analyse", "gnss", *files, "--recording", recording, "--figure", figure, "--json").json()
    evaluated = tsgt("evaluate", recording, "--estimator", "linear", "--json").json()
    for name, pair in evaluated["inter_prism_mm"].items():
        for key in ("reference", "mean", "std", "mean_abs_error", "p95", "valid", "invalid"):
            assert found["inter_prism_mm"][name][key] == pytest.approx(pair[key], rel=1e-9), key
    assert found["inter_receiver_mm"]["front-middle"]["valid"] < COUNT
    assert found["inter_prism_all_mm"]["mean_abs_error"] < 10
    assert figure.stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["front.pos"], 2, "give the files of at least two receivers"),
        (["front.pos", "front.pos"], 2, "a file is given twice"),
        (
            ["front.pos", "back.pos", "--reference-mm", 1, "--reference-mm", 2],
            2,
            "2 receivers have 1 distances (1-2)",
        ),
        (["front.pos", "back.pos", "--reference-mm", "nan"], 2, "nan is not a finite number"),
        (["front.pos", "none.pos"], 1, "none.pos: No such file or directory"),
        (["front.pos", "later.pos"], 1, "front.pos: the receivers do not overlap in time"),
        (["front.pos", "back.pos", "--figure", "x.gif"], 2, "known suffixes: .png, .pdf, .svg"),
    ],
)
def test_invalid_input_is_one_line(
    tsgt: Tsgt, files: list[Path], tmp_path: Path, arguments: list[object], code: int, message: str
) -> None:
    """The error is one line with the reason."""
    write_pos(tmp_path / "later.pos", [START + 100 * SECOND, START + 101 * SECOND], np.zeros((2, 3)))
    assert files
    given = [tmp_path / str(a) if str(a).endswith(".pos") else a for a in arguments]
    outcome = tsgt("analyse", "gnss", *given)
    assert outcome.code == code
    assert message in outcome.err
    assert outcome.out == ""


def test_recording_of_another_day_is_rejected(tsgt: Tsgt, tmp_path: Path, recording: Path) -> None:
    """The error states the time between recording and receivers."""
    times = [START + 3600 * SECOND + k * SECOND for k in range(3)]
    files = [write_pos(tmp_path / f"{name}.pos", times, np.zeros((3, 3))) for name in "ab"]
    outcome = tsgt("analyse", "gnss", *files, "--recording", recording)
    assert outcome.code == 1
    assert re.search(
        r"drive\.jsonl: its distances end 359\d\.\d s before the start of the receivers'", outcome.err
    )


def test_recording_with_a_time_of_a_wrong_clock_is_rejected(
    tsgt: Tsgt, files: list[Path], recording: Path
) -> None:
    """20 Hz over years would need all memory."""
    records = [json.loads(line) for line in recording.read_text(encoding="utf-8").splitlines()]
    with recording.open("a", encoding="utf-8") as file:
        for last in {each["station"]: each for each in records[2:]}.values():
            late_ns = last["stamp_ns"] + 1000 * 86_400 * 10**9
            late = last | {"sequence": last["sequence"] + 1, "stamp_ns": late_ns, "received_ns": late_ns}
            file.write(json.dumps(late) + "\n")
    outcome = tsgt("analyse", "gnss", *files, "--recording", recording)
    assert (outcome.code, "its measurements span 1000.0 days" in outcome.err) == (1, True)


def test_every_json_key_is_documented(tsgt: Tsgt, files: list[Path], recording: Path) -> None:
    """The tables of the page have exactly the keys of ``--json``."""
    found = tsgt("analyse", "gnss", *files, "--recording", recording, "--json").json()
    receiver = found["receivers"]["front"]
    pair = found["inter_receiver_mm"]["front-middle"]
    keys = {*found, *receiver, *pair}
    documented = {
        key
        for row in re.findall(r"^\| (`.*?`) \|", PAGE.read_text(), flags=re.MULTILINE)
        for key in re.findall(r"`([\w.]+)`", row)
    }
    assert documented == keys
