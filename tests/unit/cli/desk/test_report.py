"""The report of ``tsgt evaluate``, through the real command line; drawing is slow, so it is made once for many tests."""

from __future__ import annotations

import contextlib
import html
import io
import json
import re
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest
from harness.published import write_prisms, write_targets, write_tracks
from harness.scene import driving, standing

from tsgt.analysis.evaluation import read_tum
from tsgt.analysis.formats import read_still_intervals
from tsgt.analysis.report import Findings, figures_of, find, sections, verdicts
from tsgt.cli.main import cli, run
from tsgt.recording import load_recording

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from harness.cli import Tsgt
    from harness.scene import Motion

FIGURES = {
    "calibration",
    "distances",
    "distances_over_time",
    "errors_by_motion",
    "errors_by_two",
    "estimators_apart",
    "gaps",
    "held_out",
    "map",
    "perturbation",
    "residuals",
    "statuses",
    "trajectory",
}


CONSTANTS = {"1", "3", "20", "95"}
"""Seconds of a gap and of standing, Hz, and percent, which sentences name."""


class Made(NamedTuple):
    """A report, and what the command printed."""

    recording: Path
    folder: Path
    out: str


def stop_and_go(time_s: float) -> Motion:
    """Stand for 5 s, then drive a bend."""
    return driving(max(0.0, time_s - 5.0))


def called(*arguments: object) -> str:
    """Run ``tsgt``, which is to succeed, and return what it prints."""
    with contextlib.redirect_stdout(io.StringIO()) as printed, pytest.raises(SystemExit) as ending:
        run(cli, [str(argument) for argument in arguments])
    assert ending.value.code == 0
    return printed.getvalue()


def recorded(folder: Path, motion: Callable[[float], Motion] = stop_and_go, *, keep: str = "123") -> Path:
    """Import a simulated drive of ten seconds, and keep only the measurements of some stations."""
    path = folder / "drive.jsonl"
    tracks = write_tracks(folder, motion)
    importing = ["import", "rts", "--tracks", *tracks, "--prisms", write_prisms(folder)]
    called(*importing, "--targets", write_targets(folder), "--output", path)
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    kept = [line for line in lines if str(json.loads(line).get("station", keep))[0] in keep]
    path.write_text("".join(kept), encoding="utf-8")
    return path


def findings(recording: Path, **options: Any) -> Findings:
    """Find what a report tells, without drawing it."""
    options = {"reference": None, "with_held_out": False, **options}
    return find(load_recording(recording), recording, **options)


def told(found: Findings) -> str:
    """Everything that a report says in sentences."""
    return "\n".join(
        [v.text for v in verdicts(found)] + [text for section in sections(found) for text in section.text]
    )


def drawn(found: Findings, folder: Path, *names: str) -> set[str]:
    """Draw those figures of a report that have these names; return the names of all."""
    plots = {plot.name: plot for section in sections(found) for plot in section.plots}
    for name in names:
        plots[name].write([folder / f"{name}.png"])
    return set(plots)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Make one whole report."""
    folder = tmp_path_factory.mktemp("whole")
    recording = recorded(folder)
    return Made(
        recording, folder / "report", called("evaluate", recording, "--report", folder / "report", "--json")
    )


def test_the_page_holds_all_its_figures(made: Made) -> None:
    """Each stands beside it as PNG and PDF too, and the page asks for nothing from elsewhere."""
    page = (made.folder / "report.html").read_text(encoding="utf-8")
    assert {path.stem for path in made.folder.glob("*.png")} == FIGURES
    assert {path.stem for path in made.folder.glob("*.pdf")} == FIGURES
    assert page.count('src="data:image/png;base64,') == len(FIGURES)
    assert not re.search(r'(src|href)="(?!data:|#)', page)


def test_json_has_the_numbers_of_the_report_and_of_evaluate(made: Made) -> None:
    """The same names mean the same; the file beside the page holds what is printed."""
    printed = json.loads(made.out)
    assert json.loads((made.folder / "report.json").read_text(encoding="utf-8")) == printed
    evaluated = json.loads(called("evaluate", made.recording, "--no-held-out", "--json"))
    assert {key: printed[key] for key in evaluated} == evaluated
    assert printed["stations"]["1"]["measurements"] == 25
    assert set(printed["held_out_mm"]) == {"linear", "continuous"}


def test_every_number_of_the_page_is_in_its_json(made: Made) -> None:
    """Those of all tables and sentences, as they are rounded there; figures draw what these sum up."""
    page = (made.folder / "report.html").read_text(encoding="utf-8")
    printed = json.loads(made.out)
    assert [
        html.unescape(re.sub("<[^>]*>", "", v)).split(": ", 1)[1] for v in re.findall("<li .*?</li>", page)
    ] == [v["text"].replace("`", "") for v in printed["verdicts"]]
    known = [v for number in numbers_in(printed) for v in (number, 100 * number)]
    shown = re.findall(r"<td>(.*?)</td>|<p>(.*?)</p>", page.split("What to trust", 1)[1], flags=re.DOTALL)
    checked = 0
    for text in map("".join, shown):
        for word in re.findall(r"(?<![\w.:-])[-+]?\d+(?:\.\d+)?(?![\w:-])", text):
            digits = len(word.partition(".")[2])
            assert word in CONSTANTS or any(f"{v:.{digits}f}" == word for v in known), (word, text)
            checked += 1
    assert checked > 100


def numbers_in(value: Any) -> Iterator[float]:
    """All numbers of a JSON value; those of keys too, which name stations."""
    if isinstance(value, dict):
        yield from (float(key) for key in value if key.isdigit())
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from numbers_in(item)
    elif isinstance(value, int | float):
        yield float(value)


def test_the_colour_of_a_verdict_is_not_overruled(made: Made) -> None:
    """A rule for all of the list's lines is more particular than one for a class alone."""
    page = (made.folder / "report.html").read_text(encoding="utf-8")
    for level in ("good", "care", "bad"):
        assert f"ul.verdicts li.{level} {{ border-color: #" in page


def test_one_station_only_is_said(tsgt: Tsgt, tmp_path: Path) -> None:
    """There are no poses and no distances; what there is of the station is shown."""
    recording = recorded(tmp_path, keep="1")
    outcome = tsgt("evaluate", recording, "--report", tmp_path / "report")
    assert outcome.code == 0
    assert "do not trust: No poses by continuous and linear: prism 2 has no usable measurement" in outcome.out
    page = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert "nothing usable was measured of prism 2 and prism 3" in page
    assert {path.stem for path in (tmp_path / "report").glob("*.png")} == {
        *("calibration", "gaps", "perturbation", "statuses")
    }


def test_no_static_interval_is_said(tmp_path: Path) -> None:
    """The figure of standing distances has nothing then."""
    found = findings(recorded(tmp_path, driving))
    assert "never stood still" in told(found)
    assert "There is no interval of 3 s or more" in told(found)
    drawn(found, tmp_path, "distances", "distances_over_time")


def test_a_robot_that_only_stands_has_a_report(tmp_path: Path) -> None:
    """Its errors are sorted by a motion that is next to none, or not at all."""
    found = findings(recorded(tmp_path, standing))
    drawn(found, tmp_path, "map", "trajectory", "estimators_apart")
    assert "never stood still" not in told(found)


def test_a_reference_of_another_day_is_said(tmp_path: Path) -> None:
    """Both spans are named, so that one sees which clock was wrong."""
    reference = tmp_path / "other.tum"
    reference.write_text("1600000000 0 0 0 0 0 0 1\n1600000100 0 0 0 0 0 0 1\n", encoding="utf-8")
    found = findings(recorded(tmp_path), reference=read_tum(reference))
    assert "nothing was compared" in told(found)
    assert "it goes from 2020-09-13" in told(found)
    assert figures_of(found)["compared"] == 0


def test_odometry_says_when_the_robot_stood(tmp_path: Path) -> None:
    """Distances of standing are then from its intervals."""
    odometry = tmp_path / "odometry.csv"
    odometry.write_text("".join(f"{1_700_000_000.05 + i / 10},0,0\n" for i in range(41)), encoding="utf-8")
    found = figures_of(findings(recorded(tmp_path), still_ns=read_still_intervals(odometry)))
    assert found["still_s"] == pytest.approx(4.0)
    assert found["inter_prism_static_mm"]["1-2"]["valid"] == 10


def test_odometry_of_another_day_is_said(tmp_path: Path) -> None:
    """It says nothing of this drive, and what it says is not taken for standing."""
    other_day = (1_600_000_000_000_000_000, 1_600_000_100_000_000_000)
    found = findings(recorded(tmp_path), still_ns=[other_day])
    assert "By the odometry, the robot stood still before or after this recording only" in told(found)
    assert "standing from 2020-09-13" in told(found)
    assert figures_of(found)["still_s"] == 0.0


def test_a_short_recording_is_not_called_good(tmp_path: Path) -> None:
    """From a few residuals nobody can tell what noise makes, nor how the robot moves."""
    recording = recorded(tmp_path)
    lines = recording.read_text(encoding="utf-8").splitlines(keepends=True)
    late_ns = 1_700_000_003_000_000_000
    kept = [line for line in lines if json.loads(line).get("stamp_ns", 0) < late_ns or "sequence" not in line]
    recording.write_text("".join(kept), encoding="utf-8")
    said = told(findings(recording))
    assert "too few to tell how the robot moves" in said
    assert "what their noise makes" not in said


def test_stations_that_never_measure_together_are_not_called_driving(tmp_path: Path) -> None:
    """Whether the robot stood cannot be told then, and nothing is."""
    recording = recorded(tmp_path, standing)
    lines = recording.read_text(encoding="utf-8").splitlines(keepends=True)
    begins_s = {1: 0, 2: 3, 3: 6}
    kept = [
        line
        for line in lines
        for record in (json.loads(line),)
        if record.get("type") != "measurement"
        or begins_s[record["station"]]
        <= (record["stamp_ns"] - 1_700_000_000_000_000_000) / 1e9
        < begins_s[record["station"]] + 3
    ]
    recording.write_text("".join(kept), encoding="utf-8")
    said = told(findings(recording))
    assert "At no time were all prisms measured without a gap" in said
    assert "never stood still" not in said


def test_odometry_without_a_report_is_refused(tsgt: Tsgt, tmp_path: Path) -> None:
    """It would change nothing."""
    outcome = tsgt("evaluate", tmp_path / "drive.jsonl", "--odometry", tmp_path / "odometry.csv")
    assert outcome.code == 2
    assert "add --report" in outcome.err


def test_a_recording_without_measurements_has_no_report(tsgt: Tsgt, tmp_path: Path) -> None:
    """There is nothing to show, and no folder is left behind."""
    outcome = tsgt("evaluate", recorded(tmp_path, keep="9"), "--report", tmp_path / "report")
    assert outcome.code == 1
    assert "holds no measurements" in outcome.err
    assert not (tmp_path / "report").exists()


def test_a_report_needs_a_folder_that_can_be_written(tsgt: Tsgt, tmp_path: Path) -> None:
    """A file of its name is no folder."""
    (tmp_path / "taken").write_text("x", encoding="utf-8")
    outcome = tsgt("evaluate", recorded(tmp_path, keep="1"), "--report", tmp_path / "taken")
    assert outcome.code == 1
    assert "taken" in outcome.err
